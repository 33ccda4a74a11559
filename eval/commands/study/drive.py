"""One simulated drive to look at: picture, log that crosscue replay reads, run, Rerun recording.

The seed of any drive of a study stands in its drives.parquet; with the same settings it is the same
drive.

examples:
  crosscue study drive --seed 7 -o drive
  crosscue study drive --seed 7 --strategy "landmark to landmark" --landmark-density 1 -o drive
  crosscue view drive/run --truth drive/truth.json
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.commands.shared.options import print_json
from crosscue.replay.errors import UsageError

if TYPE_CHECKING:
    from crosscue.localization.town.settings import Drive

STRATEGIES = ("straight to goal", "landmark to landmark", "hybrid")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("study-drive"),
        metavar="DIR",
        help="folder for log, truth, picture and run (default: study-drive)",
    )
    parser.add_argument("--seed", type=int, default=7, metavar="N", help="random seed (default: 7)")
    parser.add_argument(
        "--compass",
        type=float,
        default=30.0,
        metavar="DEG",
        help="2-sigma error of the compass in degrees; 0 for no compass (default: 30)",
    )
    parser.add_argument(
        "--strategy",
        choices=STRATEGIES,
        default=STRATEGIES[0],
        help="navigation strategy (default: straight to goal)",
    )
    parser.add_argument(
        "--landmark-density",
        type=float,
        default=0.0,
        metavar="N",
        help="landmarks per square kilometre (default: 0)",
    )
    parser.add_argument(
        "--detection-rate",
        type=float,
        default=0.6,
        metavar="P",
        help="probability that a landmark in view is recognised (default: 0.6)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing drive")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Drive, draw, write, replay, score."""
    from crosscue.eval.recording import save
    from crosscue.eval.report.summary import pose_summary
    from crosscue.eval.scoring.pose.score import truth_track
    from crosscue.eval.studies.town import drive_figure
    from crosscue.eval.studies.town.replayed import through_log

    if not 0 <= args.seed < 1 << 64:
        raise UsageError(f"--seed {args.seed}: expected 0 or more, below 2^64")
    settings = _settings(args)
    done = through_log(args.output, settings, args.seed, overwrite=args.overwrite)
    picture = drive_figure.draw(settings, done.traced, args.seed, args.output)
    recording = done.run.file("drive.rrd")
    save(done.run, recording, truth_track(done.files.truth, done.run))
    if args.json:
        print_json(
            {
                "result": done.traced.result._asdict(),
                "log": str(done.files.log),
                "truth": str(done.files.truth),
                "picture": str(picture),
                "run": str(done.run.path),
                "recording": str(recording),
            }
        )
    elif not args.quiet:
        result = done.traced.result
        print(
            f"simulated  {result.travelled_m:.0f} m in {result.seconds:.0f} s, "
            f"{result.decisions} decisions, {result.detected} landmarks used"
        )
        print("\nthe replay of its log against the truth")
        print(pose_summary(done.score))
        print(f"\npicture    {picture}\nlog        {done.files.log}\nrecording  {recording}")
    return 0 if done.is_whole else 3


def _settings(args: argparse.Namespace) -> Drive:
    from pydantic import ValidationError

    from crosscue.localization.town.settings import Drive, Navigation, Sensors

    flags = {
        "compass_2sigma_deg": "compass",
        "detection_rate": "detection-rate",
        "landmarks_per_km2": "landmark-density",
    }
    try:
        return Drive(
            sensors=Sensors(
                compass_2sigma_deg=args.compass or None, detection_rate=args.detection_rate
            ),
            navigation=Navigation(strategy=args.strategy),
            landmarks_per_km2=args.landmark_density,
        )
    except ValidationError as error:
        first = error.errors()[0]
        flag = flags[str(first["loc"][-1])]
        raise UsageError(f"--{flag} {first['input']}: {first['msg'].lower()}") from None
