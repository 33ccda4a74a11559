"""How many true errors the moments of ``crosscue failures --unlabelled`` show.

Drives are simulated with their truth, replayed with faulty detectors, and ranked without truth. An
error is a false cue over successive frames, a wrong belief (absent above 0.9, present below 0.1) in
an approach, or a range outside its 95 % interval over successive frames. Each counts once, however
many of the moments show it. The same is counted for as many frames drawn at random.

Intervals are over drives: 95 % of 300 bootstrap samples of them. Missed cues are not errors here:
nearly every frame misses some distant object.

    python benchmarks/unlabelled.py OUT --layouts-from 4000 --blocks 4
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crosscue.eval.batch.ray_jobs import engine_of
from crosscue.eval.failures.find import failures_unlabelled
from crosscue.eval.failures.order import ranked
from crosscue.eval.failures.record import APART_NS, Failure
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.scoring.runs import judge_scene
from crosscue.eval.scoring.scene.cues import is_wrong
from crosscue.eval.scoring.scene.ranges import sds_off
from crosscue.eval.studies.layouts.run import PERCEPTION
from crosscue.eval.studies.layouts.settings import LayoutStudy
from crosscue.eval.studies.simulated_drives import run_drives
from crosscue.replay.columns import Int64s

SAMPLES = 300
SDS_95 = 1.96


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Frames of a drive with the errors that each shows, and its suspect moments."""

    frames_ns: Int64s
    errors: dict[int, set[str]]
    moments: tuple[Failure, ...]

    def shown(self, t_ns: int) -> set[str]:
        """Return the errors in the last frame up to a moment."""
        at = max(int(np.searchsorted(self.frames_ns, t_ns, side="right")) - 1, 0)
        return self.errors.get(int(self.frames_ns[at]), set())


def read_drive(run: RunFolder, truth: Path) -> Drive:
    """Judge a run by its truth, and rank its moments without it."""
    judged = judge_scene(run, truth).judged
    errors: dict[int, set[str]] = {}

    def add(name: str, times: Int64s) -> None:
        parts = np.split(times, np.flatnonzero(np.diff(times) > APART_NS) + 1)
        for number, part in enumerate(parts):
            for t_ns in part.tolist():
                errors.setdefault(t_ns, set()).add(f"{run.path.name} {name} {number}")

    for cue in judged.cues:
        add(cue.cue, np.sort(cue.t_ns[is_wrong(cue)]))
    if judged.approaches is not None:
        present = {one.approach: one.present for one in judged.approaches.results}
        for curve in judged.approaches.curves:
            for name, p in curve.features.items():
                wrong = p < 0.1 if name in present[curve.approach] else p > 0.9
                add(f"belief {curve.approach} {name}", curve.t_ns[wrong])
    for one in judged.ranges:
        add(f"range {one.reference}", one.t_ns[sds_off(one) > SDS_95])
    frames_ns = np.unique(run.table("frames")["t_ns"].to_numpy())
    return Drive(frames_ns, errors, failures_unlabelled(run, 0.9))


def counts(drives: list[Drive], top: int, rng: np.random.Generator) -> tuple[int, int, int, int]:
    """Return the moments with an error and the errors shown, of the ranked and of random ones."""
    # A drive that a bootstrap sample holds twice counts as two.
    moments = [(moment, k) for k, one in enumerate(drives) for moment in one.moments]
    best = sorted(moments, key=lambda pair: (-pair[0].severity, pair[0].run, pair[0].t_ns))[:top]
    first = [{(k, e) for e in drives[k].shown(moment.t_ns)} for moment, k in best]
    frames = [(k, int(t_ns)) for k, one in enumerate(drives) for t_ns in one.frames_ns]
    drawn = [frames[i] for i in rng.choice(len(frames), size=len(best), replace=False)]
    others = [{(k, e) for e in drives[k].shown(t_ns)} for k, t_ns in drawn]
    return (
        sum(map(bool, first)),
        len(set().union(*first)),
        sum(map(bool, others)),
        len(set().union(*others)),
    )


def main() -> None:
    """Simulate, rank and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--layouts-from", type=int, default=4000)
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--top", type=int, default=50)
    args = parser.parse_args()
    study = LayoutStudy("faults", args.blocks, 1, 2, layouts_from=args.layouts_from)
    imager, detectors, _ = PERCEPTION["faults"]
    done = run_drives(args.output, study.scenes(), detectors, engine_of(1, None), imager=imager)
    names = [one.job.name for one in done if one.error is None]
    drives = [
        read_drive(open_run(args.output / "runs" / name), args.output / "drives" / name)
        for name in names
    ]
    rng = np.random.default_rng(0)
    frames = sum(len(one.frames_ns) for one in drives)
    ill = sum(bool(one.shown(int(t))) for one in drives for t in one.frames_ns)
    print(f"{len(drives)} drives ({names[0]} to {names[-1]}), {frames} frames, {ill} with an error")
    found = np.array([counts(drives, args.top, rng) for _ in range(SAMPLES)], np.float64)
    moments, errors, moments_drawn, errors_drawn = found.mean(axis=0)
    samples = []
    for _ in range(SAMPLES):
        some = [drives[i] for i in rng.integers(0, len(drives), len(drives))]
        samples.append(counts(some, args.top, rng))
    spread = np.array(samples, np.float64)
    ratios = (
        spread[:, 1] / np.maximum(spread[:, 3], 1),
        spread[:, 0] / np.maximum(spread[:, 2], 1),
    )
    ends = [np.percentile(one, (2.5, 97.5)) for one in ratios]
    print(f"of {args.top}        ranked   random    ratio (95 %)")
    for name, ours, theirs, (low, high) in (
        ("errors shown", errors, errors_drawn, ends[0]),
        ("with an error", moments, moments_drawn, ends[1]),
    ):
        print(f"{name:13} {ours:7.0f} {theirs:8.1f} {ours / theirs:8.2f} ({low:.2f} to {high:.2f})")
    kinds: dict[str, list[bool]] = {}
    by_run = {one.moments[0].run: one for one in drives if one.moments}
    for moment in ranked([each for one in drives for each in one.moments])[: args.top]:
        name = moment.cause if moment.kind == "suspect" else moment.kind
        name = "another cue excludes it" if name.endswith("excludes it") else name
        kinds.setdefault(name, []).append(bool(by_run[moment.run].shown(moment.t_ns)))
    for name, right in sorted(kinds.items()):
        print(f"  {name}: {sum(right)} of {len(right)}")


if __name__ == "__main__":
    main()
