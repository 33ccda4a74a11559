"""Pictures of the intersections study: distances (Fig. 29), beliefs (Fig. 31), a contact sheet."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from crosscue.detectors.cues.observed import FrameDetections
from crosscue.detectors.images import decode
from crosscue.detectors.overlay import draw_detections, write_label
from crosscue.eval.report.scene_figures import PUBLISHED_DETECTED_M, PUBLISHED_FULL_M
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.stored_images import StoredCamera, picture_at, run_camera
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.scoring.runs import RunScored
from crosscue.eval.scoring.scene.approaches import ApproachResult, Curve
from crosscue.eval.scoring.scene.belief import BeliefScore
from crosscue.eval.studies.pictures import bare_figure, save_png
from crosscue.replay.columns import Bytes, Int64s
from crosscue.replay.files.whole_file import write_bytes

COLOURS: Final[Mapping[str, str]] = {
    "intersection": "#444444", "left": "#1f77b4", "right": "#d62728", "straight": "#2ca02c",
}  # fmt: skip
SPREAD: Final = 0.28
FAR_M: Final = 120.0
# True distance to the intersection of the frame.
AWAY_M: Final = 18.0
TILE_PX: Final = (480, 270)
# Magnification of text and lines before a frame is reduced to its tile.
ENLARGE: Final = 2.0
QUALITY: Final = 80


def draw_study_distances(results: Sequence[ApproachResult], path: Path) -> None:
    """Draw distances at detection and at full detection, one point per approach.

    Approaches that were never detected are at the bottom.
    """
    names = sorted({one.intersection for one in results})
    made, axes = bare_figure((7.5, 4.0))
    for kind, (colour, label, shift) in {
        "detected_m": ("#444444", "intersection", -0.12),
        "full_m": ("#1f77b4", "full intersection", 0.12),
    }.items():
        x, y, failed = [], [], []
        for number, name in enumerate(names):
            mine = [one for one in results if one.intersection == name]
            places = np.linspace(-SPREAD / 2, SPREAD / 2, len(mine)) * 0.7
            for place, one in zip(places, mine, strict=True):
                value = getattr(one, kind)
                at = number + shift + place * 0.6
                if value is None:
                    failed.append(at)
                else:
                    x.append(at)
                    y.append(value)
            found = [getattr(one, kind) for one in mine if getattr(one, kind) is not None]
            if found:
                mean = float(np.mean(found))
                axes.hlines(mean, number + shift - 0.14, number + shift + 0.14, colour, lw=2)
        axes.plot(x, y, "o", color=colour, ms=3.5, alpha=0.7, label=label)
        axes.plot(failed, [-3.0] * len(failed), "x", color=colour, ms=5)
    for value, colour, text in (
        (PUBLISHED_DETECTED_M, "#444444", "published mean 34.4 m"),
        (PUBLISHED_FULL_M, "#1f77b4", "published mean 16.2 m"),
    ):
        axes.axhline(value, color=colour, lw=0.8, ls=":", label=text)
    axes.set_xticks(range(len(names)), names)
    axes.set_xlabel("intersection (simulated)")
    axes.set_ylabel("distance of the rear axle, m (x: never)")
    axes.set_ylim(-7.0, None)
    axes.grid(axis="y", alpha=0.3)
    axes.legend(fontsize=7, ncols=2, loc="upper right")
    save_png(made, path)


def draw_beliefs(curves: Sequence[Curve], path: Path) -> None:
    """Draw probabilities over distance, with a panel per intersection and a line per drive."""
    names = sorted({one.intersection for one in curves})
    columns = 4 if len(names) > 3 else max(len(names), 1)
    rows = max(-(-len(names) // columns), 1)
    size = (2.6 * columns, 2.2 * rows + 0.4)
    figure, grid = bare_figure(size, rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, name in zip(grid.ravel(), names, strict=False):
        for curve in curves:
            if curve.intersection == name:
                for feature, colour in COLOURS.items():
                    values = curve.features.get(feature)
                    if values is not None:
                        axes.plot(curve.distance_m, values, color=colour, lw=0.9, alpha=0.6)
        axes.axhline(0.9, color="#999999", lw=0.7, ls="--")
        axes.set_title(name, fontsize=9)
        axes.set_xlim(FAR_M, 0.0)
        axes.set_ylim(-0.02, 1.02)
        axes.tick_params(labelsize=7)
    for axes in grid.ravel()[len(names) :]:
        axes.axis("off")
    for feature, colour in COLOURS.items():
        grid[0, 0].plot([], [], color=colour, label=feature)
    figure.legend(loc="outside upper center", ncols=len(COLOURS), fontsize=8)
    figure.supxlabel("true distance to the intersection, m (simulated)", fontsize=8)
    figure.supylabel("probability", fontsize=8)
    save_png(figure, path)


def draw_study_reliability(
    source: Mapping[str, BeliefScore], calibrated: Mapping[str, BeliefScore] | None, path: Path
) -> None:
    """Draw the frequency of features over their probability, for one or both fusions."""
    names = [name for name in COLOURS if name in source]
    columns = max(len(names), 1)
    figure, grid = bare_figure((2.4 * columns, 2.7), 1, columns, sharey=True, squeeze=False)
    for axes, name in zip(grid[0], names, strict=False):
        axes.plot([0, 1], [0, 1], color="#999999", lw=0.7, ls="--")
        for scores, colour, label in (
            (source, "#d62728", "source"),
            (calibrated, "#1f77b4", "calibrated"),
        ):
            if scores is None or name not in scores:
                continue
            some = [one for one in scores[name].reliability if one.steps]
            x = [one.mean_probability for one in some]
            y = [one.there.value for one in some]
            sizes = [12.0 + 60.0 * one.steps / max(scores[name].scored, 1) for one in some]
            axes.plot(x, y, color=colour, lw=0.8, label=label)
            axes.scatter(x, y, s=sizes, color=colour, alpha=0.6)
        axes.set_title(name, fontsize=9)
        axes.set_xlabel("held probable", fontsize=8)
        axes.tick_params(labelsize=7)
    grid[0, 0].set_ylabel("observed fraction", fontsize=8)
    grid[0, 0].legend(fontsize=7)
    save_png(figure, path)


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
    tiles = [_tile(one) for one in drives]
    blank = np.zeros((TILE_PX[1], TILE_PX[0], 3), np.uint8)
    columns = min(columns, len(tiles))
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    _, coded = cv2.imencode(".jpg", np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, quality])
    write_bytes(path, coded.tobytes())


def _tile(one: RunScored) -> Bytes:
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
    manifest = one.run.drive_manifest()
    if manifest.detected is None:
        return None
    frames = stored_frames(one.run, manifest.detected, manifest.settings, with_road_masks=True)
    return next((frame for frame in frames if frame.t_ns == wanted), None)


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
