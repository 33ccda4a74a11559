"""Errors of a run's pose as defined by evo, and their consistency.

Both tracks are projected onto the plane, because the filter has no z, roll and pitch. They are
compared at the body whose track the truth contains, and written as TUM files, for which evo yields
the same numbers.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.datasets.truth import truth as truth_file
from crosscue.datasets.truth.truth import Truth
from crosscue.datasets.truth.tum import Trajectory, heading_rad, planar, read_tum, write_tum
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import OWN_FRAME
from crosscue.eval.runs.tables.log_time import ClockGap, comes_twice, gaps_of, table_in_log_time
from crosscue.localization.angles import wrap_all
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import SchemaError
from crosscue.replay.files.tree_text import spelled
from crosscue.replay.vehicle.vehicle import Vehicle

from .errors import (
    Alignment,
    Coverage,
    ErrorStatistics,
    NeesSummary,
    Paired,
    PoseErrors,
    align,
    ape,
    pair_poses,
    rpe,
    squared_errors,
    statistics,
    summarise_nees,
)
from .truth_track import TruthTrack

MAX_DIFFERENCE_NS: Final = 100_000_000
COVARIANCES: Final = ("xx_m2", "xy_m2", "xh_mrad", "yy_m2", "yh_mrad", "hh_rad2")
PLANE: Final[tuple[Literal[2, 3], ...]] = (2, 3)
NO_NEES: Final = (
    "the run's frame is its own: neither start heading nor compass; set [start] heading_rad"
)
ALIGNMENTS: Final[tuple[Alignment, ...]] = ("none", "origin", "yaw")
# Distances of the relative pose error.
RPE_M: Final = (10.0, 100.0)


@dataclass(frozen=True, slots=True)
class PlaneMounting:
    """Mounting, in the ground plane, of the body at which poses are compared.

    Attributes:
        body: Body whose track the truth contains.
        x_m: Distance ahead of the rear axle.
        y_m: Distance to the left.
        yaw_rad: Yaw, counter-clockwise.
        source: Origin of these values.
        assumed: Those of the three that the truth file lacks, so that the vehicle file's value is
            used, or zero.
    """

    body: str
    x_m: float
    y_m: float
    yaw_rad: float
    source: str = ""
    assumed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class PoseErrorSummary:
    """Translation errors in metres and rotation errors in degrees, with evo's names."""

    translation_m: ErrorStatistics
    rotation_deg: ErrorStatistics


@dataclass(frozen=True, slots=True)
class PoseScore:
    """Scores of a pose track.

    Attributes:
        coverage: Numbers of true poses that were scored or left out.
        distance_m: Length of the scored true track.
        ape: Absolute pose errors by alignment.
        rpe: Relative pose errors by distance, such as ``100 m``, up to the length of the drive.
        nees_xy: Consistency of position errors; NaN with ``why_no_nees``.
        nees_xyh: Consistency of position and heading errors; NaN with ``why_no_nees``.
        major_axis_m: Full major axis of the 2-sigma ellipse at the end.
        lost_at_m: Distance travelled when that axis first exceeded the vehicle file's limit, or
            None.
        compared_at: The body whose pose is compared, and its mounting.
        why_no_nees: Reason why there is no NEES; empty if there is.
    """

    coverage: Coverage
    distance_m: float
    ape: dict[str, PoseErrorSummary]
    rpe: dict[str, PoseErrorSummary]
    nees_xy: NeesSummary
    nees_xyh: NeesSummary
    major_axis_m: float
    lost_at_m: float | None
    compared_at: PlaneMounting
    why_no_nees: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ScoredPoses:
    """Estimated and true poses at the same times, in the map frame, for figures.

    Attributes:
        t_ns: Shape (N,), int64.
        estimate_m: Shape (N, 2).
        truth_m: Shape (N, 2).
        heading_error_rad: Shape (N,): estimate minus truth, wrapped.
        cov: Shape (N, 3, 3): the filter's covariance of x, y, heading.
        nees: Shape (N,): normalised estimation error squared of x, y, heading.
        travelled_m: Shape (N,).
        major_axis_m: Shape (N,).
        lost_above_m: The vehicle file's limit of the major axis.
        title: Names of the run and of the truth.
        gaps: Gaps of the drive.
    """

    t_ns: Int64s
    estimate_m: Floats
    truth_m: Floats
    heading_error_rad: Floats
    cov: Floats
    nees: Floats
    travelled_m: Floats
    major_axis_m: Floats
    lost_above_m: float
    title: str
    gaps: tuple[ClockGap, ...] = ()


