"""Top view of the area ahead of the vehicle, in its own frame in metres; up is ahead.

The intersection is drawn across the road at its estimated range, with its 2-sigma band. Lanes and
vehicles are the Mobileye's latest reports at that time.
"""

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.mobileye_tables import StoredMobileye
from crosscue.eval.scoring.truth import TrueRanges
from crosscue.replay.colours import END, FAINT, FOUND, LANE, QUIET, START, TRUTH
from crosscue.replay.mobileye.geometry import evaluate
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS
from crosscue.replay.vehicle.vehicle import Vehicle

from .columns import DriveTime, Shapes, boxes, labelled_strips, points, strips
from .layout import ASIDE_M, BEHIND_M, FAR_M
from .scene_rows import SceneRows

HALF_ROAD_M: Final = 9.0
# Distance of the labels of metres from the edge, so that they are not cut off.
LABEL_M: Final = 5.0
LANE_POINTS: Final = 13
FRAMES_HELD: Final = 1024
KINDS: Final[Mapping[int, str]] = {0: "car", 1: "truck", 2: "bike", 3: "person", 4: "bicycle"}
_LANE: Final = {name: i for i, name in enumerate(LANE_COLUMNS)}
_OBSTACLE: Final = {name: i for i, name in enumerate(OBSTACLE_COLUMNS)}
_CUBIC: Final = [_LANE[name] for name in ("c0_m", "c1", "c2_per_m", "c3_per_m2")]


def log_ahead(
    recording: rr.RecordingStream,
    time: DriveTime,
    run: RunFolder,
    vehicle: Vehicle,
    scene: SceneRows,
    truth: TrueRanges | None,
) -> None:
    """Log everything ahead of the vehicle, frame by frame."""
    _log_ground(recording, vehicle)
    _log_intersection(recording, time, scene)
    _log_mobileye(recording, time, StoredMobileye(run, vehicle.past), scene)
    if truth is not None:
        _log_truth(recording, time, truth)


def above(x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert from the vehicle's frame to the view's (x right, y down), shape (N, 2)."""
    return np.stack([-y_m, -x_m], axis=-1)


def _log_ground(recording: rr.RecordingStream, vehicle: Vehicle) -> None:
    tens = np.arange(0.0, FAR_M + 1.0, 10.0)
    lines = [above(np.array([x, x]), np.array([-ASIDE_M, ASIDE_M])) for x in tens]
    recording.log("ahead/grid", rr.LineStrips2D(lines, colors=[FAINT], radii=[0.08]), static=True)
    marks = above(tens, np.full(len(tens), ASIDE_M - LABEL_M))
    recording.log(
        "ahead/metres",
        rr.Points2D(
            marks,
            colors=[QUIET],
            radii=[0.0],
            labels=[f"{x:.0f} m" for x in tens],
            show_labels=True,
        ),
        static=True,
    )
    length_m = vehicle.odometry.wheelbase_m + 1.8
    recording.log(
        "ahead/car",
        rr.Boxes2D(
            centers=[[0.0, 0.9 - length_m / 2]], half_sizes=[[0.9, length_m / 2]], colors=[FOUND]
        ),
        static=True,
    )


def _log_intersection(recording: rr.RecordingStream, time: DriveTime, scene: SceneRows) -> None:
    if scene.ranges is None:
        return
    columns = [scene.ranges[n].to_pylist() for n in ("t_ns", "reference", "range_m", "var_m2")]
    rows: dict[int, list[tuple[str, float, float]]] = {}
    for t_ns, reference, range_m, var_m2 in zip(*columns, strict=True):
        rows.setdefault(t_ns, []).append((reference, range_m, var_m2))
    bars = Shapes("ahead/intersection", labelled_strips)
    bands = Shapes("ahead/band", boxes)
    for t_ns in scene.frames_ns.tolist():
        bars.begin(t_ns)
        bands.begin(t_ns)
        for reference, range_m, var_m2 in rows.get(t_ns, []):
            colour = START if reference == "start" else END
            two_sd_m = 2.0 * float(np.sqrt(var_m2))
            bar = above(np.full(2, range_m), np.array([-HALF_ROAD_M, HALF_ROAD_M]))
            bars.add(bar, colour, f"{reference} {range_m:.0f} ± {two_sd_m:.0f} m")
            far, near = -range_m - two_sd_m, -range_m + two_sd_m
            bands.add(np.array([-HALF_ROAD_M, far, HALF_ROAD_M, near]), colour)
    bars.send(recording, time)
    bands.send(recording, time)
    recording.log("ahead/intersection", rr.LineStrips2D.from_fields(radii=[0.5]), static=True)
    recording.log(
        "ahead/band", rr.Boxes2D.from_fields(radii=[0.12], show_labels=False), static=True
    )


def _log_truth(recording: rr.RecordingStream, time: DriveTime, truth: TrueRanges) -> None:
    shapes = Shapes("ahead/truth", strips)
    for t_ns, start_m, end_m in zip(truth.t_ns.tolist(), truth.start_m, truth.end_m, strict=True):
        shapes.begin(t_ns)
        for range_m in (start_m, end_m):
            if -BEHIND_M < range_m < 2.0 * FAR_M:
                across = np.array([-ASIDE_M, ASIDE_M])
                shapes.add(above(np.full(2, range_m), across), TRUTH)
    # The truth ends at the intersection; clear the bar there.
    if len(truth.t_ns):
        shapes.begin(int(truth.t_ns[-1]) + 1)
    shapes.send(recording, time)
    recording.log("ahead/truth", rr.LineStrips2D.from_fields(radii=[0.2]), static=True)


def _log_mobileye(
    recording: rr.RecordingStream, time: DriveTime, stored: StoredMobileye, scene: SceneRows
) -> None:
    vehicles = Shapes("ahead/mobileye_objects", points)
    lanes = Shapes("ahead/mobileye_lanes", strips)
    for number, t_ns in enumerate(scene.frames_ns.tolist()):
        state = stored.at(t_ns)
        vehicles.begin(t_ns)
        lanes.begin(t_ns)
        for row in [] if state.obstacles is None else state.obstacles:
            place = np.array([-row[_OBSTACLE["y_m"]], -row[_OBSTACLE["x_m"]]])
            vehicles.add(place, FOUND, KINDS.get(int(row[_OBSTACLE["type"]]), "object"))
        for line in _lanes(state.lanes):
            lanes.add(line, LANE)
        if number % FRAMES_HELD == FRAMES_HELD - 1:
            vehicles.send(recording, time)
            lanes.send(recording, time)
    vehicles.send(recording, time)
    lanes.send(recording, time)
    # Labels of vehicles side by side would cover each other; they appear under the pointer.
    style = rr.Points2D.from_fields(radii=[1.1], show_labels=False)
    recording.log("ahead/mobileye_objects", style, static=True)
    recording.log("ahead/mobileye_lanes", rr.LineStrips2D.from_fields(radii=[0.15]), static=True)


def _lanes(lanes: NDArray[np.float64] | None) -> Iterator[NDArray[np.float64]]:
    for row in [] if lanes is None else lanes:
        end_m = row[_LANE["x_end_m"]]
        if np.isfinite(row[_CUBIC]).all() and np.isfinite(end_m):
            x_m = np.linspace(0.0, end_m, LANE_POINTS)
            yield above(x_m, evaluate(row[_CUBIC], x_m))
