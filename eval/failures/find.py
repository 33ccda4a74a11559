"""All failures of one run: compared with its truth, or, without truth, flipped beliefs only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import frame_times, seconds_into, span_ns
from crosscue.eval.scoring.runs import SceneJudged, read_run_tables
from crosscue.replay.vehicle.vehicle import CUES

from .approach_level import flips_without_truth, of_approaches
from .frame_level import Detected, failing_times, missed_and_false, wrong_ranges
from .record import About, Failure
from .unlabelled import suspects


def failures_beside_truth(
    run: RunFolder, scene: SceneJudged, threshold: float
) -> tuple[Failure, ...]:
    """Return all failures of a judged run, unordered.

    Raises:
        RunError: A table is missing or damaged.
    """
    abouts = {
        one.id: About(
            str(run.path), one.id, one.intersection, one.conditions, one.start_ns, one.enter_ns
        )
        for one in scene.truth.truth.approaches
    }
    judged, found = scene.judged, list[Failure]()
    if judged.approaches is not None:
        found += of_approaches(judged.approaches, judged.cues, abouts, threshold)
    found += _of_frames(run, scene, abouts)
    return _placed(run, found)


def failures_without_truth(run: RunFolder, threshold: float) -> tuple[Failure, ...]:
    """Return the failures that show without truth: flipped beliefs.

    Raises:
        RunError: A table is missing or damaged.
    """
    return _placed(run, _flips(run, threshold))


def _flips(run: RunFolder, threshold: float) -> list[Failure]:
    tables = read_run_tables(run)
    if tables.belief is None:
        return []
    positives = {}
    if tables.cues is not None:
        is_found = tables.cues.count > 0
        for cue in np.unique(tables.cues.cue).tolist():
            positives[cue] = tables.cues.t_ns[is_found & (tables.cues.cue == cue)]
    return flips_without_truth(tables.belief, positives, str(run.path), threshold)


def failures_unlabelled(run: RunFolder, threshold: float) -> tuple[Failure, ...]:
    """Return the moments that look wrong without truth: flipped beliefs, and contradictions.

    Raises:
        RunError: A table is missing or damaged.
    """
    # A flip is looked at in the last frame of the answer that was given up.
    flips = [replace(one, t_ns=one.start_ns) for one in _flips(run, threshold)]
    return _placed(run, [*flips, *suspects(run)])


def _of_frames(run: RunFolder, scene: SceneJudged, abouts: Mapping[int, About]) -> list[Failure]:
    judged, name = scene.judged, str(run.path)
    vehicle, detected = run.drive_manifest().settings, _detected(run, scene)
    found = list(wrong_ranges(judged.ranges, abouts, name))
    for cue in judged.cues:
        spec = CUES.get(cue.cue)
        labels = () if spec is None else vehicle.labels_of(spec)
        min_score = None if spec is None else vehicle.threshold_of(spec)[1]
        found += missed_and_false(cue, judged.cues, labels, min_score, detected, abouts, name)
    return found


def _detected(run: RunFolder, scene: SceneJudged) -> Detected:
    """Return the detections in the failing frames, by log time."""
    import pyarrow as pa
    import pyarrow.compute as pc

    wanted = failing_times(scene.judged.cues)
    if not len(wanted) or not run.file("detections.parquet").exists():
        return {}
    times, found = pa.array(wanted), dict[int, list[dict[str, Any]]]()
    for batch in run.batches("detections", ["log_t_ns", "label", "score"]):
        for row in batch.filter(pc.is_in(batch["log_t_ns"], times)).to_pylist():
            found.setdefault(row["log_t_ns"], []).append(row)
    return found


def _placed(run: RunFolder, found: list[Failure]) -> tuple[Failure, ...]:
    """Convert failures from log time, as in the truth, to the time of the run's tables."""
    if not found:
        return ()
    first_ns, last_ns = span_ns(run)
    moved = frame_times(run)

    def of_run(log_ns: int) -> int:
        return min(max(moved.get(log_ns, log_ns), first_ns), last_ns)

    return tuple(
        replace(
            one,
            t_ns=of_run(one.t_ns),
            start_ns=of_run(one.start_ns),
            end_ns=of_run(one.end_ns),
            at_s=seconds_into(first_ns, of_run(one.t_ns)),
        )
        for one in found
    )