def load_truth(path: Path) -> tuple[Truth, Trajectory]:
    """Read a truth file and its trajectory.

    Raises:
        SchemaError: The file is not valid, or has no pose.
        LogError: The trajectory cannot be read.
    """
    truth = truth_file.read_truth(path)
    folder = path if path.is_dir() else path.parent
    if truth.pose is None:
        raise SchemaError(f"{path}: pose: missing; name a TUM file with the true track")
    return truth, read_tum(folder / truth.pose)


def truth_track(path: Path, run: RunFolder) -> TruthTrack:
    """Return the true track within a run's time, for drawing.

    Raises:
        SchemaError: The truth does not fit the run.
    """
    truth, track = load_truth(path)
    table = table_in_log_time(run.table("pose"), run.drive_manifest().timeline)
    inside = _inside(track, table, path)
    east_m, north_m = map_shift(run.drive_manifest().settings, truth)
    x_m, y_m = track.xyz_m[inside, 0] - east_m, track.xyz_m[inside, 1] - north_m
    return TruthTrack(track.t_ns[inside], x_m, y_m)


def measure_pose(run: RunFolder, truth_path: Path) -> tuple[PoseScore, ScoredPoses]:
    """Score a run's pose; write both tracks to its ``score`` folder.

    Args:
        run: A finished run.
        truth_path: ``truth.json``.

    Raises:
        RunError: The run's tables are missing or damaged.
        SchemaError: The truth does not fit the run.
    """
    truth, track = load_truth(truth_path)
    table = table_in_log_time(run.table("pose"), run.drive_manifest().timeline)
    vehicle = run.drive_manifest().settings
    _inside(track, table, truth_path)
    estimate, cov = estimated_track(table, vehicle, truth)
    flat = planar(track.t_ns, track.xyz_m[:, 0], track.xyz_m[:, 1], heading_rad(track))
    paired = _paired(flat, estimate, cov, comes_twice(run.drive_manifest().timeline, flat.t_ns))
    why_no_nees = NO_NEES if OWN_FRAME in run.drive_manifest().notices else ""
    # Errors between two frames cannot be compared with a covariance in one of them.
    nees_xy, values = (
        np.full(len(paired.truth), np.nan) if why_no_nees else squared_errors(paired, dimensions)
        for dimensions in PLANE
    )
    result = PoseScore(
        coverage=paired.coverage,
        distance_m=_length(paired.truth.xyz_m),
        ape={how: _ape(paired, how) for how in ALIGNMENTS},
        rpe=_rpe(paired),
        nees_xy=summarise_nees(nees_xy, 2),
        nees_xyh=summarise_nees(values, 3),
        major_axis_m=float(table["major_axis_m"][-1].as_py()),
        lost_at_m=_lost_at(table, vehicle.lost_above_m),
        compared_at=track_mounting(truth, vehicle),
        why_no_nees=why_no_nees,
    )
    folder = run.file("score")
    write_tum(folder / "estimate.tum", paired.estimate, "crosscue estimate, planar")
    write_tum(folder / "truth.tum", paired.truth, "truth, planar")
    title = f"{spelled(run.path.name)} against {truth.source or truth_path.name}"
    gaps = gaps_of(run.drive_manifest().timeline)
    return result, _scored(paired, values, table, vehicle.lost_above_m, title, gaps)


