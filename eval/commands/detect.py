"""Detect: run detectors over a drive's camera; detections, road shares and cues into a run folder.

A detector is a name, one of the vehicle file's [detectors.NAME], a module:factory, or a model card
(.toml). What was found in a picture is kept by content, so a second run is quick.

example:
  crosscue detect drive.mcap --vehicle car.toml --detectors yolox.toml,signs -o runs/drive
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.eval.commands.shared.detectors import add_detector_arguments, cache_of, detectors_of
from crosscue.eval.commands.shared.drive_part import open_part
from crosscue.eval.commands.shared.options import add_log_arguments, print_json
from crosscue.eval.commands.shared.progress import DriveLine, is_shown
from crosscue.eval.interface.runs import detect_drive
from crosscue.eval.pipeline.outcome import DetectOutcome
from crosscue.eval.runs.account import account_lines, details_of
from crosscue.replay.base import UsageError, visible
from crosscue.replay.vehicle.vehicle import Vehicle


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    add_log_arguments(parser)
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="RUN", help="run folder"
    )
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="vehicle file")
    add_detector_arguments(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing run")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Detect; 3 when something was dropped."""
    if args.draw < 0:
        raise UsageError(f"--draw {args.draw}: want 0 or more")
    with (
        open_part(args, args.logs) as log,
        DriveLine("detecting", is_shown=is_shown(args)) as line,
    ):
        run = detect_drive(
            log,
            args.output,
            args.vehicle or Vehicle(version=1),
            detectors_of(args),
            cache=cache_of(args),
            draw=args.draw,
            overwrite=args.overwrite,
            on_frames=line.at_frame,
        )
    outcome = run.outcome
    assert isinstance(outcome, DetectOutcome)
    if args.json:
        print_json(_as_json(outcome))
    elif not args.quiet:
        print(summary(outcome))
    return outcome.exit_status


def summary(outcome: DetectOutcome) -> str:
    """What happened, for a person."""
    counts, ledger = outcome.counts, outcome.ledger
    lines = [f"run      {outcome.run.path}", f"log      {ledger.log}"]
    lines.append(f"frames   {counts.frames:,} in {outcome.seconds:.2f} s")
    for name, ran in counts.ran.items():
        lines.append(f"  {name}: ran on {ran:,}, {counts.from_cache[name]:,} from the cache")
    lines += [f"found    {what}: {count:,}" for what, count in sorted(outcome.objects.items())]
    lines += [f"cue      {cue}: in {count:,} frames" for cue, count in outcome.cues.items()]
    lines += [*account_lines(outcome.account), *details_of([ledger])]
    lines += [f"note     {sentence}" for sentence in (*ledger.notices, *outcome.notices)]
    return "\n".join(visible(line) for line in lines)


def _as_json(outcome: DetectOutcome) -> dict[str, object]:
    return {
        "run": str(outcome.run.path),
        "account": outcome.account.as_json(),
        "frames": outcome.counts.frames,
        "ran": outcome.counts.ran,
        "from_cache": outcome.counts.from_cache,
        "objects": outcome.objects,
        "cues": outcome.cues,
        "notices": list(outcome.notices),
        "seconds": outcome.seconds,
    }
