"""The map view from above: x east, y north, in metres."""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from crosscue.eval.scoring.pose.truth_track import TruthTrack
from crosscue.localization.ellipse import ellipses, position_cov
from crosscue.replay.colours import END, FOUND, LANDMARK, SIGMA, START, TRUTH

from .columns import DriveTime, Shapes, strips_above
from .scene_rows import SceneRows

PATH_POINTS: Final = 20_000
ELLIPSES_PER_S: Final = 5.0
HALF_ROAD_M: Final = 8.0
CAR_M: Final = 8.0
# Min length of the vehicle's arrow as a fraction of the track's extent.
CAR_SHARE: Final = 0.02
LANDMARK_POINTS: Final = 6.0
TRUE_CAR_POINTS: Final = 5.0


def log_pose(
    recording: rr.RecordingStream, time: DriveTime, pose: Mapping[str, NDArray[np.float64]]
) -> None:
    """Log the path, the vehicle and its ellipse."""
    recording.log("plan", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    t_ns = pose["t_ns"].astype(np.int64)
    thin = slice(None, None, max(1, len(t_ns) // PATH_POINTS))
    flat = np.stack([pose["x_m"], pose["y_m"], np.zeros(len(t_ns))], axis=1)
    recording.log(
        "plan/estimate",
        rr.LineStrips3D(_pieces(flat, pose["segment"], thin), colors=[FOUND]),
        static=True,
    )
    some = _every(t_ns, ELLIPSES_PER_S)
    times = time.column(t_ns[some])
    xx, xy, yy = (pose[f"cov_{name}"][some] for name in ("xx_m2", "xy_m2", "yy_m2"))
    rings = ellipses(flat[some, :2], position_cov(xx, xy, yy), 33)
    rings = np.pad(rings, ((0, 0), (0, 0), (0, 1)))
    recording.send_columns(
        "plan/ellipse", indexes=times, columns=rr.LineStrips3D.columns(strips=list(rings))
    )
    recording.log("plan/ellipse", rr.LineStrips3D.from_fields(colors=[SIGMA]), static=True)
    heading = pose["heading_rad"][some]
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))], axis=1)
    car_m = max(CAR_M, CAR_SHARE * float(np.ptp(flat, axis=0).max()))
    recording.send_columns(
        "plan/car",
        indexes=times,
        columns=rr.Arrows3D.columns(origins=flat[some], vectors=ahead * car_m),
    )
    recording.log(
        "plan/car", rr.Arrows3D.from_fields(colors=[FOUND], radii=[0.1 * car_m]), static=True
    )


def log_landmarks(
    recording: rr.RecordingStream,
    pose: Mapping[str, NDArray[np.float64]],
    names: Sequence[str | None],
) -> None:
    """Log the places at which landmarks were used, with their names."""
    rows = [i for i, name in enumerate(names) if name is not None]
    if not rows:
        return
    flat = np.stack([pose["x_m"][rows], pose["y_m"][rows], np.zeros(len(rows))], axis=1)
    recording.log(
        "plan/landmarks",
        rr.Points3D(
            flat,
            colors=[LANDMARK],
            radii=rr.Radius.ui_points(LANDMARK_POINTS),
            labels=[str(names[i]) for i in rows],
        ),
        static=True,
    )


def log_truth(recording: rr.RecordingStream, time: DriveTime, truth: TruthTrack) -> None:
    """Log the true path and the true position of the vehicle."""
    flat = np.stack([truth.x_m, truth.y_m, np.zeros(len(truth.t_ns))], axis=1)
    recording.log("plan/truth", rr.LineStrips3D([flat], colors=[TRUTH]), static=True)
    recording.send_columns(
        "plan/true_car",
        indexes=time.column(truth.t_ns),
        columns=rr.Points3D.columns(positions=flat),
    )
    dot = rr.Radius.ui_points(TRUE_CAR_POINTS)
    recording.log("plan/true_car", rr.Points3D.from_fields(colors=[TRUTH], radii=dot), static=True)


def log_intersection(
    recording: rr.RecordingStream,
    time: DriveTime,
    pose: Mapping[str, NDArray[np.float64]],
    scene: SceneRows,
) -> None:
    """Log bars across the road at the intersection's start and end, ahead of the estimated pose."""
    if scene.ranges is None:
        return
    t_ns = scene.ranges["t_ns"].to_numpy()
    x, y = (np.interp(t_ns, pose["t_ns"], pose[name]) for name in ("x_m", "y_m"))
    heading = np.interp(t_ns, pose["t_ns"], np.unwrap(pose["heading_rad"]))
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))], axis=1)
    aside = np.stack([-ahead[:, 1], ahead[:, 0], ahead[:, 2]], axis=1)
    middle = np.stack([x, y, np.zeros(len(x))], axis=1)
    middle += scene.ranges["range_m"].to_numpy()[:, None] * ahead
    bars = np.stack([middle - HALF_ROAD_M * aside, middle + HALF_ROAD_M * aside], axis=1)
    references = scene.ranges["reference"].to_pylist()
    first = np.searchsorted(t_ns, scene.frames_ns, side="left")
    last = np.searchsorted(t_ns, scene.frames_ns, side="right")
    shapes = Shapes("plan/intersection", strips_above)
    for frame_ns, a, b in zip(scene.frames_ns.tolist(), first, last, strict=True):
        shapes.begin(frame_ns)
        for row in range(a, b):
            shapes.add(bars[row], START if references[row] == "start" else END)
    shapes.send(recording, time)
    recording.log("plan/intersection", rr.LineStrips3D.from_fields(radii=[0.5]), static=True)


def _pieces(
    flat: NDArray[np.float64], segment: NDArray[np.float64], thin: slice
) -> list[NDArray[np.float64]]:
    """Split the path at the gaps of the drive."""
    breaks = np.flatnonzero(np.diff(segment[thin])) + 1
    return [np.asarray(part) for part in np.split(flat[thin], breaks)]


def _every(t_ns: NDArray[np.int64], rate_hz: float) -> NDArray[np.int64]:
    """Return the indices of about ``rate_hz`` rows per second, including the last row."""
    slots = (t_ns - t_ns[0]) // round(1e9 / rate_hz)
    first = np.flatnonzero(np.diff(slots, prepend=-1))
    return np.union1d(first, [len(t_ns) - 1]).astype(np.int64)