def _paired(
    truth: Trajectory, estimate: Trajectory, cov: Floats, twice: NDArray[np.bool_]
) -> Paired:
    """Return pairs, without true poses at times that occur twice, which are counted."""
    if not twice.any():
        return pair_poses(truth, estimate, MAX_DIFFERENCE_NS, cov)
    paired = pair_poses(truth.take(~twice), estimate, MAX_DIFFERENCE_NS, cov)
    counts = paired.coverage
    ambiguous = int(twice.sum())
    total = counts.truth_poses + ambiguous
    return replace(paired, coverage=replace(counts, truth_poses=total, ambiguous=ambiguous))


def _inside(track: Trajectory, table: pa.Table, path: Path) -> NDArray[np.bool_]:
    """Return True for true poses within the run's time.

    Raises:
        SchemaError: No pose is, so the truth belongs to another log or clock.
    """
    if not table.num_rows:
        raise SchemaError(f"{path}: the run has no pose to score; see its notices")
    first_ns, last_ns = table["t_ns"][0].as_py(), table["t_ns"][-1].as_py()
    inside = (track.t_ns >= first_ns) & (track.t_ns <= last_ns)
    if not inside.any():
        raise SchemaError(
            f"{path}: truth covers {track.t_ns[0]} to {track.t_ns[-1]} ns, the run of "
            f"{first_ns} to {last_ns} ns; it belongs to another log or clock"
        )
    return np.asarray(inside)


def estimated_track(table: pa.Table, vehicle: Vehicle, truth: Truth) -> tuple[Trajectory, Floats]:
    """Return the estimated track of the truth's body, with its covariance."""
    xyh = np.column_stack([table[name].to_numpy() for name in ("x_m", "y_m", "heading_rad")])
    cov = np.column_stack([table[f"cov_{name}"].to_numpy() for name in COVARIANCES])
    return at_truths_point(table["t_ns"].to_numpy(), xyh, cov, vehicle, truth)


def track_mounting(truth: Truth, vehicle: Vehicle) -> PlaneMounting:
    """Return the mounting from the truth file, or from the vehicle file where it is missing."""
    camera, gnss, body = vehicle.camera, vehicle.gnss, truth.pose_point
    of_vehicle = {
        "camera": (camera.x_m, camera.y_m, camera.yaw_rad),
        "antenna": (gnss.x_m, gnss.y_m, 0.0),
    }.get(body, (0.0, 0.0, 0.0))
    given = truth.mounting
    if given is None:
        source = {"camera": "[camera] of the vehicle file", "antenna": "[gnss] of the vehicle file"}
        return PlaneMounting(body, *of_vehicle, source=source.get(body, ""))
    stated = {"x_m": given.x_m, "y_m": given.y_m, "yaw_rad": given.yaw_rad}
    x_m, y_m, yaw_rad = (
        spare if value is None else value
        for value, spare in zip(stated.values(), of_vehicle, strict=True)
    )
    assumed = tuple(name for name, value in stated.items() if value is None)
    return PlaneMounting(body, x_m, y_m, yaw_rad, truth.mounting_source, assumed)


