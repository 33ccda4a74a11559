"""Simulate a drive up to an intersection, replay it from its pixels, score it, show it.

Everything is made from a seed on this machine; nothing is downloaded. It takes a few minutes on two
cores, most of them for the pictures and the networks that look at them.

example:
  crosscue demo -o demo
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.datasets.scenes.drive import SceneSettings, write_scene
from crosscue.datasets.scenes.layout import SCORED
from crosscue.detectors.registry import EMBEDDED, chosen
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.outcome import summary as replay_summary
from crosscue.eval.commands.shared.progress import DriveLine, is_shown
from crosscue.eval.pipeline.detect import choices_of
from crosscue.eval.pipeline.replay import Detecting, replay_drive
from crosscue.eval.recording import save
from crosscue.eval.report.page import write_report
from crosscue.eval.report.summary import pose_summary, summary
from crosscue.eval.runs.folder import create
from crosscue.eval.scoring.pose.score import truth_track
from crosscue.eval.scoring.runs import FOLDER, judge_run, metrics_of, scores_of, write_scores
from crosscue.replay.base import EVERYTHING, UsageError
from crosscue.replay.opening import open_log
from crosscue.replay.vehicle.vehicle import load


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("demo"),
        metavar="DIR",
        help="folder for drive, run and report (default: demo)",
    )
    parser.add_argument("--layout", default="C", choices=SCORED, help="layout of the intersection")
    parser.add_argument("--run", type=int, default=1, metavar="N", help="run of the layout, from 1")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument(
        "--width",
        type=int,
        default=1280,
        metavar="PX",
        help="image width in pixels; height is 9/16",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing demo")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Simulate, replay, score, show."""
    talk = not (args.quiet or args.json)
    settings = _settings(args)
    line = DriveLine("replaying", is_shown=is_shown(args))
    if talk:
        print(f"simulating a drive up to intersection {args.layout} ...", flush=True)
    files = write_scene(args.output / "drive", settings, overwrite=args.overwrite)
    if talk:
        print(f"  {files.log}: {files.seconds:.0f} s, {files.pictures} pictures\n", flush=True)
    folder = create(args.output / "run", overwrite=args.overwrite)
    vehicle = load(files.vehicle)
    choices = chosen(EMBEDDED, choices_of(vehicle))
    detecting = Detecting(choices, on_frames=line.at_frame)
    with open_log(files.log) as log, line:
        outcome = replay_drive(
            [log], vehicle, folder, EVERYTHING, line.at_time, detecting=detecting
        )
    one = judge_run(folder, files.truth)
    scores = scores_of([one])
    metrics = metrics_of([one], scores)
    write_scores(folder.file(FOLDER), [one], metrics)
    assert one.pose is not None
    report = write_report(folder.file(FOLDER), [one], scores, metrics)
    recording = folder.file("drive.rrd")
    save(folder, recording, truth_track(files.truth, folder), one.truth.ranges)
    if args.json:
        print_json(
            {
                "log": str(files.log),
                "vehicle": str(files.vehicle),
                "truth": str(files.truth),
                "run": str(folder.path),
                "report": str(report),
                "recording": str(recording),
                "metrics": metrics,
            }
        )
    elif talk:
        print(replay_summary(outcome))
        print("\nagainst the truth of the simulation")
        print(summary(scores, one.why_no_pose))
        print("\n" + pose_summary(one.pose))
        print(f"\nreport     {report.resolve()}\nrecording  {recording.resolve()}")
        print(f"           look at it with: crosscue view {folder.path} --truth {files.truth}")
    return outcome.exit_status


def _settings(args: argparse.Namespace) -> SceneSettings:
    from crosscue.datasets.scenes.rendering.camera import Camera

    if not 64 <= args.width <= 3840 or args.width % 16:
        raise UsageError(f"--width {args.width}: want a multiple of 16 from 64 to 3840")
    camera = Camera(width_px=args.width, height_px=args.width * 9 // 16)
    try:
        return SceneSettings(layout=args.layout, run=args.run, seed=args.seed, camera=camera)
    except ValueError as error:
        raise UsageError(f"demo: {error}") from None
