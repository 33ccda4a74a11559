"""Pictures of frames with boxes, masks, road and regions, and a thumbnail of each."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import Detections, Found
from crosscue.detectors.cues.observed import FrameDetections
from crosscue.detectors.cues.road import outlines
from crosscue.detectors.images import Encoded
from crosscue.detectors.overlay import NOTHING_TRUE, draw_frame
from crosscue.eval.pipeline.scene.road_picture import plans_of
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.legs import leg_texts
from crosscue.eval.runs.stored_images import pictures_at, run_camera
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.scoring.truth import true_marks
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import CrosscueError
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Vehicle

WIDTH_PX: Final = 800
SMALL_PX: Final = 240
QUALITY: Final = 72
# Scores from which a detection is drawn in a report: of any object, and of one whose cue was found.
LIKELY: Final = 0.5
COUNTED: Final = 0.3

# Callback for the time of a frame, its picture and its thumbnail, both as JPEG.
Keep = Callable[[int, bytes, bytes], None]


def draw_pictures(
    run: RunFolder,
    times: Iterable[int],
    keep: Keep,
    *,
    has_candidates: bool = True,
    truth: Path | None = None,
) -> str:
    """Draw some frames of a run.

    Args:
        run: The run.
        times: Times of the frames, as in the run's tables.
        keep: Called for each picture that could be read.
        has_candidates: False to draw only likely detections (``LIKELY``, or ``COUNTED`` where
            their cue was found), without those stored in case other frames support them.
        truth: Truth file, to also draw labelled boxes and name the cues that are present.

    Returns:
        The reason why pictures are missing; empty if none is.
    """
    wanted = frozenset(times)
    try:
        camera = run_camera(run)
        if camera is None:
            return "the run has no camera, or several"
        found, vehicle = _found(run, wanted), run.drive_manifest().settings
        cues, plans, legs = _cues(run, wanted), plans_of(run, wanted), leg_texts(run)
        regions = partial(outlines, vehicle.regions)
        true = {} if truth is None else true_marks(truth, run, wanted)

        def on_picture(t_ns: int, picture: Encoded) -> None:
            frame = found.get(t_ns)
            results = () if frame is None else frame.found
            counts = cues.get(t_ns, {})
            if not has_candidates:
                counted = _labels(vehicle, counts)
                results = tuple(_likely(one, counted) for one in results)
            marks = true.get(t_ns, NOTHING_TRUE)
            lines = legs.get(t_ns, ())
            canvas = draw_frame(picture, results, counts, regions, WIDTH_PX, marks, lines)
            if t_ns in plans:
                canvas = _with_plan(canvas, plans[t_ns])
            keep(t_ns, _jpeg(canvas, WIDTH_PX), _jpeg(canvas, SMALL_PX))

        pictures_at(camera, wanted, on_picture)
    except CrosscueError as error:
        return str(error)
    return ""


def _labels(vehicle: Vehicle, counts: Mapping[str, int]) -> frozenset[str]:
    """Return the labels of the cues that were found."""
    positive = [CUES[cue] for cue, count in counts.items() if count and cue in CUES]
    return frozenset(label for cue in positive for label in vehicle.labels_of(cue))


def _likely(found: Found, counted: frozenset[str]) -> Found:
    if not isinstance(found, Detections):
        return found
    least = np.array([COUNTED if one in counted else LIKELY for one in found.labels])
    return found.taken(found.scores >= least) if len(least) else found


def _found(run: RunFolder, wanted: frozenset[int]) -> Mapping[int, FrameDetections]:
    manifest = run.drive_manifest()
    if manifest.detected is None:
        return {}
    frames = stored_frames(run, manifest.detected, manifest.settings, with_road_masks=True)
    return {one.t_ns: one for one in frames if one.t_ns in wanted}


def _cues(run: RunFolder, wanted: frozenset[int]) -> Mapping[int, dict[str, int]]:
    """Return the positive cues by time."""
    found: dict[int, dict[str, int]] = {}
    table = run.filled("cues", ["t_ns", "cue", "count"])
    for row in () if table is None else table.to_pylist():
        if row["t_ns"] in wanted:
            found.setdefault(row["t_ns"], {})[row["cue"]] = row["count"]
    return found


def _with_plan(canvas: Bytes, plan: Bytes) -> Bytes:
    """Put the plan view beside the picture, at the same height."""
    height = canvas.shape[0]
    size = (round(plan.shape[1] * height / plan.shape[0]), height)
    beside = cv2.resize(plan, size, interpolation=cv2.INTER_AREA)
    return np.hstack([canvas, np.asarray(beside, np.uint8)])


def _jpeg(pixels: NDArray[np.uint8], width_px: int) -> bytes:
    if pixels.shape[1] > width_px:
        size = (width_px, max(round(pixels.shape[0] * width_px / pixels.shape[1]), 1))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, content = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return bytes(content.tobytes())
