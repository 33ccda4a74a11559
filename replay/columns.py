"""What a recording holds, in columns: one object per chunk of a topic, never one per message.

A reader yields ``Block``s. The rows of a block are one of

* ``Messages``   opaque messages, as ranges of one buffer (ROS, protobuf, JSON, encoded video);
* ``CanFrames``  raw CAN frames (CAN logs; ``can_msgs/Frame`` after decoding);
* ``Table``      named numeric columns (data sets, MF4; any message after decoding);
* ``Images``     pictures, still encoded.

``crosscue.replay.decode`` turns blocks of ``Messages`` into the other three.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Int64s: TypeAlias = NDArray[np.int64]
Bytes: TypeAlias = NDArray[np.uint8]
Floats: TypeAlias = NDArray[np.float64]
Flag = TypeVar("Flag", np.bool_, np.uint8)

BLOCK_ROWS: Final = 65_536
"""Most rows a reader puts into one block; with ``BLOCK_BYTES`` this bounds memory."""
BLOCK_BYTES: Final = 8 << 20
"""Most payload bytes a reader aims to put into one block, unless one message is larger."""

DATA: Final = 0
REMOTE: Final = 1
ERROR: Final = 2

LENGTH_UNKNOWN: Final = 255
"""``CanFrames.length`` where the log does not keep it; the bytes are then padded with zeros."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream of a recording, known without reading the body.

    Attributes:
        name: As the log spells it; a bus name for CAN logs (``can0``).
        type_name: Message type (``sensor_msgs/msg/Imu``, ``foxglove.CompressedImage``), or one of
            our own: ``crosscue/CanFrames``, ``crosscue/Table``, ``crosscue/Images``.
        encoding: How messages are coded: ``cdr``, ``ros1``, ``protobuf``, ``json``; ``columns``
            when the reader yields ``CanFrames``, ``Table`` or ``Images`` itself; else as stored.
        schema: The message definition, as stored.
        schema_encoding: ``ros2msg``, ``ros1msg``, ``ros2idl``, ``protobuf``, ``jsonschema``
            or empty.
        declared: Messages that the format itself says there are (statistics, connection counts,
            rows), or None where it says nothing.
        converted_from: Type of the stream that ``convert`` made this one from, which decides its
            role: the message type that holds a table may say more or less than the table did.
    """

    name: str
    type_name: str
    encoding: str
    schema: bytes = b""
    schema_encoding: str = ""
    declared: int | None = None
    converted_from: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Messages:
    """N opaque messages as ranges of one buffer.

    Attributes:
        buffer: Shape (B,), uint8, read-only by agreement; kept alive by this object.
        start: Shape (N,), int64: first byte of each message.
        stop: Shape (N,), int64: one past its last byte.
    """

    buffer: Bytes
    start: Int64s
    stop: Int64s

    def __post_init__(self) -> None:
        """Refuse ranges that do not line up."""
        if self.start.shape != self.stop.shape or self.start.ndim != 1:
            raise ValueError(
                f"start {self.start.shape} and stop {self.stop.shape}: expected equal (N,)"
            )

    def __len__(self) -> int:
        return len(self.start)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Messages:
        """The messages picked by ``index``; the buffer is shared."""
        return Messages(self.buffer, self.start[index], self.stop[index])

    def payload(self, i: int) -> memoryview:
        """Bytes of message ``i``, not copied."""
        return self.buffer.data[int(self.start[i]) : int(self.stop[i])]


def _picked(flags: NDArray[Flag], index: NDArray[np.intp] | NDArray[np.bool_]) -> NDArray[Flag]:
    """Flags by their index; where none is set, as is usual, they need not be looked up."""
    return flags.take(index) if flags.any() else np.zeros(len(index), flags.dtype)


@dataclass(frozen=True, slots=True, eq=False)
class CanFrames:
    """N CAN or CAN FD frames of one bus.

    Attributes:
        arbitration_id: Shape (N,), uint32, 11 or 29 bits, without flag bits.
        is_extended: Shape (N,), bool: 29-bit identifier.
        kind: Shape (N,), uint8: ``DATA``, ``REMOTE`` or ``ERROR``.
        length: Shape (N,), uint8: payload bytes that the frame really carries (not the DLC code),
            or ``LENGTH_UNKNOWN``.
        data: Shape (N, W), uint8, W = 8 or 64; bytes from ``length`` on are zero.
        is_fd: Shape (N,), bool: CAN FD frame.
        is_tx: Shape (N,), bool: sent by the logger itself, not received; None where the log or its
            reader does not keep the direction.
    """

    arbitration_id: NDArray[np.uint32]
    is_extended: NDArray[np.bool_]
    kind: NDArray[np.uint8]
    length: NDArray[np.uint8]
    data: Bytes
    is_fd: NDArray[np.bool_]
    is_tx: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        """Refuse columns that do not line up."""
        n = len(self.arbitration_id)
        for name in ("is_extended", "kind", "length", "is_fd"):
            shape = getattr(self, name).shape
            if shape != (n,):
                raise ValueError(f"{name}: expected ({n},), got {shape}")
        if self.is_tx is not None and self.is_tx.shape != (n,):
            raise ValueError(f"is_tx: expected ({n},), got {self.is_tx.shape}")
        if self.data.ndim != 2 or self.data.shape[0] != n or self.data.shape[1] not in (8, 64):
            raise ValueError(f"data: expected ({n}, 8) or ({n}, 64), got {self.data.shape}")

    def __len__(self) -> int:
        return len(self.arbitration_id)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> CanFrames:
        """The frames picked by ``index``."""
        if isinstance(index, np.ndarray) and index.dtype == np.bool_:
            index = np.flatnonzero(index)
        if not isinstance(index, slice):
            # Faster than an index: for rows of a payload fifteen times.
            return CanFrames(
                self.arbitration_id.take(index),
                _picked(self.is_extended, index),
                _picked(self.kind, index),
                self.length.take(index),
                self.data.take(index, axis=0),
                _picked(self.is_fd, index),
                None if self.is_tx is None else _picked(self.is_tx, index),
            )
        return CanFrames(
            self.arbitration_id[index],
            self.is_extended[index],
            self.kind[index],
            self.length[index],
            self.data[index],
            self.is_fd[index],
            None if self.is_tx is None else self.is_tx[index],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Named columns of equal length.

    Attributes:
        columns: From column name (unit last: ``gyro_z_radps``) to an array of shape (N,) or (N, k).
        units: From column name to its unit, where the name does not carry it (DBC signals).
    """

    columns: Mapping[str, NDArray[np.generic]]
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse columns of different lengths."""
        lengths = {name: len(column) for name, column in self.columns.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"columns differ in length: {lengths}")

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def __getitem__(self, name: str) -> NDArray[np.generic]:
        return self.columns[name]

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Table:
        """The rows picked by ``index``."""
        return Table({name: column[index] for name, column in self.columns.items()}, self.units)


ImageCoding: TypeAlias = Literal["jpeg", "png", "webp", "tiff", "bmp", "raw", "h264", "h265", "av1"]


@dataclass(frozen=True, slots=True, eq=False)
class Images:
    """N pictures of one camera, still encoded.

    Attributes:
        bytes_: The encoded pictures as ranges of one buffer.
        coding: N codings; ``h264``, ``h265`` and ``av1`` are packets of a stream; ``raw`` needs the
            four below.
        width_px: Shape (N,), int32, or None where only the encoded bytes say it.
        height_px: The same.
        step_bytes: Bytes per row of a raw image.
        pixel_format: N ROS encodings (``rgb8``, ``mono16``, ``bayer_rggb8``, ...) of raw images.
    """

    bytes_: Messages
    coding: tuple[str, ...]
    width_px: NDArray[np.int32] | None = None
    height_px: NDArray[np.int32] | None = None
    step_bytes: NDArray[np.int32] | None = None
    pixel_format: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        """Refuse columns that do not line up."""
        if len(self.coding) != len(self.bytes_):
            raise ValueError(f"coding: expected {len(self.bytes_)} entries, got {len(self.coding)}")

    def __len__(self) -> int:
        return len(self.bytes_)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Images:
        """The pictures picked by ``index``; the buffer is shared."""
        picked = np.arange(len(self))[index]
        formats = self.pixel_format
        return Images(
            self.bytes_.take(index),
            tuple(self.coding[i] for i in picked),
            None if self.width_px is None else self.width_px[index],
            None if self.height_px is None else self.height_px[index],
            None if self.step_bytes is None else self.step_bytes[index],
            None if formats is None else tuple(formats[i] for i in picked),
        )


Rows: TypeAlias = Messages | CanFrames | Table | Images


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Consecutive rows of one topic, in the order in which the log stores them.

    Attributes:
        topic: Name of the topic.
        log_ns: Shape (N,), int64: when the recorder stored each row.
        rows: N rows.
        publish_ns: Shape (N,), int64: when the sender sent it, or None where the format has no such
            time.
        header_ns: Shape (N,), int64: the sensor's own stamp, known after decoding, or None.
        sequence: Shape (N,), uint32: the sender's message counter as stored, or None where the
            format has none.
    """

    topic: str
    log_ns: Int64s
    rows: Rows
    publish_ns: Int64s | None = None
    header_ns: Int64s | None = None
    sequence: NDArray[np.uint32] | None = None

    def __post_init__(self) -> None:
        """Refuse columns that do not line up."""
        n = len(self.rows)
        for name in ("log_ns", "publish_ns", "header_ns"):
            column = getattr(self, name)
            if column is None:
                continue
            if column.shape != (n,) or column.dtype != np.int64:
                raise ValueError(
                    f"{name}: expected int64 ({n},), got {column.dtype} {column.shape}"
                )
        if self.sequence is not None and self.sequence.shape != (n,):
            raise ValueError(f"sequence: expected ({n},), got {self.sequence.shape}")

    def __len__(self) -> int:
        return len(self.log_ns)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Block:
        """The rows picked by ``index``."""
        return replace(
            self,
            log_ns=self.log_ns[index],
            rows=self.rows.take(index),
            publish_ns=None if self.publish_ns is None else self.publish_ns[index],
            header_ns=None if self.header_ns is None else self.header_ns[index],
            sequence=None if self.sequence is None else self.sequence[index],
        )
