"""Contact sheet of a study: one frame of every drive with its detections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.detectors.cues.observed import FrameDetections
from crosscue.detectors.images import decode
from crosscue.detectors.overlay import draw_detections, write_label
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.stored_images import StoredCamera, picture_at, run_camera
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.scoring.runs import RunScored
from crosscue.replay.columns import Bytes, Int64s
from crosscue.replay.files.whole_file import write_bytes

# True distance to the intersection of the frame.
AWAY_M: Final = 18.0
TILE_PX: Final = (480, 270)
# Magnification of text and lines before a frame is reduced to its tile.
ENLARGE: Final = 2.0
QUALITY: Final = 80


def write_sheet(
    drives: Sequence[RunScored], path: Path, columns: int = 8, quality: int = QUALITY
) -> None:
    """Write a JPEG with one tile per drive.

    Args:
        drives: Runs with a finished detect stage; a run without its log has a black tile.
        path: JPEG file to write.
        columns: Max number of tiles per row.
        quality: Quality of the JPEG, 1 to 100.

    Raises:
        RunError: A table is damaged.
        OutputError: The file cannot be written.
    """
    import cv2

    tiles = [_tile(one) for one in drives]
    blank = np.zeros((TILE_PX[1], TILE_PX[0], 3), np.uint8)
    columns = min(columns, len(tiles))
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    _, coded = cv2.imencode(".jpg", np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, quality])
    write_bytes(path, coded.tobytes())


def _tile(one: RunScored) -> Bytes:
    import cv2

    camera = run_camera(one.run)
    frame = _frame_near(one)
    picture = None if camera is None or frame is None else _picture(camera, frame, one.run)
    if picture is None:
        picture = np.zeros((TILE_PX[1], TILE_PX[0], 3), np.uint8)
    tile = cv2.resize(picture, TILE_PX, interpolation=cv2.INTER_AREA)
    name = one.run.path.name
    found: Bytes = np.asarray(tile, np.uint8)
    write_label(found, name, (8, 20), (255, 255, 255), 0.6)
    return found


def _frame_near(one: RunScored) -> FrameDetections | None:
    """Return the frame nearest to ``AWAY_M`` before the first intersection."""
    times: Int64s = one.run.table("frames", ["t_ns"])["t_ns"].to_numpy()
    inside = times[one.truth.approach_at(times) >= 0]
    if not len(inside):
        return None
    away = np.abs(one.truth.start_m(inside) - AWAY_M)
    if not np.isfinite(away).any():
        return None
    wanted = int(inside[int(np.nanargmin(away))])
    detected = one.run.drive_manifest().detected
    if detected is None:
        return None
    for frame in stored_frames(one.run, detected.detectors, with_road_masks=True):
        if frame.t_ns == wanted:
            return frame
    return None


def _picture(camera: StoredCamera, frame: FrameDetections, run: RunFolder) -> Bytes | None:
    t_ns = frame.t_ns
    picture = picture_at(camera, t_ns)
    if picture is None:
        return None
    pixels, _ = decode(picture)
    return draw_detections(pixels, frame.found, _cues_at(run, t_ns), ENLARGE)


def _cues_at(run: RunFolder, t_ns: int) -> dict[str, int]:
    import pyarrow.compute as pc

    table = run.table("cues", ["t_ns", "cue", "count"])
    rows = table.filter(pc.equal(table["t_ns"], t_ns)).to_pylist()
    return {row["cue"]: row["count"] for row in rows}
