"""Convert any log to one MCAP file with standard ROS 2 types."""

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
    """Result of a conversion; its repr is a table of topics.

    Attributes:
        log: Path or URL of the log, as passed.
        path: The written file.
        size_bytes: Size of that file.
        written: Number of messages by topic name in the file.
        types: ROS 2 type by topic name in the file.
        kept: Number of messages by topic name in the log.
        ledger: Account of every row of the log.
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
        """True if every selected row is in the file."""
        return _is_whole(self.ledger)

    @property
    def notices(self) -> tuple[str, ...]:
        """Remarks of the reader on the log."""
        return tuple(visible(notice) for notice in self.ledger.notices)

    @property
    def places(self) -> list[dict[str, object]]:
        """Return the places where rows were dropped or skipped, with reasons."""
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
        """Return the same as ``places``, one line each."""
        lines = []
        for detail in self.ledger.details:
            verb = "dropped" if detail.is_dropped else "skipped"
            count = "?" if detail.count is None else detail.count
            text = f"{detail.topic}: {count} {verb}: {detail.reason}; {detail.detail}"
            lines.append(visible(text.rstrip("; ")))
        return lines

    def as_dict(self) -> dict[str, object]:
        """Return counts and account, without places, as dictionaries, lists and scalars."""
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

    ROS 2 messages are copied byte for byte, ROS 1 messages are transcribed, and everything else is
    written as the standard type for its contents. The file is read back and its messages counted.

    Args:
        log: One log, or its path; ``log.part(...)`` for a part of it.
        output: File to write; its name ends in ``.mcap``.
        compression: Compression of the chunks: ``zstd``, ``lz4`` or ``none``.
        overwrite: Replace an existing file.
        on_rows: Called with the number of rows done, and the number that the log declares.

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
        with LogWriter(path, ledger, compression=compression, overwrite=overwrite) as writer:
            _copy(drive, ledger, writer, on_rows)
            # Rows found = rows written + rows skipped, for every topic.
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
            f"{seal_path(output)}: seals an earlier file; delete the seal, or use another -o"
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
        # In a damaged log, a topic may be found only while reading.
        for topic in log.topics:
            if topic not in known:
                known.add(topic)
                writer.add_topic(topic)
        writer.write(block)
        on_rows(done, declared)


def _read_back(path: Path, writer: LogWriter) -> None:
    """Count the messages of the written file, and verify its checksums.

    Raises:
        OutputError: The counts differ; the file is removed.
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
