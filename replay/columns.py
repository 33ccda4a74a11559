"""Columnar types of the rows of a log: one object per block of rows, never one per message.

A reader yields ``Block``s. The rows of a block have one of these types:

* ``Messages``   opaque messages, as ranges of one buffer (ROS, protobuf, JSON, encoded video);
* ``CanFrames``  raw CAN frames (CAN logs; ``can_msgs/Frame`` after decoding);
* ``Table``      named numeric columns (data sets, MF4; any message after decoding);
* ``Images``     encoded images.

``crosscue.replay.decode`` turns blocks of ``Messages`` into the other three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, Literal, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Int64s: TypeAlias = NDArray[np.int64]
Bytes: TypeAlias = NDArray[np.uint8]
Floats: TypeAlias = NDArray[np.float64]
Flag = TypeVar("Flag", np.bool_, np.uint8)

# Maximum number of rows in one block; with ``BLOCK_BYTES`` this bounds memory.
BLOCK_ROWS: Final = 65_536
# Target for the maximum payload bytes in one block, unless one message is larger.
BLOCK_BYTES: Final = 8 << 20

DATA: Final = 0
REMOTE: Final = 1
ERROR: Final = 2

# ``CanFrames.length`` where the log does not store it; the bytes are then padded with zeros.
LENGTH_UNKNOWN: Final = 255


@dataclass(frozen=True, slots=True, eq=False)
class ColumnSet:
    """Arrays of equal length, one in each field of a subclass."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Self:
        """Return the selected rows."""
        return type(self)(*(getattr(self, column.name)[index] for column in fields(self)))

    def __add__(self, later: Self) -> Self:
        names = [column.name for column in fields(self)]
        pairs = ((getattr(self, name), getattr(later, name)) for name in names)
        return type(self)(*map(np.concatenate, pairs))


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream of a log, known without reading the body.

    Attributes:
        name: Name as stored in the log; a bus name for CAN logs (``can0``).
        type_name: Message type (``sensor_msgs/msg/Imu``, ``foxglove.CompressedImage``), or one of
            crosscue's own: ``crosscue/CanFrames``, ``crosscue/Table``, ``crosscue/Images``.
        encoding: Message encoding: ``cdr``, ``ros1``, ``protobuf``, ``json``; ``columns`` when the
            reader itself yields ``CanFrames``, ``Table`` or ``Images``; else as stored.
        schema: The message definition, as stored.
        schema_encoding: ``ros2msg``, ``ros1msg``, ``ros2idl``, ``protobuf``, ``jsonschema``
            or empty.
        declared: Number of messages that the log declares (statistics, connection counts, rows),
            or None where it declares none.
        converted_from: Type of the stream that ``convert`` made this one from. It decides the
            topic's role, because the message type that stores a table may carry more or less
            information than the table.
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
        buffer: Shape (B,), uint8, read-only by convention; kept alive by this object.
        start: Shape (N,), int64: offset of each message's first byte.
        stop: Shape (N,), int64: offset one past each message's last byte.
    """

    buffer: Bytes
    start: Int64s
    stop: Int64s

    def __post_init__(self) -> None:
        """Check that the ranges have equal shapes."""
        if self.start.shape != self.stop.shape or self.start.ndim != 1:
            raise ValueError(
                f"start {self.start.shape} and stop {self.stop.shape}: expected equal (N,)"
            )

    def __len__(self) -> int:
        return len(self.start)

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Messages:
        """Return the selected messages; the buffer is shared."""
        return Messages(self.buffer, self.start[index], self.stop[index])

    def payload(self, i: int) -> memoryview:
        """Return the bytes of message ``i`` without copying them."""
        return self.buffer.data[int(self.start[i]) : int(self.stop[i])]


def _take_flags(flags: NDArray[Flag], index: NDArray[np.intp] | NDArray[np.bool_]) -> NDArray[Flag]:
    """Select flags by index; fast in the common case that no flag is set."""
    return flags.take(index) if flags.any() else np.zeros(len(index), flags.dtype)


@dataclass(frozen=True, slots=True, eq=False)
class CanFrames:
    """N CAN or CAN FD frames of one bus.

    Attributes:
        arbitration_id: Shape (N,), uint32: 11-bit or 29-bit identifier, without flag bits.
        is_extended: Shape (N,), bool: 29-bit identifier.
        kind: Shape (N,), uint8: ``DATA``, ``REMOTE`` or ``ERROR``.
        length: Shape (N,), uint8: number of payload bytes in the frame (not the DLC code), or
            ``LENGTH_UNKNOWN``.
        data: Shape (N, W), uint8, W = 8 or 64; bytes from ``length`` on are zero.
        is_fd: Shape (N,), bool: CAN FD frame.
        is_tx: Shape (N,), bool: sent by the logger itself, not received; None where the log or its
            reader does not record the direction.
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
        """Return the selected frames."""
        if isinstance(index, np.ndarray) and index.dtype == np.bool_:
            index = np.flatnonzero(index)
        if not isinstance(index, slice):
            # ``take`` is faster than indexing: fifteen times for payload rows.
            return CanFrames(
                self.arbitration_id.take(index),
                _take_flags(self.is_extended, index),
                _take_flags(self.kind, index),
                self.length.take(index),
                self.data.take(index, axis=0),
                _take_flags(self.is_fd, index),
                None if self.is_tx is None else _take_flags(self.is_tx, index),
            )
        columns: list[Any] = [getattr(self, column.name) for column in fields(self)]
        picked: list[Any] = [None if one is None else one[index] for one in columns]
        return CanFrames(*picked)


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Named columns of equal length.

    Attributes:
        columns: Arrays of shape (N,) or (N, k) by column name (unit last: ``gyro_z_radps``).
        units: Units by column name, for columns whose name has no unit suffix (DBC signals).
    """

    columns: Mapping[str, NDArray[np.generic]]
    units: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that all columns have the same length."""
        lengths = {name: len(column) for name, column in self.columns.items()}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"columns differ in length: {lengths}")

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def __getitem__(self, name: str) -> NDArray[np.generic]:
        return self.columns[name]

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_] | slice) -> Table:
        """Return the selected rows."""
        return Table({name: column[index] for name, column in self.columns.items()}, self.units)


