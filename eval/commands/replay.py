"""Replay a drive: read its logs once, estimate the pose, write a run folder.

example:
  crosscue replay drive.mcap --vehicle car.toml -o runs/drive
"""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import ExitStack
from pathlib import Path

from crosscue.eval.landmark_stage import matcher_for, open_for
from crosscue.eval.plain_text import terminal_width, visible, wrapped
from crosscue.eval.replay_drive import Outcome, account_of, replay_drive
from crosscue.replay.log import open_logs
from crosscue.replay.run_folder import create
from crosscue.replay.vehicle import Vehicle, load

from .common import add_log_arguments, first_ns, print_json, selection_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    add_log_arguments(parser)
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="RUN", help="run folder"
    )
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="the vehicle file")
    parser.add_argument(
        "--landmarks", type=Path, metavar="DB",
        help="landmark database that camera frames are compared with",
    )  # fmt: skip
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier run")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Replay; 3 when something was lost."""
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    with ExitStack() as stack:
        logs = open_logs(args.logs)
        for log in logs:
            stack.enter_context(log)
        selection = selection_of(args, logs)
        landmarks = None
        if args.landmarks:
            landmarks = stack.enter_context(open_for(args.landmarks, matcher_for(vehicle)))
        run_folder = create(args.output, overwrite=args.overwrite)
        progress = _Progress(0 if args.quiet or not sys.stderr.isatty() else first_ns(logs))
        outcome = replay_drive(logs, vehicle, run_folder, selection, progress, landmarks)
        progress.end()
    if args.json:
        print_json(_as_json(outcome))
    elif not args.quiet:
        print(summary(outcome))
    return outcome.exit_status


class _Progress:
    """One line on a terminal with the log time reached."""

    def __init__(self, start_ns: int) -> None:
        self._start_ns = start_ns
        self._shown = 0.0

    def __call__(self, t_ns: int) -> None:
        now = time.monotonic()
        if self._start_ns and now - self._shown > 0.2:
            self._shown = now
            sys.stderr.write(f"\rreplaying: {(t_ns - self._start_ns) * 1e-9:.0f} s of log \x1b[K")
            sys.stderr.flush()

    def end(self) -> None:
        """Take the line away."""
        if self._start_ns:
            sys.stderr.write("\r\x1b[K")


def summary(outcome: Outcome) -> str:
    """What happened, for a person, in 80 columns."""
    lines = [f"run      {outcome.run.path}"]
    for ledger in outcome.ledgers:
        used = sum(a.used for a in ledger.accounts.values())
        found = sum(a.in_file for a in ledger.accounts.values())
        lines.append(f"log      {ledger.log}")
        lines.append(f"         {used:,} rows used of {found:,}")
        lines.append(f"         integrity: {ledger.integrity}")
        lines += [f"  lost   {_loss(d.topic, d.reason, d.count)}" for d in ledger.losses()]
        lines += [f"  note   {sentence}" for sentence in ledger.notices]
    if outcome.rows:
        lines += [
            f"pose     {outcome.rows:,} rows over {outcome.travelled_m:.0f} m in "
            f"{outcome.drive_seconds:.0f} s;",
            f"         2-sigma ellipse {outcome.major_axis_m:.1f} m long at the end",
        ]
    else:
        lines.append("pose     none")
    if outcome.landmark_counts:
        lines.append(f"marks    {_landmarks(outcome.landmark_counts)}")
    lines += [f"  note   {sentence}" for sentence in outcome.notices]
    speed = outcome.drive_seconds / max(outcome.seconds, 1e-9)
    lines.append(f"took     {outcome.seconds:.2f} s, {speed:.0f} times real time")
    width = min(terminal_width(), 80)
    return "\n".join(
        wrapped(visible(line[9:]), width, lead=line[:9]) if len(line) > width else visible(line)
        for line in lines
    )


def _landmarks(counts: dict[str, int]) -> str:
    looked = counts["frames"] - counts["thinned"] - counts["late"]
    return (
        f"{counts['accepted']} landmarks weighed in, {counts['gated']} refused by the gate; "
        f"{counts['matched']} of {looked} frames looked at matched one"
    )


def _loss(topic: str, reason: str, count: int | None) -> str:
    many = "an unknown number" if count is None else f"{count:,}"
    return f"{topic or 'the log'}: {many} rows: {reason}"


def _as_json(outcome: Outcome) -> dict[str, object]:
    return {
        "run": str(outcome.run.path),
        "logs": [account_of(ledger) for ledger in outcome.ledgers],
        "pose": {
            "rows": outcome.rows,
            "travelled_m": outcome.travelled_m,
            "major_axis_m": outcome.major_axis_m,
        },
        "landmarks": outcome.landmark_counts,
        "notices": list(outcome.notices),
        "seconds": outcome.seconds,
    }
