"""The worst frames of runs: false positive cues with their pictures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import frame_times
from crosscue.eval.runs.stored_images import run_camera
from crosscue.eval.scoring.runs import RunScored
from crosscue.eval.scoring.scene.cues import CueFrames, is_wrong
from crosscue.replay.vehicle.vehicle import CUES, Vehicle

from .frame_pictures import draw_pictures
from .scene_figures import WorstFrame

MAX_FRAMES: Final = 6
# Wrong frames of one cue closer in time than this are one mistake, shown by its worst frame.
APART_NS: Final = 2_000_000_000


def worst_frames(scored: Sequence[RunScored], max_count: int = MAX_FRAMES) -> list[WorstFrame]:
    """Return the false positive cues of all runs with the highest confidence, sorted by it.

    Raises:
        RunError: A run's tables are damaged, or the log with its pictures is not found.
        LogError: That log cannot be opened.
    """
    found = [wrong for one in scored for wrong in _wrong(one)]
    found.sort(key=lambda one: (-(one.confidence or 0.0), -one.frames, one.run, one.t_ns, one.cue))
    shown = found[:max_count]
    drawn = {
        (one.run, one.t_ns, one.cue): one
        for each in scored
        for mine in [[one for one in shown if one.run == each.judged.coverage.drive]]
        if mine
        for one in _with_pictures(mine, each.run)
    }
    return [drawn[one.run, one.t_ns, one.cue] for one in shown]


def _wrong(scored: RunScored) -> list[WorstFrame]:
    mistakes = [(cue, row) for cue in scored.judged.cues for row in _mistakes(cue)]
    if not mistakes:
        return []
    vehicle = scored.run.drive_manifest().settings
    moved = frame_times(scored.run)
    times = {moved.get(int(cue.t_ns[i]), int(cue.t_ns[i])) for cue, rows in mistakes for i in rows}
    scores = _scores(scored.run, times)
    found = []
    for cue, rows in mistakes:
        labels = _labels(cue.cue, vehicle)
        at_ns = [moved.get(t_ns, t_ns) for t_ns in cue.t_ns[rows].tolist()]
        sure = [_confidence(scores.get(t_ns, []), labels) for t_ns in at_ns]
        worst = int(np.argmax([-1.0 if value is None else value for value in sure]))
        at = int(rows[worst])
        true = int(cue.true_count[at])
        found.append(
            WorstFrame(
                run=scored.judged.coverage.drive,
                t_ns=at_ns[worst],
                cue=cue.cue,
                count=int(cue.count[at]),
                true_count=None if true < 0 else true,
                distance_m=float(cue.distance_m[at]),
                confidence=max((value for value in sure if value is not None), default=None),
                frames=len(rows),
            )
        )
    return found


def _mistakes(cue: CueFrames) -> list[np.typing.NDArray[np.intp]]:
    """Return the rows in which the cue is wrong, grouped by closeness in time."""
    rows = np.flatnonzero(is_wrong(cue))
    breaks = np.flatnonzero(np.diff(cue.t_ns[rows]) > APART_NS) + 1
    return [part for part in np.split(rows, breaks) if len(part)]


def _labels(cue: str, vehicle: Vehicle) -> tuple[str, ...]:
    return vehicle.labels_of(CUES[cue]) if cue in CUES else ()


def _confidence(rows: Sequence[Mapping[str, Any]], labels: tuple[str, ...]) -> float | None:
    return max((row["score"] for row in rows if row["label"] in labels), default=None)


def _scores(run: RunFolder, times: set[int]) -> dict[int, list[dict[str, Any]]]:
    """Return the detections at the given times."""
    import pyarrow as pa
    import pyarrow.compute as pc

    found: dict[int, list[dict[str, Any]]] = {}
    if not run.file("detections.parquet").exists():
        return found
    wanted = pa.array(sorted(times), pa.int64())
    for batch in run.batches("detections", ["t_ns", "label", "score"]):
        for row in batch.filter(pc.is_in(batch["t_ns"], wanted)).to_pylist():
            found.setdefault(row["t_ns"], []).append(row)
    return found


def _with_pictures(found: Sequence[WorstFrame], run: RunFolder) -> list[WorstFrame]:
    """Return frames of one run with their pictures; the page states which cannot be read."""
    if run_camera(run) is None:
        return list(found)
    pictures: dict[int, str] = {}

    def keep(t_ns: int, picture: bytes, _: bytes) -> None:
        pictures[t_ns] = base64.b64encode(picture).decode()

    draw_pictures(run, [one.t_ns for one in found], keep)
    return [replace(one, picture=pictures.get(one.t_ns, "")) for one in found]
