"""The worst frames of runs: false positive cues with their pictures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from crosscue.detectors.base import Detections, View
from crosscue.detectors.images import Encoded, decode
from crosscue.detectors.overlay import draw_detections
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.stored_images import picture_at, run_camera
from crosscue.eval.scoring.runs import RunScored
from crosscue.eval.scoring.scene.cues import CueFrames, is_wrong
from crosscue.replay.errors import CrosscueError
from crosscue.replay.vehicle.vehicle import CUES, Vehicle

from .scene_figures import WorstFrame

MAX_FRAMES: Final = 6
# Wrong frames of one cue closer in time than this are one mistake, shown by its worst frame.
APART_NS: Final = 2_000_000_000
WIDTH_PX: Final = 640
QUALITY: Final = 80
FOUND: Final = (
    "t_ns",
    "label",
    "score",
    "x0",
    "y0",
    "x1",
    "y1",
    "picture_width_px",
    "picture_height_px",
)


def worst_frames(scored: Sequence[RunScored], max_count: int = MAX_FRAMES) -> list[WorstFrame]:
    """Return the false positive cues of all runs with the highest confidence, sorted by it.

    Raises:
        RunError: A run's tables are damaged, or the log with its pictures is not found.
        LogError: That log cannot be opened.
    """
    found = [wrong for one in scored for wrong in _wrong(one)]
    found.sort(key=lambda one: (-(one.confidence or 0.0), -one.frames, one.run, one.t_ns, one.cue))
    folders = {one.judged.coverage.drive: one.run for one in scored}
    return [_with_picture(one, folders[one.run]) for one in found[:max_count]]


def _wrong(scored: RunScored) -> list[WorstFrame]:
    mistakes = [(cue, row) for cue in scored.judged.cues for row in _mistakes(cue)]
    if not mistakes:
        return []
    vehicle = scored.run.drive_manifest().settings
    times = {int(cue.t_ns[i]) for cue, rows in mistakes for i in rows}
    scores = _scores(scored.run, times)
    found = []
    for cue, rows in mistakes:
        labels = _labels(cue.cue, vehicle)
        sure = [_confidence(scores.get(int(cue.t_ns[i]), []), labels) for i in rows]
        at = int(rows[int(np.argmax([-1.0 if value is None else value for value in sure]))])
        true = int(cue.true_count[at])
        found.append(
            WorstFrame(
                run=scored.judged.coverage.drive,
                t_ns=int(cue.t_ns[at]),
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
    for batch in run.batches("detections", list(FOUND)):
        for row in batch.filter(pc.is_in(batch["t_ns"], wanted)).to_pylist():
            found.setdefault(row["t_ns"], []).append(row)
    return found


def _with_picture(one: WorstFrame, run: RunFolder) -> WorstFrame:
    labels = _labels(one.cue, run.drive_manifest().settings)
    rows = [row for row in _scores(run, {one.t_ns}).get(one.t_ns, []) if row["label"] in labels]
    camera = run_camera(run)
    if camera is None:
        return one
    try:
        picture = picture_at(camera, one.t_ns)
        return one if picture is None else _drawn(picture, one, rows)
    except CrosscueError:
        # The page states that this picture cannot be read.
        return one


def _drawn(picture: Encoded, one: WorstFrame, rows: Sequence[Mapping[str, Any]]) -> WorstFrame:
    """Return the frame with its reduced picture and the boxes of the cue's detections."""
    import cv2

    pixels, whole = decode(picture, View(min_width_px=WIDTH_PX))
    size = (WIDTH_PX, round(whole[1] * WIDTH_PX / whole[0]))
    if pixels.shape[1] > WIDTH_PX:
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    size = (pixels.shape[1], pixels.shape[0])
    boxes = np.array([[row[k] for k in ("x0", "y0", "x1", "y1")] for row in rows], np.float64)
    found = Detections(
        one.t_ns,
        size,
        boxes.reshape(-1, 4) * (size[0] / whole[0]),
        np.array([row["score"] for row in rows], np.float64),
        tuple(row["label"] for row in rows),
        (b"",) * len(rows),
    )
    canvas = draw_detections(pixels, (found,), {one.cue: one.count})
    ok, jpeg = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not ok:
        return one
    return replace(one, picture=base64.b64encode(jpeg.tobytes()).decode(), size_px=size)
