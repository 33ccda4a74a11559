"""Compare the filter with a batch smoother, the best estimate that its measurements allow."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from crosscue.datasets.truth.tum import Trajectory, heading_rad, planar
from crosscue.eval.pipeline.pose import odometry_constants, odometry_settings
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.measurements import NUMBERS, TABLE, TURNS
from crosscue.localization.angles import wrap_all
from crosscue.localization.constants import NO_CONSTANTS, effects
from crosscue.localization.ekf import PoseBelief
from crosscue.localization.ellipse import position_cov
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import BY_NOTHING, BY_YAW_RATE, Increments
from crosscue.localization.pose_track import Headings
from crosscue.localization.smoother import smooth_poses
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import RunError, SchemaError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.signals.kinds import Signal

from .errors import FilterAndSmoother, NeesSummary, pair_poses, squared_errors, summarise_nees
from .score import MAX_DIFFERENCE_NS, at_truths_point, estimated_track, load_truth

TURN_SIGNALS: Final = {"yaw rate": Signal.YAW_RATE, "steering": Signal.STEERING}
MIN_STEP_NS: Final = 1_000_000_000
UPPER: Final = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))


@dataclass(frozen=True, slots=True)
class SmootherScore:
    """Errors of filter and smoother at the same true poses, 1 s or more apart, not aligned.

    Attributes:
        poses: Number of poses.
        filter_rmse_m: Position error of the filter.
        smoother_rmse_m: Position error of the smoother.
        filter_heading_rmse_rad: Heading error of the filter.
        smoother_heading_rmse_rad: Heading error of the smoother.
        filter_end_m: Error of the filter's last position, where both use the same measurements.
        smoother_end_m: Error of the smoother's last position.
        filter_nees_xyh: Consistency of the filter.
        smoother_nees_xyh: Consistency of the smoother.
        range: Errors of the range filter and of its smoother, by reference.
    """

    poses: int
    filter_rmse_m: float
    smoother_rmse_m: float
    filter_heading_rmse_rad: float
    smoother_heading_rmse_rad: float
    filter_end_m: float
    smoother_end_m: float
    filter_nees_xyh: NeesSummary
    smoother_nees_xyh: NeesSummary
    range: Mapping[str, FilterAndSmoother]


def score_smoother(
    run: RunFolder, truth_path: Path, ranges: Mapping[str, FilterAndSmoother]
) -> SmootherScore:
    """Smooth a run's measurements, compare with truth, write ``score/smoother.json``.

    Args:
        run: A finished run.
        truth_path: Truth of its drive.
        ranges: Errors of the range filter and of its smoother, by reference.

    Raises:
        RunError: The run has no table of measurements.
        SchemaError: The truth does not fit the run.
    """
    truth, track = load_truth(truth_path)
    run.refuse_set_back("the smoother")
    measured = read_measured(run)
    vehicle = run.drive_manifest().settings
    first_ns, last_ns = measured.start.t_ns, int(measured.increments.stop_ns[-1])
    wanted = _thinned(track.t_ns[(track.t_ns > first_ns) & (track.t_ns <= last_ns)])
    if not len(wanted):
        raise SchemaError(
            f"{truth_path}: no time in common with the run; it belongs to another log"
        )
    camera, antenna = (np.array([at.x_m, at.y_m]) for at in (vehicle.camera, vehicle.gnss))
    lever_m = np.where(measured.is_gnss[:, None], antenna, camera)
    made = measured.increments
    constants = NO_CONSTANTS
    if measured.turn_from:
        turn = next((TURN_SIGNALS[one] for one in measured.turn_from if one in TURN_SIGNALS), None)
        constants = odometry_constants(vehicle, turn) or NO_CONSTANTS
    by = effects(made, odometry_settings(vehicle), constants.names)
    # Motion that is assumed between time segments has no such errors.
    by[made.is_gap] = 0.0
    found = smooth_poses(
        measured.start, made, measured.headings, measured.fixes, wanted, lever_m, (constants, by)
    )
    rows = np.searchsorted(track.t_ns, wanted)
    x_m, y_m, _ = track.xyz_m[rows].T
    true = planar(wanted, x_m, y_m, heading_rad(track)[rows])
    smoothed = at_truths_point(
        found.t_ns, found.xyh, found.cov[:, UPPER[0], UPPER[1]], vehicle, truth
    )
    filtered = estimated_track(run.table("pose"), vehicle, truth)
    result = _compared(true, filtered, smoothed, ranges)
    folder = run.file("score")
    folder.mkdir(exist_ok=True)
    write_text(folder / "smoother.json", strict_json(asdict(result)) + "\n")
    return result


def _thinned(t_ns: Int64s) -> Int64s:
    """Return times at least ``MIN_STEP_NS`` apart, including the last one."""
    kept: list[int] = []
    for t in reversed(t_ns.tolist()):
        if not kept or kept[-1] - t >= MIN_STEP_NS:
            kept.append(t)
    return np.array(kept[::-1], np.int64)


def _compared(
    true: Trajectory,
    filtered: tuple[Trajectory, Floats],
    smoothed: tuple[Trajectory, Floats],
    ranges: Mapping[str, FilterAndSmoother],
) -> SmootherScore:
    apart: list[tuple[float, float, float]] = []
    nees_of_tracks: list[NeesSummary] = []
    for track, cov in (filtered, smoothed):
        paired = pair_poses(true, track, MAX_DIFFERENCE_NS, cov)
        errors = paired.estimate.xyz_m[:, :2] - paired.truth.xyz_m[:, :2]
        metres = np.hypot(*errors.T)
        turns = wrap_all(heading_rad(paired.estimate) - heading_rad(paired.truth))
        apart.append((_rms(metres), _rms(turns), float(metres[-1])))
        nees_of_tracks.append(summarise_nees(squared_errors(paired, 3), 3))
    (filter_m, filter_rad, filter_end), (smoother_m, smoother_rad, smoother_end) = apart
    return SmootherScore(
        len(true),
        filter_m,
        smoother_m,
        filter_rad,
        smoother_rad,
        filter_end,
        smoother_end,
        nees_of_tracks[0],
        nees_of_tracks[1],
        ranges,
    )


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(values**2)))


def smoother_text(result: SmootherScore) -> str:
    """Return the comparison as text, for the end of the score's summary."""
    ratio = result.filter_rmse_m / result.smoother_rmse_m if result.smoother_rmse_m else math.inf
    degrees = 180.0 / math.pi
    return "\n".join(
        [
            f"filter against batch smoother, {result.poses} poses: rmse {result.filter_rmse_m:.3f} "
            f"and {result.smoother_rmse_m:.3f} m (ratio {ratio:.2f}),",
            f"  heading {degrees * result.filter_heading_rmse_rad:.3f} and "
            f"{degrees * result.smoother_heading_rmse_rad:.3f} deg, at the end "
            f"{result.filter_end_m:.3f} and {result.smoother_end_m:.3f} m,",
            f"  mean NEES {result.filter_nees_xyh.mean:.2f} and "
            f"{result.smoother_nees_xyh.mean:.2f} (3 is consistent)",
            *(
                f"range to {name}, filter and smoother, {one.rows} rows: rmse "
                f"{one.filter_rmse_m:.2f} and {one.smoother_rmse_m:.2f} m, mean NEES "
                f"{one.filter_nees:.2f} and {one.smoother_nees:.2f} (1 is consistent)"
                for name, one in result.range.items()
            ),
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class RunMeasurements:
    """All measurements of a run.

    Attributes:
        start: The first belief.
        increments: Odometry.
        headings: Headings that the filter used.
        fixes: Positions of the camera from landmarks, and of the antenna from GNSS.
        is_gnss: Shape (N,): True for fixes from GNSS.
        turn_from: Signals of the turns; empty for odometry by pictures.
    """

    start: PoseBelief
    increments: Increments
    headings: Headings
    fixes: Fixes
    is_gnss: NDArray[np.bool_]
    turn_from: tuple[str, ...]


def read_measured(run: RunFolder) -> RunMeasurements:
    """Read the measurements of a finished run.

    Raises:
        RunError: The table is missing (a run of an older crosscue), damaged, or empty.
    """
    import pyarrow.compute as pc

    table = run.table(TABLE)

    def of(*kinds: str) -> dict[str, Floats]:
        part = table.filter(pc.is_in(table["kind"].cast("string"), pa.array(kinds)))
        names = ("start_ns", "t_ns", *NUMBERS)
        return {name: part[name].to_numpy() for name in names}

    start, heading, gaps = map(of, ("start", "heading", "gap"))
    odometry, fixes = of("odometry", "gap"), of("landmark", "position")
    is_gap = np.isin(odometry["t_ns"], gaps["t_ns"]) & np.isin(
        odometry["start_ns"], gaps["start_ns"]
    )
    if len(start["t_ns"]) != 1 or not len(odometry["t_ns"]):
        raise RunError(f"{run.path}: contains no odometry, so there is nothing to smooth")
    is_odometry = pc.is_in(table["kind"].cast("string"), pa.array(["odometry", "gap"]))
    turn_from = table.filter(is_odometry)["turn_from"].to_pylist()
    codes = {name: code for code, name in TURNS.items()}
    sources = np.array([codes.get(name, BY_YAW_RATE) for name in turn_from])
    cov = np.zeros((4, 4))
    cov[:2, :2] = _matrices(start)[0]
    cov[2, 2], cov[3, 3] = start["heading_var_rad2"][0], start["speed_var_m2ps2"][0]
    mean = np.array([start[name][0] for name in ("x_m", "y_m", "heading_rad", "speed_mps")])
    return RunMeasurements(
        PoseBelief(int(start["t_ns"][0]), mean, cov),
        Increments(
            start_ns=odometry["start_ns"].astype(np.int64),
            stop_ns=odometry["t_ns"].astype(np.int64),
            distance_m=odometry["distance_m"],
            turn_rad=odometry["turn_rad"],
            distance_var_m2=odometry["distance_var_m2"],
            turn_var_rad2=odometry["turn_var_rad2"],
            speed_mps=odometry["speed_mps"],
            speed_var_m2ps2=odometry["speed_var_m2ps2"],
            turn_source=np.where(is_gap, BY_NOTHING, sources).astype(np.uint8),
            is_gap=is_gap,
        ),
        Headings(
            heading["t_ns"].astype(np.int64), heading["heading_rad"], heading["heading_var_rad2"]
        ),
        Fixes(
            fixes["t_ns"].astype(np.int64),
            np.column_stack([fixes["x_m"], fixes["y_m"]]),
            _matrices(fixes),
        ),
        np.isin(fixes["t_ns"], of("position")["t_ns"]),
        tuple(dict.fromkeys(name for name in turn_from if name)),
    )


def _matrices(columns: Mapping[str, Floats]) -> Floats:
    return position_cov(*(columns[name] for name in ("xx_m2", "xy_m2", "yy_m2")))