ImageCoding: TypeAlias = Literal["jpeg", "png", "webp", "tiff", "bmp", "raw", "h264", "h265", "av1"]


@dataclass(frozen=True, slots=True, eq=False)
class Images:
    """N encoded images of one camera.

    Attributes:
        bytes_: The encoded images as ranges of one buffer.
        coding: N codings. ``h264``, ``h265`` and ``av1`` images are packets of a stream; ``raw``
            images need the four attributes below.
        width_px: Shape (N,), int32, or None where only the encoded bytes contain it.
        height_px: Shape (N,), int32, or None as for the width.
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
        """Return the selected images; the buffer is shared."""
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
        log_ns: Shape (N,), int64: time at which the recorder stored each row.
        rows: N rows.
        publish_ns: Shape (N,), int64: time at which the sender published each row, or None where
            the format has no such time.
        header_ns: Shape (N,), int64: the sensor's own time stamp, known after decoding, or None.
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
        """Return the selected rows."""
        return replace(
            self,
            log_ns=self.log_ns[index],
            rows=self.rows.take(index),
            publish_ns=None if self.publish_ns is None else self.publish_ns[index],
            header_ns=None if self.header_ns is None else self.header_ns[index],
            sequence=None if self.sequence is None else self.sequence[index],
        )


def image_block(
    topic: str,
    log_ns: Int64s,
    pictures: Sequence[bytes],
    codings: Sequence[str],
    header_ns: Int64s | None = None,
) -> Block:
    """Return a block of encoded images, copied into one buffer."""
    stop = np.cumsum([len(picture) for picture in pictures], dtype=np.int64)
    start = np.concatenate([np.zeros(1, dtype=np.int64), stop[:-1]])
    rows = Messages(np.frombuffer(b"".join(pictures), np.uint8), start, stop)
    return Block(topic, log_ns, Images(rows, tuple(codings)), header_ns=header_ns)


def raw_block(topic: str, t_ns: int, pixels: NDArray[Any], pixel_format: str) -> Block:
    """Return a block of one image; its bytes, shape (H, W, 3), are not copied."""
    height, width = pixels.shape[:2]
    images = Images(
        Messages(pixels.ravel(), np.zeros(1, np.int64), np.array([pixels.size], np.int64)),
        ("raw",),
        width_px=np.array([width], np.int32),
        height_px=np.array([height], np.int32),
        step_bytes=np.array([3 * width], np.int32),
        pixel_format=(pixel_format,),
    )
    return Block(topic, np.array([t_ns], np.int64), images)
