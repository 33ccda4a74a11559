"""Any log as one MCAP file of standard ROS 2 types."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.eval.interface.logs.log import NOT_ASKED, Log, opened
from crosscue.eval.interface.show import listing
from crosscue.eval.pipeline.empty_result import empty_result
from crosscue.replay.base import Ledger, LogError, OutputError, Topic, UsageError, visible
from crosscue.replay.logs.opening import open_log
from crosscue.replay.seal.seal import seal_path
from crosscue.replay.write.convert import LogWriter
from crosscue.replay.write.mcap import Compression

HEAD: Final = ("topic", "type", "found", "written", "skipped", "dropped")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Converted:
    """A log that was converted; printed as a table of its topics.

    Attributes:
        log: What was read, as given.
        path: The file that was written.
        size_bytes: Of that file.
        written: Messages by topic, as they are called in the file.
        types: From topic in the file to its ROS 2 type.
        kept: Messages by topic, as they are called in the log.
        ledger: What became of every row of the log.
    """

    log: str
    path: Path
    size_bytes: int
    written: Counter[str]
    types: Mapping[str, str]
    kept: Counter[str]
    ledger: Ledger

    @property
    def is_whole(self) -> bool:
        """Every row that was asked for is in the file."""
        return _is_whole(self.ledger)

    @property
    def notices(self) -> tuple[str, ...]:
        """What the reader has to say about the log."""
        return tuple(visible(notice) for notice in self.ledger.notices)

    @property
    def places(self) -> list[dict[str, object]]:
        """Where rows were dropped or skipped, and why."""
        return [
            {
                "topic": visible(detail.topic),
                "reason": detail.reason,
                "detail": visible(detail.detail),
                "count": detail.count,
                "t_ns": detail.t_ns,
                "is_dropped": detail.is_dropped,
            }
            for detail in self.ledger.details
        ]

    @property
    def places_text(self) -> list[str]:
        """The same in a line each."""
        lines = []
        for detail in self.ledger.details:
            verb = "dropped" if detail.is_dropped else "skipped"
            count = "?" if detail.count is None else detail.count
            text = f"{detail.topic}: {count} {verb}: {detail.reason}; {detail.detail}"
            lines.append(visible(text.rstrip("; ")))
        return lines

    def as_dict(self) -> dict[str, object]:
        """Counts and account as dictionaries, lists and scalars; without the places."""
        return {
            "log": self.log,
            "output": str(self.path),
            "bytes": self.size_bytes,
            "integrity": self.ledger.integrity,
            "is_whole": self.is_whole,
            "written": {
                visible(name): {"type": self.types[name], "messages": count}
                for name, count in self.written.items()
            },
            "topics": {
                visible(name): {
                    "declared": account.declared,
                    "found": account.found,
                    "written": self.kept[name],
                    "skipped": dict(account.skipped),
                    "dropped": dict(account.dropped),
                    "dropped_unknown": account.dropped_unknown,
                }
                for name, account in self.ledger.accounts.items()
            },
            "notices": list(self.notices),
        }

    def __repr__(self) -> str:
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
        return (
            f"{listing(HEAD, rows, 2)}\n"
            f"{visible(str(self.path))}: {count} messages, {size:.1f} MB, read back"
        )


def convert(
    log: Log | Path | str,
    output: Path | str,
    *,
    compression: Compression = "zstd",
    overwrite: bool = False,
    on_rows: Callable[[int, int], None] = lambda done, of: None,
) -> Converted:
    """Write a log as one MCAP file with standard ROS 2 types, message for message.

    ROS 2 messages are copied byte for byte, ROS 1 messages transcribed, everything else written in
    the standard type that holds it. The file is read back and its messages are counted.

    Args:
        log: One log, or its path; ``log.part(...)`` for a part of it.
        output: The file; its name ends in ``.mcap``.
        compression: Of the chunks: ``zstd``, ``lz4`` or ``none``.
        overwrite: Replace a file that is there.
        on_rows: Called with the rows that are done, and those that the log declares.

    Raises:
        UsageError: Several logs, another suffix, or the output is the log itself.
        OutputError: The output exists, has a seal, cannot be written, or reads back differently.
        EmptyResultError: No row to write.
        LogError: Damage has left none.
    """
    path = Path(output)
    with opened(log) as drive:
        if len(drive.logs) != 1:
            raise UsageError(f"convert: {len(drive.logs)} logs; expected one, convert each")
        _check_output(path, drive.paths[0])
        ledger = Ledger(drive.paths[0])
        with LogWriter(path, ledger, compression=compression, overwrite=overwrite) as writer:
            _copy(drive, ledger, writer, on_rows)
            # Found = written + skipped, for every topic.
            ledger.check({name: writer.kept[name] for name in ledger.accounts})
            is_read = any(account.handed_on for account in ledger.accounts.values())
            if not writer.written and (_is_whole(ledger) or not (is_read or _refused(ledger))):
                raise empty_result("no row to write", drive.logs, drive.selection)
        paths = drive.paths
    _read_back(path, writer)
    size = path.stat().st_size
    return Converted(paths[0], path, size, writer.written, writer.types, writer.kept, ledger)


def _check_output(output: Path, log: str) -> None:
    if output.suffix.lower() != ".mcap":
        raise UsageError(f"{output}: expected a name that ends in .mcap")
    if output.exists() and Path(log).exists() and output.samefile(log):
        raise UsageError(f"{output}: is the log itself; give another name")
    if seal_path(output).exists():
        raise OutputError(
            f"{seal_path(output)}: seals what was there before; delete it, or give another -o"
        )


def _copy(
    drive: Log, ledger: Ledger, writer: LogWriter, on_rows: Callable[[int, int], None]
) -> None:
    (log,) = drive.logs
    known: set[Topic] = set()
    declared = sum(topic.declared or 0 for topic in log.topics)
    done = 0
    for block in ledger.handing_on(log.read(ledger, drive.selection)):
        done += len(block)
        # A topic may come to light only while a damaged log is read.
        for topic in log.topics:
            if topic not in known:
                known.add(topic)
                writer.add_topic(topic)
        writer.write(block)
        on_rows(done, declared)


def _read_back(path: Path, writer: LogWriter) -> None:
    """Count what the file holds, checksums verified.

    Raises:
        OutputError: It does not hold what was written; the file is removed.
    """
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
        raise OutputError(f"{path}: reads back differently than written; check the disk, try again")


def _is_whole(ledger: Ledger) -> bool:
    return ledger.is_whole and not _refused(ledger)


def _refused(ledger: Ledger) -> bool:
    """Were rows skipped that were asked for?"""
    return any(
        reason not in NOT_ASKED
        for account in ledger.accounts.values()
        for reason in account.skipped
    )
