"""Detect: run detectors over a drive's camera; detections, road shares and cues into a run folder.

A detector is a name, one of the vehicle file's [detectors.NAME], a module:factory, or a model card
(.toml). What was found in a picture is kept by content, so a second run is quick.

example:
  crosscue detect drive.mcap --vehicle car.toml --detectors yolox.toml,signs -o runs/drive
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from crosscue.detectors.registry import chosen
from crosscue.eval.detect_stage import DetectOutcome, choices_of, detect_drive
from crosscue.eval.plain_text import visible
from crosscue.eval.replay_drive import account_of
from crosscue.replay.errors import UsageError
from crosscue.replay.log import open_logs
from crosscue.replay.run_folder import create
from crosscue.replay.vehicle import Vehicle, load

from .common import add_log_arguments, print_json, selection_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    add_log_arguments(parser)
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="RUN", help="run folder"
    )
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="the vehicle file")
    parser.add_argument(
        "--detectors", metavar="NAMES",
        help="comma-separated; all of the vehicle file's, if left out",
    )  # fmt: skip
    parser.add_argument(
        "--draw", type=int, default=0, metavar="N",
        help="write N pictures with what was found, of every tenth frame",
    )  # fmt: skip
    parser.add_argument("--cache", type=Path, metavar="FILE", help="where results are kept")
    parser.add_argument("--no-cache", action="store_true", help="run every detector again")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier run")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Detect; 3 when something was lost."""
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    if args.draw < 0:
        raise UsageError(f"--draw {args.draw}: want 0 or more")
    sections = choices_of(vehicle)
    names = ",".join(sections) if args.detectors is None else args.detectors
    choices = chosen(names, sections)
    cache = None if args.no_cache else (args.cache or default_cache())
    with ExitStack() as stack:
        logs = open_logs(args.logs)
        for log in logs:
            stack.enter_context(log)
        selection = selection_of(args, logs)
        folder = create(args.output, overwrite=args.overwrite)
        progress = _Progress(not args.quiet and sys.stderr.isatty())
        outcome = detect_drive(
            logs, vehicle, folder, selection, choices, cache, args.draw, progress
        )
        progress.end()
    if args.json:
        print_json(_as_json(outcome))
    elif not args.quiet:
        print(summary(outcome))
    return outcome.exit_status


def default_cache() -> Path:
    """Where results are kept unless told otherwise."""
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "crosscue" / "detections.sqlite"


class _Progress:
    """One line on a terminal with the frames done."""

    def __init__(self, is_shown: bool) -> None:
        self._is_shown = is_shown
        self._frames = 0
        self._shown = 0.0

    def __call__(self, t_ns: int) -> None:
        self._frames += 1
        now = time.monotonic()
        if self._is_shown and now - self._shown > 0.2:
            self._shown = now
            sys.stderr.write(f"\rdetecting: {self._frames} frames \x1b[K")
            sys.stderr.flush()

    def end(self) -> None:
        """Take the line away."""
        if self._is_shown:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()


def summary(outcome: DetectOutcome) -> str:
    """What happened, for a person."""
    counts, ledger = outcome.counts, outcome.ledger
    lines = [f"run      {outcome.run.path}", f"log      {ledger.log}"]
    lines.append(f"frames   {counts.frames:,} in {outcome.seconds:.2f} s")
    for name, ran in counts.ran.items():
        lines.append(f"  {name}: ran on {ran:,}, {counts.from_cache[name]:,} from the cache")
    lines += [f"found    {what}: {count:,}" for what, count in sorted(outcome.objects.items())]
    lines += [f"cue      {cue}: in {count:,} frames" for cue, count in outcome.cues.items()]
    for topic, account in sorted(ledger.accounts.items()):
        lines += [f"skipped  {topic}: {n:,} {why}" for why, n in sorted(account.skipped.items())]
    for loss in ledger.losses():
        lines.append(f"lost     {loss.topic or 'the log'}: {loss.count or 'some'} {loss.reason}")
    lines += [f"note     {sentence}" for sentence in (*ledger.notices, *outcome.notices)]
    return "\n".join(visible(line) for line in lines)


def _as_json(outcome: DetectOutcome) -> dict[str, object]:
    return {
        "run": str(outcome.run.path),
        "logs": [account_of(outcome.ledger)],
        "frames": outcome.counts.frames,
        "ran": outcome.counts.ran,
        "from_cache": outcome.counts.from_cache,
        "objects": outcome.objects,
        "cues": outcome.cues,
        "notices": list(outcome.notices),
        "seconds": outcome.seconds,
    }
