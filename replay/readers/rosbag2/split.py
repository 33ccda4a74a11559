"""Storage files of a ROS 2 bag folder: discovery, opening and decompression."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.replay.base import Log, report_missing
from crosscue.replay.columns import Topic
from crosscue.replay.errors import CrosscueError, LogError
from crosscue.replay.files.partial_file import Scratch
from crosscue.replay.ledger import Detail, Ledger
from crosscue.replay.limits import MIB, Limits
from crosscue.replay.logs.opening import open_log, open_unsealed
from crosscue.replay.seal.log import with_seal

from .db3 import Db3Log
from .metadata import Metadata

STORED: Final = (".db3", ".mcap")
PACKED: Final = ".zstd"
PACKED_DAMAGED: Final = "compressed file"

# Maximum size of a zstd frame's header (RFC 8878, 3.1.1).
_HEAD_BYTES: Final = 18
_READ_BYTES: Final = MIB
_FED_BYTES: Final = 1024
_WINDOW_BYTES: Final = 1 << 27
_ROOM_BYTES: Final = 64 * MIB


@dataclass(frozen=True, slots=True)
class Split:
    """One storage file.

    Attributes:
        path: Path of the file.
        topics: Topics of the file.
        range_ns: First and last log time, where known.
        fault: Reason why it cannot be opened, or empty.
        missing: Losses found when it was opened.
    """

    path: Path
    topics: tuple[Topic, ...] = ()
    range_ns: tuple[int, int] | None = None
    fault: str = ""
    missing: tuple[Detail, ...] = ()


def stored_files(folder: Path, metadata: Metadata, notices: list[str]) -> list[Path]:
    """List the storage files in the folder; of a file and its compressed copy, only one."""
    listed = [hint.name for hint in metadata.splits]
    found = {path.name: path for path in sorted(folder.iterdir()) if _is_stored(path)}
    for name in list(found):
        twin = name.removesuffix(PACKED)
        if name != twin and twin in found:
            left_out = name if twin in listed and name not in listed else twin
            found.pop(left_out)
            notices.append(f"{left_out} is a compressed or decompressed copy; it was not read")
    stems = {name.split(".")[0]: name for name in found if name in listed}
    for name in [name for name in found if name not in listed]:
        original = stems.get(name.split(".")[0])
        if original is not None and original.split(".")[1] != name.split(".")[1]:
            found.pop(name)
            notices.append(f"{name} has the name of {original} in another format; it was not read")
        elif listed:
            notices.append(f"{name} is not listed in metadata.yaml; it was read")
    order = {name: i for i, name in enumerate(listed)}
    return sorted(found.values(), key=lambda path: (order.get(path.name, len(order)), path.name))


def _is_stored(path: Path) -> bool:
    return path.is_file() and path.name.lower().removesuffix(PACKED).endswith(STORED)


def examined(path: Path, metadata: Metadata, limits: Limits) -> Split:
    """Open a storage file briefly to find its topics and time range."""
    hint = next((hint for hint in metadata.splits if hint.name == path.name), None)
    try:
        with open_storage(path, limits, open_unsealed) as (log, fault):
            range_ns = log.time_range_ns if isinstance(log, Db3Log) else None
            ledger = Ledger(str(path))
            if fault:
                ledger.drop("", PACKED_DAMAGED, None, fault)
            report_missing(log, ledger)
            missing = tuple(ledger.drops())
            return Split(
                path, log.topics, range_ns or (hint.range_ns if hint else None), missing=missing
            )
    except (CrosscueError, OSError) as error:
        return Split(path, fault=str(error))


def _open_part(path: Path, limits: Limits) -> Log:
    return with_seal(path, lambda: open_unsealed(path, limits), is_part=True)


@contextmanager
def open_storage(
    path: Path, limits: Limits, open_one: Callable[[Path, Limits], Log] = _open_part
) -> Iterator[tuple[Log, str]]:
    """Open the log in a storage file; yield it with the problem of its decompression, or empty."""
    if not path.name.endswith(PACKED):
        with open_one(path, limits) as log:
            yield log, ""
        return
    with Scratch() as folder:
        plain = folder / path.name.removesuffix(PACKED)
        fault = unpack(path, plain, limits)
        try:
            log = open_log(plain, limits)
        except CrosscueError as error:
            said = str(error).replace(str(plain), "unpacked")
            raise LogError(f"{path}: {fault + '; ' if fault else ''}{said}") from None
        with log:
            yield log, fault


def unpack(packed: Path, plain: Path, limits: Limits) -> str:
    """Decompress to ``plain`` as far as possible; return why it ended early, or empty.

    Raises:
        LogError: The disk for temporary files is too small.
        OSError: A file cannot be read or written.
    """
    import zstandard

    max_bytes = limits.chunk_bytes
    if (declared := _declared(packed)) > max_bytes:
        return f"declares {declared} bytes, the limit is {max_bytes} (--max-chunk)"
    written = 0
    unpacking = _Unpacking()
    with packed.open("rb") as source, plain.open("wb") as target:
        while part := source.read(_READ_BYTES):
            if shutil.disk_usage(plain.parent).free < _ROOM_BYTES:
                raise LogError(
                    f"{packed}: no space to unpack it in {plain.parent.parent} after {written} "
                    "bytes; set TMPDIR to a larger disk"
                )
            try:
                for out in unpacking.feed(part):
                    written += target.write(out)
                    if written > max_bytes:
                        size = packed.stat().st_size
                        return (
                            f"{size} bytes decompress to over {max_bytes}, the limit (--max-chunk)"
                        )
            except zstandard.ZstdError as error:
                return f"compressed file is damaged after {written} bytes ({error})"
    return "" if unpacking.is_at_end else f"compressed file is cut after {written} bytes"


def _declared(packed: Path) -> int:
    """Return the size that the first frame declares, which zstd enforces; -1 if unknown."""
    import zstandard

    with packed.open("rb") as source:
        try:
            return zstandard.frame_content_size(source.read(_HEAD_BYTES))
        except zstandard.ZstdError:
            return -1  # decompression reports a damaged header in more detail


class _Unpacking:
    """Decompressor of zstd frames in small steps, as a kilobyte may expand to 30 megabytes."""

    def __init__(self) -> None:
        import zstandard

        self._tool = zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES)
        self._frame = self._tool.decompressobj()

    @property
    def is_at_end(self) -> bool:
        """True if the last frame is complete."""
        return bool(self._frame.eof)

    def feed(self, part: bytes) -> Iterator[bytes]:
        """Decompress ``part``."""
        view = memoryview(part)
        for first in range(0, len(view), _FED_BYTES):
            piece = bytes(view[first : first + _FED_BYTES])
            while piece:
                if self._frame.eof:
                    self._frame = self._tool.decompressobj()
                yield self._frame.decompress(piece)
                piece = self._frame.unused_data if self._frame.eof else b""
