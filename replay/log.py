"""One way to open any recording.

``open_log`` asks the table ``FORMATS`` who knows a path. A new format is one file and one line in
that table: a module with a function ``open_PATH(path, limits) -> Log``, imported when needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Final, Protocol, Self, cast

from .columns import Block, Topic
from .errors import LogError, MissingTopicError, UnknownFormatError
from .ledger import Ledger
from .limits import DEFAULT, Limits


@dataclass(frozen=True, slots=True)
class Selection:
    """What of a log is wanted.

    Attributes:
        topics: Names, or None for all.
        start_ns: First log time wanted, or None.
        end_ns: First log time no longer wanted (half open), or None.
    """

    topics: frozenset[str] | None = None
    start_ns: int | None = None
    end_ns: int | None = None

    def wants(self, topic: str) -> bool:
        """Is ``topic`` wanted?"""
        return self.topics is None or topic in self.topics


EVERYTHING: Final = Selection()


class Readable(Protocol):
    """What gives blocks: a log, or one that is read on another time."""

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """As ``Log.read``."""
        ...


class Log(Protocol):
    """An open recording. Use it as a context manager."""

    @property
    def path(self) -> Path:
        """Where it lies."""
        ...

    @property
    def format(self) -> str:
        """Short name of the format, as in ``FORMATS``."""
        ...

    @property
    def topics(self) -> tuple[Topic, ...]:
        """What it holds, known without reading the body wherever the format allows.

        A topic may come to light only while reading (a cut file without a summary): readers then
        put it into the ledger and into the tuple returned by a later call.
        """
        ...

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """The log's rows in stored order, a block at a time, accounting as it goes.

        Every row met is ``ledger.find``-ed; rows read but outside ``selection`` are skipped with
        the reasons ``NOT_ASKED_TIME`` and ``NOT_ASKED_TOPIC``; an index may be used to avoid
        reading them, and the declared counts then say how many were skipped. Once exhausted,
        declared counts have been settled and ``ledger.integrity`` is set. Damage never raises here
        after the log was opened: what is readable is given, the rest is ``ledger.lose``-d. A row
        whose bytes are known to be damaged is never given; where a checksum only says that one of
        many rows is damaged, all that are structurally sound are given and the log is not whole.
        (A seal knows of damage by the MiB, not by the row, see ``sealed_log``.)
        """
        ...

    def close(self) -> None:
        """Release files."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


@dataclass(frozen=True, slots=True)
class Format:
    """One line of the table.

    Attributes:
        suffixes: Lower-case file suffixes; empty for folders known by ``markers``.
        markers: Relative paths, one of which a folder must hold (glob patterns allowed).
        opener: ``module:function``, called with the path and limits.
        says: What a person calls it.
    """

    suffixes: tuple[str, ...]
    markers: tuple[str, ...]
    opener: str
    says: str


FORMATS: Final[dict[str, Format]] = {
    "mcap": Format((".mcap",), (), "crosscue.replay.readers.mcap.reader:open_mcap", "MCAP"),
    "rosbag1": Format(
        (".bag", ".active"), (), "crosscue.replay.readers.rosbag1.reader:open_bag", "ROS 1 bag"
    ),
    "rosbag2-sqlite3": Format(
        (".db3",), (), "crosscue.replay.readers.rosbag2.db3:open_db3", "ROS 2 bag (sqlite3)"
    ),
    "rosbag2": Format(
        (),
        ("metadata.yaml", "*.db3", "*.mcap", "*.db3.zstd", "*.mcap.zstd"),
        "crosscue.replay.readers.rosbag2.folder:open_folder",
        "ROS 2 bag folder",
    ),
    "candump": Format(
        (".log", ".candump"),
        (),
        "crosscue.replay.readers.can_text.candump:open_candump",
        "candump log",
    ),
    "asc": Format((".asc",), (), "crosscue.replay.readers.can_text.asc:open_asc", "Vector ASC log"),
    "blf": Format((".blf",), (), "crosscue.replay.readers.blf.reader:open_blf", "Vector BLF log"),
    "trc": Format((".trc",), (), "crosscue.replay.readers.can_text.trc:open_trc", "PEAK TRC log"),
    "mf4": Format((".mf4",), (), "crosscue.replay.readers.mf4.reader:open_mf4", "ASAM MDF 4"),
    "comma2k19": Format(
        (),
        ("processed_log", "global_pose"),
        "crosscue.datasets.adapters.comma2k19:open_segment",
        "comma2k19 segment",
    ),
    "kitti-raw": Format(
        (),
        ("oxts/data", "oxts/timestamps.txt", "oxts/*.txt"),
        "crosscue.datasets.adapters.kitti:open_drive",
        "KITTI raw drive",
    ),
    "video": Format(
        (".mp4", ".avi", ".mkv", ".mov", ".hevc", ".h264"),
        (),
        "crosscue.replay.readers.images.video:open_video",
        "video with a time file",
    ),
    "images": Format(
        (),
        ("*.png", "*.jpg", "*.jpeg", "*.webp", "*.PNG", "*.JPG", "*.JPEG"),
        "crosscue.replay.readers.images.folder:open_images",
        "folder of images with a time file",
    ),
}
"""Folders are tried in this order, so data sets come before loose images."""


