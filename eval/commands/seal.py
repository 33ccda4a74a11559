"""Keep a hash of each MiB of a log beside it, so that later damage is seen and located.

examples:
  crosscue seal drive.bag can0.log        writes drive.bag.seal and can0.log.seal
  crosscue seal --check drive.bag         verifies all of it
  crosscue seal segment/                  a folder: segment.seal, over all of its files

ROS 1 bags, .db3, candump, ASC and TRC logs, videos and .npy data sets carry no checksum: a flipped
payload byte cannot be seen. Seal a log once it is known to be right. Every later command that reads
it checks what it reads and reports the damaged byte ranges. An existing seal that the log differs
from is not replaced without --overwrite: check first. URLs cannot be sealed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.replay.errors import CrosscueError, LogError, UsageError
from crosscue.replay.formats import format_of
from crosscue.replay.safe_text import visible
from crosscue.replay.seal.seal import HASH, SUFFIX, Check, Sealing, seal_over, seal_path, write_seal

SHOWN = 20
MEGABYTE = 1_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("logs", nargs="+", metavar="LOG", help="recordings on this machine")
    parser.add_argument("--check", action="store_true", help="verify against the seal")
    parser.add_argument(
        "--overwrite", action="store_true", help="replace a seal that does not match the log"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Seal or check each log.

    Returns:
        0 when all is well, 3 when a checked log differs from its seal.
    """
    logs = [_place(text) for text in args.logs]
    work = _check if args.check else _seal
    results = [work(log, args) for log in logs]
    if args.json:
        print_json({"logs": results})
    return 0 if all(result["is_whole"] for result in results) else 3


def _place(text: str) -> Path:
    if "://" in text:
        raise UsageError(f"{text}: a URL cannot be sealed; fetch the log and seal the file")
    log = Path(text)
    if log.name.endswith(SUFFIX):
        raise UsageError(f"{log}: is a seal itself; name the log, {log.with_suffix('')}")
    format_of(log)
    return log


def _seal(log: Path, args: argparse.Namespace) -> dict[str, object]:
    sealing = Sealing(log)

    def at() -> Done:
        return Done(sealing.done / MEGABYTE, sealing.total / MEGABYTE, "MB")

    for _ in with_progress(sealing, at, args, f"sealing {log.name}"):
        pass
    seal, path = sealing.seal, seal_path(log)
    is_new = write_seal(log, seal, overwrite=args.overwrite)
    if not args.json and not args.quiet:
        what = "written" if is_new else "unchanged, the log matches it"
        print(
            visible(f"{path}: {what}; {len(seal.files)} files, {sealing.total} bytes, {HASH} of ")
            + f"{seal.blocks} blocks of 1 MiB"
        )
    return {
        "log": str(log),
        "seal": str(path),
        "is_new": is_new,
        "is_whole": True,
        "files": len(seal.files),
        "bytes": sealing.total,
        "blocks": seal.blocks,
    }


def _check(log: Path, args: argparse.Namespace) -> dict[str, object]:
    found = seal_over(log)
    if found is None:
        name = seal_path(log).name
        raise CrosscueError(f"{log}: not sealed, there is no {name}; run 'crosscue seal'")
    path, seal = found
    try:
        check = Check(log, seal)
    except OSError as error:
        raise LogError(f"{error.filename or log}: {error.strerror or error}") from None

    def at() -> Done:
        return Done(check.checked, seal.blocks, "MiB")

    for _ in with_progress(check.everything(), at, args, f"checking {log.name}"):
        pass
    spans = list(check.damaged())
    is_whole = not spans and not check.oddities
    if not args.json:
        for sentence in check.oddities:
            print(visible(f"{log}: {sentence}"), file=sys.stderr)
        for span in spans[:SHOWN]:
            text = f"{log}: {span.name}: bytes {span.start} to {span.stop} differ from the seal"
            print(visible(text), file=sys.stderr)
        if len(spans) > SHOWN:
            print(f"and {len(spans) - SHOWN} more; --json lists them", file=sys.stderr)
        if is_whole and not args.quiet:
            print(visible(f"{log}: all {seal.blocks} blocks match the seal of {seal.sealed_at}"))
    return {
        "log": str(log),
        "seal": str(path),
        "sealed_at": seal.sealed_at,
        "is_whole": is_whole,
        "blocks": seal.blocks,
        "checked": check.checked,
        "files_changed": list(check.oddities),
        "damaged": [{"file": s.name, "from": s.start, "to": s.stop} for s in spans],
    }