def at_truths_point(
    t_ns: Int64s, xyh: Floats, cov_xyh: Floats, vehicle: Vehicle, truth: Truth
) -> tuple[Trajectory, Floats]:
    """Transform rear-axle poses, shape (N, 3), to the body whose track the truth contains.

    The returned covariance is that of estimate minus truth, so it includes the truth's.

    Args:
        t_ns: Shape (N,).
        xyh: Shape (N, 3).
        cov_xyh: Shape (N, 6): covariance of x, y, heading: xx, xy, xh, yy, yh, hh.
        vehicle: Has the mounting of camera and antenna, unless the truth has it.
        truth: Names the body whose track it contains.
    """
    x, y, heading = xyh.T
    east_m, north_m = map_shift(vehicle, truth)
    x, y = x + east_m, y + north_m
    cov = cov_xyh
    mounting = track_mounting(truth, vehicle)
    ahead, left = mounting.x_m, mounting.y_m
    if ahead or left:
        cos, sin = np.cos(heading), np.sin(heading)
        dx, dy = ahead * cos - left * sin, ahead * sin + left * cos
        x, y = x + dx, y + dy
        # A heading error moves the point sideways, which the covariance must include.
        xx, xy, xh, yy, yh, hh = cov.T
        cov = np.column_stack(
            [
                xx - 2 * dy * xh + dy * dy * hh,
                xy + dx * xh - dy * yh - dx * dy * hh,
                xh - dy * hh,
                yy + 2 * dx * yh + dx * dx * hh,
                yh + dx * hh,
                hh,
            ]
        )
    if truth.position_sd_m is not None:
        cov = cov + truth.position_sd_m**2 * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    if truth.heading_sd_rad is not None:
        cov = cov + truth.heading_sd_rad**2 * np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    return planar(t_ns, x, y, heading + mounting.yaw_rad), cov


def map_shift(vehicle: Vehicle, truth: Truth) -> tuple[float, float]:
    """Return the origin of a run's map in the truth's map; both axes point east, a few km apart."""
    of_run, of_truth = vehicle.start.map_origin, truth.origin
    if of_run is None or of_truth is None:
        return 0.0, 0.0
    there = of_truth.latitude_deg, of_truth.longitude_deg, of_truth.altitude_m
    latitude, longitude, altitude = of_run
    (east_m, north_m, _), *_ = geodetic_to_enu(latitude, longitude, altitude, there).tolist()
    return east_m, north_m


def _ape(paired: Paired, how: Alignment) -> PoseErrorSummary:
    return _summary(ape(paired.truth, align(paired.truth, paired.estimate, how)))


def _rpe(paired: Paired) -> dict[str, PoseErrorSummary]:
    distance_m = _length(paired.estimate.xyz_m)
    return {
        f"{size_m:g} m": _summary(rpe(paired.truth, paired.estimate, size_m))
        for size_m in RPE_M
        if size_m < distance_m
    }


def _summary(errors: PoseErrors) -> PoseErrorSummary:
    return PoseErrorSummary(
        statistics(errors.translation_m), statistics(np.rad2deg(errors.rotation_rad))
    )


def _length(xyz_m: Floats) -> float:
    return float(np.linalg.norm(np.diff(xyz_m, axis=0), axis=1).sum())


def _lost_at(table: pa.Table, limit_m: float) -> float | None:
    over = np.flatnonzero(table["major_axis_m"].to_numpy() > limit_m)
    return float(table["travelled_m"][int(over[0])].as_py()) if len(over) else None


def _scored(
    paired: Paired,
    values: Floats,
    table: pa.Table,
    lost_above_m: float,
    title: str,
    gaps: tuple[ClockGap, ...],
) -> ScoredPoses:
    assert paired.cov_xyh is not None
    at = np.searchsorted(table["t_ns"].to_numpy(), paired.truth.t_ns)
    at = np.minimum(at, table.num_rows - 1)
    upper = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
    turn = wrap_all(heading_rad(paired.estimate) - heading_rad(paired.truth))
    return ScoredPoses(
        t_ns=paired.truth.t_ns,
        estimate_m=paired.estimate.xyz_m[:, :2],
        truth_m=paired.truth.xyz_m[:, :2],
        heading_error_rad=turn,
        cov=paired.cov_xyh[:, upper],
        nees=values,
        travelled_m=table["travelled_m"].to_numpy()[at],
        major_axis_m=table["major_axis_m"].to_numpy()[at],
        lost_above_m=lost_above_m,
        title=title,
        gaps=gaps,
    )
