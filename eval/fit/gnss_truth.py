"""Ground truth from a drive's own GNSS, with stated quality."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.datasets.truth.truth import Mounting, Origin, Truth, WrittenTruth, save
from crosscue.datasets.truth.tum import Trajectory, planar, write_tum
from crosscue.eval.logs.log import DriveGiven, opened
from crosscue.localization.compass import course_at
from crosscue.replay.base import Log, Selection, name_of
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.signals.kinds import Samples, Signal
from crosscue.replay.vehicle.pose import Gnss
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

from .log_signals import read_signals, signal_plan

POSE_FILE: Final = "gnss.tum"
# Max time for which a stationary vehicle keeps its last heading, seconds.
HELD_S: Final = 60.0


def truth_from_gnss(
    log: DriveGiven, output: Path | str, vehicle: Vehicle | Path | str | None = None
) -> WrittenTruth:
    """Write a drive's own GNSS as truth.

    The track is that of the antenna, with standard deviations. Scores of poses take into account
    the receiver's standard deviation (or gnss.position_sd_m of the vehicle file) and
    gnss.course_sd_rad. Positions before the car first moves have no heading and are omitted.

    Examples:
        crosscue truth from-gnss drive.mcap --vehicle car.toml -o truth/

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the truth file and its track.
        vehicle: Vehicle file with the antenna's mounting.

    Raises:
        EmptyResultError: The log has no position, or none with a heading.
        OutputError: The files cannot be written.
    """
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        truth, track = gnss_truth(drive.logs, settings, drive.selection)
    return WrittenTruth(save_with_track(truth, track, Path(output)))


def save_with_track(truth: Truth, track: Trajectory, folder: Path) -> Path:
    """Write a truth and the antenna's track.

    Raises:
        OutputError: A file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(folder / POSE_FILE, track, "GNSS: the antenna in a local frame, x east, y north")
    return save(truth, folder)


def gnss_truth(
    logs: Sequence[Log], vehicle: Vehicle, selection: Selection
) -> tuple[Truth, Trajectory]:
    """Return the truth of a drive's GNSS, and the antenna's track.

    Rows without a heading (the vehicle has not moved yet, or stood too long) are left out, because
    a pose without a heading cannot be scored.

    Raises:
        EmptyResultError: No GNSS position exists, or none has a heading.
    """
    planned = signal_plan(logs, vehicle)
    source = planned.source_of(Signal.POSITION)
    if source is None:
        raise EmptyResultError(f"no GNSS in the log: {planned.missing[Signal.POSITION]}")
    found = read_signals(logs, planned, vehicle, selection, (Signal.POSITION, Signal.COURSE))
    fixes = found.get(Signal.POSITION)
    if fixes is None:
        raise EmptyResultError(f"{source.topic.name}: not one position in this part of the log")
    gnss = vehicle.gnss
    lat, lon, alt, sd = fixes.values.T
    alt = np.where(np.isfinite(alt), alt, 0.0)
    origin = float(lat[0]), float(lon[0]), float(alt[0])
    xyz = geodetic_to_enu(lat, lon, alt, origin)
    heading = _headings(fixes.t_ns, xyz, found.get(Signal.COURSE), gnss.min_speed_mps)
    known = np.isfinite(heading)
    if not known.any():
        raise EmptyResultError(
            f"{source.topic.name}: no position has a heading: the vehicle never reached "
            f"{gnss.min_speed_mps:g} m/s (gnss.min_speed_mps)"
        )
    t_ns = fixes.t_ns[known] - round(gnss.delay_s * 1e9)
    stated = np.where(np.isfinite(sd), sd, gnss.position_sd_m)[known]
    track = planar(t_ns, xyz[known, 0], xyz[known, 1], heading[known])
    mounting, mounting_source = _antenna(gnss)
    name = name_of(logs[source.log]).rstrip("/").rpartition("/")[2]
    return (
        Truth(
            version=1,
            log=name,
            start_ns=int(t_ns[0]),
            end_ns=int(t_ns[-1]) + 1,
            pose=POSE_FILE,
            pose_point="antenna",
            mounting=mounting,
            mounting_source=mounting_source,
            position_sd_m=float(np.sqrt(np.mean(stated**2))),
            heading_sd_rad=gnss.course_sd_rad,
            origin=Origin(latitude_deg=origin[0], longitude_deg=origin[1], altitude_m=origin[2]),
            source=f"GNSS of the log ({source.topic.name}), as received; {int((~known).sum())} of "
            f"{len(known)} positions left out because they lack a heading",
        ),
        track,
    )


def _antenna(gnss: Gnss) -> tuple[Mounting, str]:
    """Return the antenna's mounting and the source of this information."""
    if gnss.model_fields_set.isdisjoint(("x_m", "y_m")):
        place = Mounting(x_m=None, y_m=None, z_m=None, roll_rad=None, pitch_rad=None)
        return place, "antenna's position unknown: [gnss] of the vehicle file does not state it"
    place = Mounting(x_m=gnss.x_m, y_m=gnss.y_m, z_m=None, roll_rad=None, pitch_rad=None)
    return place, "[gnss] of the vehicle file"


def _headings(t_ns: Int64s, xyz_m: Floats, course: Samples | None, min_speed_mps: float) -> Floats:
    """Return the course at each position; a slow or stationary vehicle keeps its last course."""
    if course is not None and np.isfinite(course.values[:, 0]).any():
        found = course_at(
            t_ns, course.t_ns, course.values[:, 0], course.values[:, 1], min_speed_mps
        )
    else:
        found = _between_positions(t_ns, xyz_m, min_speed_mps)
    rows = np.where(np.isfinite(found), np.arange(len(found)), -1)
    last = np.maximum.accumulate(rows)
    held = np.where(last >= 0, found[np.maximum(last, 0)], np.nan)
    age_s = (t_ns - t_ns[np.maximum(last, 0)]) * 1e-9
    return np.where(age_s <= HELD_S, held, np.nan)


def _between_positions(t_ns: Int64s, xyz_m: Floats, min_speed_mps: float) -> Floats:
    """Return the course from the position a second before to the one a second after."""
    before = np.searchsorted(t_ns, t_ns - 1_000_000_000)
    after = np.minimum(np.searchsorted(t_ns, t_ns + 1_000_000_000), len(t_ns) - 1)
    way = xyz_m[after, :2] - xyz_m[before, :2]
    seconds = np.maximum((t_ns[after] - t_ns[before]) * 1e-9, 1e-9)
    moved = np.hypot(*way.T) >= min_speed_mps * seconds
    return np.where(moved & (after > before), np.arctan2(way[:, 1], way[:, 0]), np.nan)
