"""Convert any log to one MCAP file with standard ROS 2 types."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Final

from crosscue.eval.pipeline.empty_result import empty_result
from crosscue.replay.columns import Topic
from crosscue.replay.errors import LogError, OutputError, UsageError
from crosscue.replay.ledger import Detail, Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted, terminal_width, visible, wrapped
from crosscue.replay.seal.seal import seal_path
from crosscue.replay.write.convert import LogWriter
from crosscue.results import HIDDEN, Result, json_key, listing
from crosscue.verb import Option

from .log import NOT_ASKED, Log, LogGiven, opened

SHOWN: Final = 20
HEAD: Final = ("topic", "type", "found", "written", "skipped", "dropped")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Converted(Result):
    """Result of a conversion; its repr is a table of topics.

    Attributes:
        log: Path or URL of the log, as passed.
        path: The written file.
        size_bytes: Size of that file.
        written: Number of messages by topic name in the file.
        types: ROS 2 type by topic name in the file.
        kept: Number of messages by topic name in the log.
        ledger: Account of every row of the log.
        salvage: True to print all damaged places.
    """

    log: str
    path: Path = field(metadata=json_key("output"))
    size_bytes: int = field(metadata=json_key("bytes"))
    written: Counter[str] = field(metadata=HIDDEN)
    types: Mapping[str, str] = field(metadata=HIDDEN)
    kept: Counter[str] = field(metadata=HIDDEN)
    ledger: Ledger = field(metadata=HIDDEN)
    salvage: bool = field(metadata=HIDDEN)

    also: ClassVar = {
        "integrity": "integrity",
        "is_whole": "is_whole",
        "notices": "notices",
        "written": "messages_by_topic",
        "topics": "accounts",
        "details": "places",
    }

    @property
    def is_whole(self) -> bool:
        """True if every selected row is in the file."""
        return _is_whole(self.ledger)

    @property
    def integrity(self) -> str:
        """Verification of the log."""
        return self.ledger.integrity

    @property
    def notices(self) -> tuple[str, ...]:
        """Remarks of the reader on the log."""
        return tuple(visible(notice) for notice in self.ledger.notices)

    @property
    def messages_by_topic(self) -> dict[str, dict[str, object]]:
        """Type and number of messages of each topic in the file."""
        return {
            name: {"type": self.types[name], "messages": count}
            for name, count in self.written.items()
        }

    @property
    def accounts(self) -> dict[str, dict[str, object]]:
        """Account of each topic of the log."""
        return {
            name: {
                "declared": account.declared,
                "found": account.found,
                "written": self.kept[name],
                "skipped": dict(account.skipped),
                "dropped": dict(account.dropped),
                "dropped_unknown": account.dropped_unknown,
            }
            for name, account in self.ledger.accounts.items()
        }

    @property
    def places(self) -> tuple[Detail, ...]:
        """Places where rows were dropped or skipped, with ``salvage``."""
        return tuple(self.ledger.details) if self.salvage else ()

    def lines(self) -> Iterator[str]:
        """Yield a table of topics, and the size of the file."""
        rows = [
            (
                name,
                self.types.get(name, "-"),
                str(account.found),
                str(self.kept[name]),
                str(account.skipped.total()),
                str(account.dropped.total()) + "+" * bool(account.dropped_unknown),
            )
            for name, account in self.ledger.accounts.items()
        ]
        count, size = self.written.total(), self.size_bytes / 1e6
        yield listing(HEAD, rows, 2)
        yield f"{visible(str(self.path))}: {counted(count, 'message')}, {size:.1f} MB, read back"

    def messages(self) -> Iterator[str]:
        """Yield notices and damaged places."""
        places = [_place_text(detail) for detail in self.ledger.details]
        shown = places if self.salvage else places[:SHOWN]
        for line in (*self.notices[:SHOWN], *shown):
            yield wrapped(line, terminal_width())
        if len(shown) < len(places):
            yield f"and {counted(len(places) - len(shown), 'more place')}"
        if not self.ledger.is_whole and not self.salvage:
            yield (
                "the log is damaged; its readable part was written; crosscue convert --salvage "
                "lists every damaged place"
            )


def _place_text(detail: Detail) -> str:
    verb = "dropped" if detail.is_dropped else "skipped"
    count = "?" if detail.count is None else detail.count
    text = f"{detail.topic}: {count} {verb}: {detail.reason}; {detail.detail}"
    return visible(text.rstrip("; "))


def convert(
    log: LogGiven,
    output: Annotated[Path | str, Option(metavar="OUT.mcap")],
    *,
    salvage: bool = False,
    overwrite: bool = False,
) -> Converted:
    """Convert a log or data set to MCAP with ROS 2 types, message for message.

    ROS 2 messages are copied byte for byte, and ROS 1 messages are transcribed. CAN frames become
    can_msgs/msg/Frame (CAN FD: crosscue_msgs/msg/CanFdFrame on TOPIC/fd). Pictures become
    sensor_msgs/msg/CompressedImage, Image or foxglove_msgs/msg/CompressedVideo. Tables become the
    standard type that has all their columns, or else crosscue_msgs/msg/TOPIC with one field per
    column. The written file is read back and its messages are counted before success is reported.
    For a damaged log, the readable part is written, and the exit status is 3.

    Examples:
        crosscue convert drive.bag -o drive.mcap
        crosscue convert can0.log -o can0.mcap --from 10 --to 70
        crosscue convert segment/ -o segment.mcap --topics wheels compass
        crosscue convert damaged.mcap -o rescued.mcap --salvage

    Args:
        log: One log, or its path.
        output: MCAP file to write.
        salvage: List every damaged place, with its byte range if the format has byte ranges.
        overwrite: Replace an existing file.

    Raises:
        UsageError: There are several logs, or the output has another suffix or is the log itself.
        OutputError: The output exists, has a seal, cannot be written, or differs when read back.
        EmptyResultError: There is no row to write.
        LogError: Because of damage, no row can be read.
    """
    path = Path(output)
    with opened(log) as drive:
        if len(drive.logs) != 1:
            raise UsageError(f"convert: expected one log, found {len(drive.logs)}; convert each")
        _check_output(path, drive.paths[0])
        ledger = Ledger(drive.paths[0])
        with LogWriter(path, ledger, overwrite=overwrite) as writer:
            _copy(drive, ledger, writer)
            # Rows found = rows written + rows skipped, for every topic.
            ledger.check({name: writer.kept[name] for name in ledger.accounts})
            is_read = any(account.handed_on for account in ledger.accounts.values())
            if not writer.written and (_is_whole(ledger) or not (is_read or _refused(ledger))):
                raise empty_result("no row to write", drive.logs, drive.selection)
        name = drive.paths[0]
    _read_back(path, writer)
    size = path.stat().st_size
    return Converted(name, path, size, writer.written, writer.types, writer.kept, ledger, salvage)


def _check_output(output: Path, log: str) -> None:
    if output.suffix.lower() != ".mcap":
        raise UsageError(f"{output}: expected a name that ends in .mcap")
    if output.exists() and Path(log).exists() and output.samefile(log):
        raise UsageError(f"{output}: is the log itself; give another name")
    if seal_path(output).exists():
        raise OutputError(
            f"{seal_path(output)}: seals an earlier file; delete the seal, or use another -o"
        )


def _copy(drive: Log, ledger: Ledger, writer: LogWriter) -> None:
    (log,) = drive.logs
    known: set[Topic] = set()
    declared = sum(topic.declared or 0 for topic in log.topics)
    done = 0
    for block in ledger.handing_on(log.read(ledger, drive.selection)):
        done += len(block)
        # In a damaged log, a topic may be found only while reading.
        for topic in log.topics:
            if topic not in known:
                known.add(topic)
                writer.add_topic(topic)
        writer.write(block)
        emit(Progress("converting", done, declared, "rows"))


def _read_back(path: Path, writer: LogWriter) -> None:
    """Count the messages of the written file, and verify its checksums."""
    held = Ledger(str(path))
    try:
        with open_log(path) as log:
            for _ in log.read(held):
                pass
        found = {name: account.used for name, account in held.accounts.items() if account.used}
        right = held.is_whole and found == dict(writer.written)
    except LogError:
        right = False
    if not right:
        path.unlink(missing_ok=True)
        raise OutputError(
            f"{path}: read back, differs from what was written; check the disk, and try again"
        )


def _is_whole(ledger: Ledger) -> bool:
    return ledger.is_whole and not _refused(ledger)


def _refused(ledger: Ledger) -> bool:
    """Return whether rows of the selection were skipped."""
    return any(
        reason not in NOT_ASKED
        for account in ledger.accounts.values()
        for reason in account.skipped
    )
