"""Replay a drive: run detectors over its camera, estimate pose, cues, ranges and beliefs.

The run folder then holds every table, and a manifest that accounts for every message. What was
found in a picture is kept by content, so a second run is quick; --resume keeps what an interrupted
run had finished.

example:
  crosscue replay drive.mcap --vehicle car.toml -o runs/drive
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path

from crosscue.detectors.registry import Choice, chosen
from crosscue.eval.accounts import account_of
from crosscue.eval.detect_stage import choices_of
from crosscue.eval.estimate_stage import Outcome
from crosscue.eval.landmark_stage import matcher_for, open_for
from crosscue.eval.plain_text import terminal_width, visible, wrapped
from crosscue.eval.replay_drive import Detecting, replay_drive
from crosscue.eval.scene_stage import ApproachSummary, SceneOutcome
from crosscue.replay.ledger import NOT_ASKED_TOPIC
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
    add_detector_arguments(parser)
    parser.add_argument(
        "--landmarks", type=Path, metavar="DB",
        help="landmark database that camera frames are compared with",
    )  # fmt: skip
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier run")
    parser.add_argument(
        "--resume", action="store_true", help="go on with an interrupted run, keeping what is done"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_detector_arguments(parser: argparse.ArgumentParser) -> None:
    """``--detectors``, ``--draw``, ``--cache`` and ``--no-cache``."""
    parser.add_argument(
        "--detectors", metavar="NAMES",
        help="comma-separated; all of the vehicle file's, if left out; none: pose alone",
    )  # fmt: skip
    parser.add_argument(
        "--draw", type=int, default=0, metavar="N",
        help="write N pictures with what was found, of every tenth frame",
    )  # fmt: skip
    parser.add_argument("--cache", type=Path, metavar="FILE", help="where results are kept")
    parser.add_argument("--no-cache", action="store_true", help="run every detector again")


def detectors_of(args: argparse.Namespace, vehicle: Vehicle) -> tuple[Choice, ...]:
    """The detectors asked for; none where neither flag nor vehicle file names any."""
    sections = choices_of(vehicle)
    if args.detectors == "none" or (args.detectors is None and not sections):
        return ()
    return chosen(",".join(sections) if args.detectors is None else args.detectors, sections)


def cache_of(args: argparse.Namespace) -> Path | None:
    """Where results are kept: as asked for, or in the user's cache folder."""
    if args.no_cache:
        return None
    if args.cache is not None:
        return Path(args.cache)
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(base) / "crosscue" / "detections.sqlite"


def run(args: argparse.Namespace) -> int:
    """Replay; 3 when something was lost."""
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    progress = Progress("replaying", not args.quiet and sys.stderr.isatty())
    detecting = Detecting(
        detectors_of(args, vehicle), cache_of(args), args.draw, args.resume, progress.at_frame
    )
    with ExitStack() as stack:
        logs = open_logs(args.logs)
        for log in logs:
            stack.enter_context(log)
        selection = selection_of(args, logs)
        landmarks = None
        if args.landmarks:
            landmarks = stack.enter_context(open_for(args.landmarks, matcher_for(vehicle)))
        run_folder = create(args.output, overwrite=args.overwrite or args.resume)
        if progress.is_shown:
            progress.start_ns = first_ns(logs)
        outcome = replay_drive(
            logs, vehicle, run_folder, selection, progress.at_time, landmarks, detecting
        )
        progress.end()
    if args.json:
        print_json(as_json(outcome))
    elif not args.quiet:
        print(summary(outcome))
    return outcome.exit_status


class Progress:
    """One line on a terminal: frames done with the time left, then the log time reached."""

    def __init__(self, what: str, is_shown: bool) -> None:
        """Say nothing unless ``is_shown``."""
        self.is_shown = is_shown
        self.start_ns: int | None = None
        self._what = what
        self._began = self._shown = time.monotonic()

    def at_frame(self, done: int, of: int | None) -> None:
        """A frame has been looked at."""
        if of is None or of < done:
            self._show(f"detecting: {done:,} frames")
            return
        left_s = (time.monotonic() - self._began) * (of - done) / max(done, 1)
        self._show(f"detecting: {done:,} of {of:,} frames, {left_s:.0f} s left")

    def at_time(self, t_ns: int) -> None:
        """The log has been read so far."""
        if self.start_ns is None:
            self.start_ns = t_ns
        self._show(f"{self._what}: {(t_ns - self.start_ns) * 1e-9:.0f} s of log")

    def end(self) -> None:
        """Take the line away."""
        if self.is_shown:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()

    def _show(self, text: str) -> None:
        now = time.monotonic()
        if self.is_shown and now - self._shown > 0.2:
            self._shown = now
            sys.stderr.write(f"\r{text} \x1b[K")
            sys.stderr.flush()


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
    if outcome.detected is not None:
        lines += _detected(outcome)
    if outcome.scene is not None:
        lines += scene_lines(outcome.scene)
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


def _detected(outcome: Outcome) -> list[str]:
    assert outcome.detected is not None
    counts = outcome.detected.counts
    lines = [f"frames   {counts.frames:,} looked at"]
    for name, ran in counts.ran.items():
        lines.append(f"         {name}: ran on {ran:,}, {counts.from_cache[name]:,} from the cache")
    for topic, account in sorted(outcome.detected.ledger.accounts.items()):
        lines += [
            f"  skip   {topic}: {n:,} {why}"
            for why, n in sorted(account.skipped.items())
            if why != NOT_ASKED_TOPIC
        ]
    return lines


def scene_lines(scene: SceneOutcome) -> list[str]:
    """Cues and approaches, for a person."""
    seen = [f"{cue} {count:,}" for cue, count in scene.positive.items()]
    lines = [f"cues     {', '.join(seen) or 'none'} (frames each, of {scene.frames:,})"]
    lines += [f"  note   {n:,} x {what}" for what, n in scene.counts.items() if n]
    for one in scene.approaches:
        lines.append(f"approach {_approach(one)}")
    return lines


def _approach(one: ApproachSummary) -> str:
    said = ", ".join(f"{feature} {p:.2f}" for feature, p in one.probabilities.items())
    where = "not detected"
    if one.detected_m is not None:
        where = f"detected {one.detected_m:.1f} m before its {one.reference}"
    return f"{one.number}: {where}; at the end {said}"


def _landmarks(counts: dict[str, int]) -> str:
    looked = counts["frames"] - counts["thinned"] - counts["late"]
    return (
        f"{counts['accepted']} landmarks weighed in, {counts['gated']} refused by the gate; "
        f"{counts['matched']} of {looked} frames looked at matched one"
    )


def _loss(topic: str, reason: str, count: int | None) -> str:
    many = "an unknown number" if count is None else f"{count:,}"
    return f"{topic or 'the log'}: {many} rows: {reason}"


def as_json(outcome: Outcome) -> dict[str, object]:
    """The result for other programs."""
    return {
        "run": str(outcome.run.path),
        "logs": [account_of(ledger) for ledger in outcome.ledgers],
        "pose": {
            "rows": outcome.rows,
            "travelled_m": outcome.travelled_m,
            "major_axis_m": outcome.major_axis_m,
        },
        "landmarks": outcome.landmark_counts,
        "detected": None if outcome.detected is None else {
            "frames": outcome.detected.counts.frames,
            "ran": outcome.detected.counts.ran,
            "from_cache": outcome.detected.counts.from_cache,
            "objects": outcome.detected.objects,
        },
        "scene": None if outcome.scene is None else asdict(outcome.scene),
        "notices": list(outcome.notices),
        "seconds": outcome.seconds,
    }  # fmt: skip
