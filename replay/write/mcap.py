"""Write MCAP files atomically, with chunks, message indexes, statistics and all checksums.

The mcap package writes the file; this module orders messages and names the file. The same rows
yield the same bytes with the same version of mcap. During writing the file has a temporary name in
the same folder, and it is renamed once everything is on the disk.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, Self, TypeAlias

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray

from crosscue.replay.columns import Int64s, Messages
from crosscue.replay.errors import OutputError
from crosscue.replay.files.partial_file import PartialFile
from crosscue.replay.files.whole_file import cannot_write
from crosscue.replay.readers.mcap.records import CONVERTED_FROM

LIBRARY: Final = "crosscue"
# Target size of a chunk in uncompressed bytes.
CHUNK_BYTES: Final = 4 << 20
# Bytes of payload that are buffered and merged by time.
WINDOW_BYTES: Final = 8 << 20

Compression: TypeAlias = Literal["zstd", "lz4", "none"]


@dataclass(frozen=True, slots=True, eq=False)
class ChannelMessages:
    """N messages of one channel, in the order in which they are stored.

    Attributes:
        channel: Number of the channel.
        log_ns: Shape (N,), int64.
        publish_ns: Shape (N,), int64.
        sequence: Shape (N,), uint32.
        messages: N payloads.
    """

    channel: int
    log_ns: Int64s
    publish_ns: Int64s
    sequence: NDArray[np.uint32]
    messages: Messages

    def rows(self) -> Iterator[tuple[int, int, bytes, int, int]]:
        """Yield channel, log time, payload, publish time and sequence number of each message."""
        times = zip(self.log_ns.tolist(), self.publish_ns.tolist(), strict=True)
        for i, ((log_ns, publish_ns), number) in enumerate(
            zip(times, self.sequence.tolist(), strict=True)
        ):
            yield self.channel, log_ns, bytes(self.messages.payload(i)), publish_ns, number


class McapWriter:
    """Writer of one MCAP file with profile ``ros2``, to be used as a context manager.

    On normal exit the file has its final name; on an error nothing remains.
    """

    def __init__(
        self,
        path: Path,
        *,
        compression: Compression = "zstd",
        overwrite: bool = False,
        beside: Sequence[str] = (),
        chunk_bytes: int = CHUNK_BYTES,
    ) -> None:
        """Open a temporary file next to ``path`` and write its header.

        Args:
            path: Final path of the file.
            compression: Compression of chunks.
            overwrite: Replace an existing file.
            beside: Names of files that will be written next to it. With ``overwrite``, they may
                exist only if ``path`` does, because otherwise they are another's.
            chunk_bytes: Target size of a chunk in uncompressed bytes.

        Raises:
            OutputError: ``path`` or a file beside it exists, or it cannot be written.
        """
        if path.is_dir():
            raise OutputError(f"{path}: is a folder; expected the name of a file")
        there = [one for one in (path, *map(path.with_name, beside)) if one.exists()]
        if there and not (overwrite and path.exists()):
            instead = "" if overwrite else " or --overwrite"
            raise OutputError(f"{there[0]}: exists; give another name{instead}")
        self.path = path
        self._ids: dict[tuple[str, str], int] = {}
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._waiting: list[ChannelMessages] = []
        self._waiting_bytes = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._partial = PartialFile(path)
            self._file = self._partial.open()
        except OSError as error:
            raise cannot_write(path, error) from None
        self._writer = Writer(
            self._file,
            chunk_size=chunk_bytes,
            compression=CompressionType[compression.upper()],
            enable_data_crcs=True,
        )
        self._guarded(lambda: self._writer.start("ros2", LIBRARY))

    def add_channel(
        self,
        topic: str,
        type_name: str,
        schema: bytes,
        schema_encoding: str = "ros2msg",
        converted_from: str = "",
    ) -> int:
        """Return the channel number for CDR messages of a topic; equal calls return one channel.

        Args:
            topic: Name of the topic.
            type_name: Name of the type in ROS 2 spelling (``sensor_msgs/msg/Imu``).
            schema: Complete definition with all dependencies.
            schema_encoding: ``ros2msg`` or ``ros2idl``.
            converted_from: Original type as in ``Topic``; stored in the channel's metadata.

        Raises:
            OutputError: There are more topics than an MCAP file can number.
        """
        key = (topic, type_name)
        if key not in self._ids:
            if len(self._ids) >= 0xFFFF:
                raise OutputError(f"{self.path}: over 65535 topics; choose some with --topics")
            schema_id = self._schema(type_name, schema_encoding, schema)
            said = {CONVERTED_FROM: converted_from} if converted_from else {}
            self._ids[key] = self._writer.register_channel(topic, "cdr", schema_id, said)
        return self._ids[key]

    def _schema(self, name: str, encoding: str, schema: bytes) -> int:
        key = (name, encoding, schema)
        if key not in self._schema_ids:
            self._schema_ids[key] = self._writer.register_schema(name, encoding, schema)
        return self._schema_ids[key]

    def write(self, stretch: ChannelMessages) -> None:
        """Write messages; times must not be negative.

        Raises:
            OutputError: The disk is full.
            ValueError: A time is before 1970.
        """
        if not len(stretch.messages):
            return
        if int(stretch.log_ns.min()) < 0 or int(stretch.publish_ns.min()) < 0:
            raise ValueError("MCAP cannot store times before 1970")
        self._waiting.append(stretch)
        self._waiting_bytes += int((stretch.messages.stop - stretch.messages.start).sum())
        if self._waiting_bytes >= WINDOW_BYTES:
            self._guarded(self._flush)

    def _flush(self) -> None:
        """Merge the buffered messages by time, and write them."""
        waiting, self._waiting, self._waiting_bytes = self._waiting, [], 0
        rows = [stretch.rows() for stretch in waiting]
        for which in _order(waiting):
            self._writer.add_message(*next(rows[which]))

    def _finish(self) -> None:
        self._flush()
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()
        self._partial.keep()

    def _guarded(self, step: Callable[[], None]) -> None:
        try:
            step()
        except OSError as error:
            self.discard()
            raise cannot_write(self.path, error) from None

    def close(self) -> None:
        """Finish the file and rename it to its final name.

        Raises:
            OutputError: The disk is full.
        """
        self._guarded(self._finish)

    def discard(self) -> None:
        """Remove the file."""
        # Bytes that cannot be flushed belong to a file that is removed anyway.
        with suppress(OSError):
            self._file.close()
        self._partial.drop()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()


def _order(stretches: Sequence[ChannelMessages]) -> list[int]:
    """Return the index of the stretch of each next message when they are merged by log time.

    A channel whose clock runs backwards keeps its order: each of its messages counts as no earlier
    than its predecessors.
    """
    latest: dict[int, int] = {}
    keys = [np.empty(0, np.int64)]
    for stretch in stretches:
        key = np.maximum.accumulate(stretch.log_ns)
        key = np.maximum(key, latest.get(stretch.channel, 0))
        latest[stretch.channel] = int(key[-1])
        keys.append(key)
    origin = np.repeat(np.arange(len(stretches)), [len(s.log_ns) for s in stretches])
    ordered: list[int] = origin[np.argsort(np.concatenate(keys), kind="stable")].tolist()
    return ordered
