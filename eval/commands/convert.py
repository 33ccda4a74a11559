"""Any supported log or data set to MCAP with standard ROS 2 types, message for message.

examples:
  crosscue convert drive.bag -o drive.mcap
  crosscue convert can0.log -o can0.mcap --from 10 --to 70
  crosscue convert segment/ -o segment.mcap --topics wheels compass --compression lz4
  crosscue convert damaged.mcap -o rescued.mcap --salvage

ROS 2 messages are copied byte for byte and ROS 1 messages transcribed. CAN frames become
can_msgs/msg/Frame (CAN FD: crosscue_msgs/msg/CanFdFrame on TOPIC/fd), pictures
sensor_msgs/msg/CompressedImage, Image or foxglove_msgs/msg/CompressedVideo, tables the standard
type that holds all their columns, or else crosscue_msgs/msg/TOPIC with one field a column.
The written file is read back and its messages counted before the command says that it is done.
What can be read of a damaged log is written, and the exit status is 3; --salvage prints every
damaged place, with its bytes where the format has them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

from crosscue.eval.commands.shared.options import (
    add_part_arguments,
    limits_of,
    print_json,
    selection_of,
)
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.eval.pipeline.empty_result import empty_result
from crosscue.replay.columns import Topic
from crosscue.replay.errors import LogError, OutputError, UsageError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger, TopicAccount
from crosscue.replay.log import Log, Selection
from crosscue.replay.opening import open_log, unless_damaged
from crosscue.replay.safe_text import table, terminal_width, visible, wrapped
from crosscue.replay.seal.seal import seal_path
from crosscue.replay.write.convert import LogWriter

NOT_ASKED = frozenset({NOT_ASKED_TIME, NOT_ASKED_TOPIC})
SHOWN = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("log", metavar="LOG", help="a recording, a data-set folder or a URL")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT.mcap", help="MCAP file to write"
    )
    add_part_arguments(parser)
    parser.add_argument(
        "--compression",
        choices=("zstd", "lz4", "none"),
        default="zstd",
        help="compression of the chunks (default: zstd)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing OUT.mcap")
    parser.add_argument(
        "--salvage",
        action="store_true",
        help="list every damaged place where messages were dropped",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Convert, read back, print the account.

    Returns:
        0 when every row that was asked for is in the file, 3 when some are dropped or skipped.
    """
    _check_output(args)
    with open_log(args.log, limits_of(args)) as log, unless_damaged([log]):
        selection = selection_of(args, [log])
        ledger = Ledger(args.log)
        writer = LogWriter(
            args.output, ledger, compression=args.compression, overwrite=args.overwrite
        )
        with writer:
            _copy(log, selection, ledger, writer, args)
            _check_identity(ledger, writer)
            if not writer.written and _is_whole(ledger):
                raise empty_result("no row to write", [log], selection)
    _read_back(args.output, writer)
    if args.json:
        print_json(_as_json(args, ledger, writer))
    elif not args.quiet:
        _print(args, ledger, writer)
    return 0 if _is_whole(ledger) else 3


def _check_output(args: argparse.Namespace) -> None:
    if args.output.suffix.lower() != ".mcap":
        raise UsageError(f"{args.output}: want a name that ends in .mcap")
    log = Path(args.log)
    if args.output.exists() and log.exists() and args.output.samefile(log):
        raise UsageError(f"{args.output}: is the log itself; give another name")
    if seal_path(args.output).exists():
        raise OutputError(
            f"{seal_path(args.output)}: seals what was there before; delete it, or give another -o"
        )


def _copy(
    log: Log, selection: Selection, ledger: Ledger, writer: LogWriter, args: argparse.Namespace
) -> None:
    known: set[Topic] = set()
    declared = sum(topic.declared or 0 for topic in log.topics)
    done = 0

    def at() -> Done:
        return Done(done, declared, "rows")

    blocks = ledger.handing_on(log.read(ledger, selection))
    for block in with_progress(blocks, at, args, "converting"):
        done += len(block)
        # A topic may come to light only while a damaged log is read.
        for topic in log.topics:
            if topic not in known:
                known.add(topic)
                writer.add_topic(topic)
        writer.write(block)


def _check_identity(ledger: Ledger, writer: LogWriter) -> None:
    """Found = written + skipped, for every topic."""
    ledger.check({name: writer.kept[name] for name in ledger.accounts})


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
    return ledger.is_whole and not any(_refused(a) for a in ledger.accounts.values())


def _refused(account: TopicAccount) -> Mapping[str, int]:
    return {reason: n for reason, n in account.skipped.items() if reason not in NOT_ASKED}


def _lost(account: TopicAccount) -> int:
    return account.dropped.total()


def _as_json(args: argparse.Namespace, ledger: Ledger, writer: LogWriter) -> object:
    return {
        "log": args.log,
        "output": str(args.output),
        "bytes": args.output.stat().st_size,
        "integrity": ledger.integrity,
        "is_whole": _is_whole(ledger),
        "written": {
            visible(name): {"type": writer.types[name], "messages": count}
            for name, count in writer.written.items()
        },
        "topics": {
            visible(name): {
                "declared": account.declared,
                "found": account.found,
                "written": writer.kept[name],
                "skipped": dict(account.skipped),
                "dropped": dict(account.dropped),
                "dropped_unknown": account.dropped_unknown,
            }
            for name, account in ledger.accounts.items()
        },
        "notices": [visible(notice) for notice in ledger.notices],
        "details": [
            {
                "topic": visible(detail.topic),
                "reason": detail.reason,
                "detail": visible(detail.detail),
                "count": detail.count,
                "t_ns": detail.t_ns,
                "is_dropped": detail.is_dropped,
            }
            for detail in (ledger.details if args.salvage else ())
        ],
    }


def _print(args: argparse.Namespace, ledger: Ledger, writer: LogWriter) -> None:
    width = terminal_width()
    rows = [
        [
            name,
            writer.types.get(name, "-"),
            str(account.found),
            str(writer.kept[name]),
            str(account.skipped.total()),
            str(_lost(account)) + "+" * bool(account.dropped_unknown),
        ]
        for name, account in ledger.accounts.items()
    ]
    head = ["topic", "type", "found", "written", "skipped", "dropped"]
    print("\n".join(table(head, rows, width, (0, 1))))
    size = args.output.stat().st_size / 1e6
    print(
        f"{visible(str(args.output))}: {writer.written.total()} messages, {size:.1f} MB, read back"
    )
    for notice in ledger.notices[:SHOWN]:
        print(wrapped(visible(notice), width), file=sys.stderr)
    shown = ledger.details if args.salvage else ledger.details[:SHOWN]
    for detail in shown:
        verb = "dropped" if detail.is_dropped else "skipped"
        count = "?" if detail.count is None else detail.count
        text = f"{detail.topic}: {count} {verb}: {detail.reason}; {detail.detail}".rstrip("; ")
        print(wrapped(visible(text), width), file=sys.stderr)
    if len(shown) < len(ledger.details):
        print(f"and {len(ledger.details) - len(shown)} more places", file=sys.stderr)
    if not ledger.is_whole and not args.salvage:
        print(
            "the log is damaged; what could be read was written; crosscue convert --salvage lists "
            "every damaged place",
            file=sys.stderr,
        )