def open_log(path: Path | str, limits: Limits = DEFAULT) -> Log:
    """Open any recording by its suffix or, for a folder, by what lies in it.

    A text with ``://`` is a URL: see ``remote``. Of a log with a seal beside
    it, what is read is held against the seal, see ``sealed_log``.

    Raises:
        UnknownFormatError: No format fits; the message lists those there are.
        LogError: It cannot be opened: missing, no permission, not a file or folder, or not one
            readable record in it.
    """
    if isinstance(path, str) and "://" in path:
        from crosscue.replay.remote.logs import open_remote

        return open_remote(path, lambda fetched: open_log(fetched, limits), limits)
    from crosscue.replay.seal.log import with_seal

    place = Path(path)
    return with_seal(place, lambda: open_unsealed(place, limits))


def open_unsealed(path: Path, limits: Limits = DEFAULT) -> Log:
    """As ``open_log`` of a file or folder, without looking at its seal."""
    name = format_of(path)
    module, _, function = FORMATS[name].opener.partition(":")
    opener = cast("Callable[[Path, Limits], Log]", getattr(import_module(module), function))
    try:
        return opener(path, limits)
    except PermissionError:
        raise LogError(
            f"{path}: no permission to read it; check the file's owner and mode"
        ) from None
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}; check the path and the disk") from None


def format_of(path: Path) -> str:
    """Which of ``FORMATS`` a file or folder is.

    Raises:
        UnknownFormatError: No format fits; the message lists those there are.
        LogError: It is not there, or is no file or folder.
    """
    try:
        is_folder, is_file = path.is_dir(), path.is_file()
        if not is_folder and not is_file:
            what = "not a regular file or folder" if path.exists() else "no such file or folder"
            raise LogError(f"{path}: {what}; give a recording")
        if is_folder:
            # A glob in a folder that may not be read finds nothing, and says nothing.
            next(path.iterdir(), None)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}; check the path") from None
    suffix = path.suffix.lower()
    for name, known in FORMATS.items():
        if is_file and suffix in known.suffixes:
            return name
        if is_folder and any(_holds(path, marker) for marker in known.markers):
            return name
    wanted = ", ".join(
        f"{f.says} ({' '.join(f.suffixes) if f.suffixes else 'folder'})" for f in FORMATS.values()
    )
    what = (
        "a folder without any known recording in it" if is_folder else f"suffix {suffix!r} unknown"
    )
    raise UnknownFormatError(f"{path}: {what}; there are: {wanted}")


def _holds(folder: Path, marker: str) -> bool:
    try:
        return next(folder.glob(marker), None) is not None
    except OSError:
        return False


@contextmanager
def open_logs(paths: Sequence[Path | str], limits: Limits = DEFAULT) -> Iterator[tuple[Log, ...]]:
    """Several logs of one drive, open as long as the ``with`` block lasts; as ``open_log``."""
    with ExitStack() as stack:
        logs = tuple(stack.enter_context(open_log(path, limits)) for path in paths)
        with unless_damaged(logs):
            yield logs


@contextmanager
def unless_damaged(logs: Sequence[Log]) -> Iterator[None]:
    """Blame the log, not who names its topics, where what is missing may be in the damaged part.

    Raises:
        LogError: Instead of a ``MissingTopicError``, when a log turns out to be damaged.
    """
    try:
        yield
    except MissingTopicError as error:
        for log in logs:
            ledger = Ledger(str(log.path))
            for _ in log.read(ledger):
                pass
            for loss in ledger.drops():
                detail = f" ({loss.detail})" if loss.detail else ""
                raise LogError(f"{log.path}: {loss.reason}{detail}; so {error}") from None
        raise
