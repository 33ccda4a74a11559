"""Make a simulated drive, replay it, score it, and write its report and recording.

Everything is made from a seed on this machine; nothing is downloaded.

example:
  crosscue demo -o demo
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.datasets.simulated_drive import DriveSettings
from crosscue.datasets.simulated_log import write_drive
from crosscue.eval.recording import save
from crosscue.eval.replay_drive import replay_drive
from crosscue.eval.report import write_report
from crosscue.eval.score_pose import load_truth, score, summary, truth_track
from crosscue.replay.errors import UsageError
from crosscue.replay.log import EVERYTHING, open_log
from crosscue.replay.run_folder import create
from crosscue.replay.vehicle import load

from .common import print_json
from .replay import summary as replay_summary


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("-o", "--output", type=Path, default=Path("demo"), metavar="DIR",
                        help="folder for drive, run and report (default: demo)")  # fmt: skip
    parser.add_argument("--seed", type=int, default=7, help="of the simulated drive")
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier demo")
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")


def run(args: argparse.Namespace) -> int:
    """Simulate, replay, score, show."""
    if args.seed < 0:
        raise UsageError(f"--seed {args.seed}: want 0 or more")
    talk = not (args.quiet or args.json)
    files = write_drive(
        args.output / "drive", DriveSettings(seed=args.seed), overwrite=args.overwrite
    )
    if talk:
        print(f"simulated drive: {files.seconds:.0f} s, {files.metres:.0f} m, seed {args.seed}")
        print(f"                 {files.log}\n")
    folder = create(args.output / "run", overwrite=args.overwrite)
    with open_log(files.log) as log:
        outcome = replay_drive([log], load(files.vehicle), folder, EVERYTHING)
    truth, _ = load_truth(files.truth)
    result = score(folder, files.truth)
    report = write_report(folder, truth, result)
    recording = folder.file("drive.rrd")
    save(folder, recording, truth_track(files.truth, folder))
    if args.json:
        print_json({"log": str(files.log), "vehicle": str(files.vehicle), "truth": str(files.truth),
                    "run": str(folder.path), "report": str(report), "recording": str(recording),
                    "ape_rmse_m": result.ape["none"].translation_m.rmse})  # fmt: skip
    elif talk:
        print(replay_summary(outcome))
        print("\nagainst the truth of the simulation")
        print(summary(result))
        print(f"\nreport     {report.resolve()}\nrecording  {recording.resolve()}")
        print(f"           look at it with: crosscue view {folder.path} --truth {files.truth}")
    return outcome.exit_status
