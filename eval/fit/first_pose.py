"""The first pose of a drive, from GNSS, a truth file, or three numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, get_args

import numpy as np

from crosscue.datasets.geodesy import ecef_to_enu_matrix, ecef_to_geodetic, geodetic_to_ecef
from crosscue.eval.pipeline.pose import fused_positions, odometry_settings, turn_signal_of
from crosscue.localization.fit.known_drive import KnownDrive
from crosscue.localization.odometry import integrate
from crosscue.localization.start_pose import START_S, start_pose
from crosscue.replay.base import Log, Selection
from crosscue.replay.errors import MissingTopicError, UsageError, VehicleError
from crosscue.replay.logs.log_part import first_ns
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.vehicle.pose import GnssUse, Start
from crosscue.replay.vehicle.vehicle import Vehicle

from .log_signals import read_signals, signal_plan, turn_samples, wheel_speeds

if TYPE_CHECKING:
    from .reference import GeodeticOrigin, ReferencePositions

# Time read from the start of a drive, seconds; receivers and buses start at different times.
READ_S: Final = START_S + 10.0
# Max s.d. of a heading from GNSS; otherwise the compass or the map's axes determine it.
MAX_HEADING_SD_RAD: Final = math.radians(30.0)


def with_start(
    logs: Sequence[Log],
    vehicle: Vehicle,
    selection: Selection,
    gnss: GnssUse | None = None,
    start: str | None = None,
) -> Vehicle:
    """Return the settings with a first pose, if one can be determined.

    Args:
        logs: Open logs of the drive.
        vehicle: Settings; a heading under ``[start]`` is kept unless ``start`` replaces it.
        selection: The part of the logs to use.
        gnss: Overrides ``gnss.use`` of the vehicle file.
        start: ``X,Y,HEADING`` in metres and degrees counter-clockwise from east, or a truth file.

    Raises:
        UsageError: ``start`` or ``gnss`` is invalid.
        SchemaError: The truth file has no pose.
        VehicleError: The truth's track does not cover the first seconds, or the vehicle stands
            still in them.
    """
    if gnss is not None:
        if gnss not in get_args(GnssUse):
            raise UsageError(f"--gnss {gnss}: expected one of {', '.join(get_args(GnssUse))}")
        vehicle = vehicle.model_copy(update={"gnss": vehicle.gnss.model_copy(update={"use": gnss})})
    vehicle = _started(logs, vehicle, selection, start)
    # Refused here, before the detectors run for an hour.
    fused_positions(vehicle)
    return vehicle


def check_start(vehicle: Vehicle, start: str | None) -> None:
    """Refuse a first pose that is neither three numbers nor a truth file, before a log is read."""
    if start is not None and _numbers(start) is None:
        from .reference import of_truth

        of_truth(Path(start), vehicle, spacing_ns=0)


def _started(
    logs: Sequence[Log], vehicle: Vehicle, selection: Selection, start: str | None
) -> Vehicle:
    if start is not None and (numbers := _numbers(start)) is not None:
        return _changed(vehicle, numbers)
    is_known = vehicle.start.heading_rad is not None
    if start is None and (is_known or vehicle.gnss.use not in ("start", "fuse")):
        return vehicle
    found = _aligned(logs, vehicle, selection, None if start is None else Path(start))
    if found is None and start is not None:
        raise VehicleError(
            f"{start}: does not show the first pose: expected a track and wheel speeds in the "
            f"first {READ_S:.0f} s, and a moving vehicle; try another part of the log"
        )
    return vehicle if found is None else _changed(vehicle, found)


def with_start_of(run: Vehicle, vehicle: Vehicle) -> Vehicle:
    """Return settings to estimate a run again, with its first pose unless ``vehicle`` has one."""
    if not run.start.source or vehicle.start.heading_rad is not None:
        return vehicle
    return vehicle.model_copy(update={"start": run.start})


def without_found_start(vehicle: Vehicle) -> Vehicle:
    """Return a run's settings without the first pose that it determined."""
    start = vehicle.start
    if not start.source:
        return vehicle
    # GNSS keeps x and y of the vehicle file; a truth file and --start replace them.
    kept = {} if start.map_origin is None else {"x_m": start.x_m, "y_m": start.y_m}
    return vehicle.model_copy(update={"start": Start.model_validate(kept)})


def _changed(vehicle: Vehicle, start: dict[str, object]) -> Vehicle:
    section = Start.model_validate(vehicle.start.model_dump() | start)
    return vehicle.model_copy(update={"start": section})


def _numbers(text: str) -> dict[str, object] | None:
    """Parse the three numbers of ``X,Y,HEADING``; return None for a path.

    Raises:
        UsageError: There are not exactly three numbers, or one is not finite.
    """
    numbers = [_number(word) for word in text.split(",")]
    if len(numbers) != 3 and None in numbers:
        return None
    x_m, y_m, degrees = numbers if len(numbers) == 3 else (None, None, None)
    if x_m is None or y_m is None or degrees is None:
        raise UsageError(f"--start {text}: expected X,Y,HEADING in metres and degrees, or a file")
    return {
        "x_m": x_m,
        "y_m": y_m,
        "heading_rad": math.radians(degrees),
        "source": "given with --start",
    }


def _number(word: str) -> float | None:
    try:
        number = float(word)
    except ValueError:
        return None
    return number if math.isfinite(number) else None


def _aligned(
    logs: Sequence[Log], vehicle: Vehicle, selection: Selection, truth: Path | None
) -> dict[str, object] | None:
    """Return the pose that aligns the first seconds' odometry with known positions, or None."""
    planned = signal_plan(logs, vehicle)
    gnss = planned.source_of(Signal.POSITION)
    wheels = planned.source_of(Signal.WHEEL_SPEEDS)
    if wheels is None or (truth is None and gnss is None):
        return None
    turn = turn_signal_of(planned, vehicle)
    wanted = [Signal.WHEEL_SPEEDS, *([] if turn is None else [turn])]
    wanted += [] if truth is not None else [Signal.POSITION]
    try:
        begin_ns = selection.start_ns if selection.start_ns is not None else first_ns(logs)
    except MissingTopicError:
        return None
    end_ns = begin_ns + round(READ_S * 1e9)
    if selection.end_ns is not None:
        end_ns = min(end_ns, selection.end_ns)
    # The first stored row is not always the earliest, so the selection has no lower bound.
    part = replace(selection, end_ns=end_ns)
    found = read_signals(logs, planned, vehicle, part, wanted, warns=False)
    samples = found.get(Signal.POSITION)
    from .reference import of_gnss, of_truth

    if truth is not None:
        reference = of_truth(truth, vehicle, spacing_ns=0)
    elif samples is not None and gnss is not None:
        reference = of_gnss(gnss.topic.name, samples, vehicle)
    else:
        return None
    if Signal.WHEEL_SPEEDS not in found or (turn is not None and turn not in found):
        return None
    drive = KnownDrive(
        wheel_speeds(found[Signal.WHEEL_SPEEDS]),
        turn_samples(turn, found),
        reference.fixes,
        reference.lever_m,
    )
    return _first(drive, vehicle, reference)


def _first(
    drive: KnownDrive, vehicle: Vehicle, reference: ReferencePositions
) -> dict[str, object] | None:
    """Return the pose at the first wheel speeds, where a run begins."""
    if len(drive.fixes) < 2:
        return None
    made = integrate(drive.wheels, odometry_settings(vehicle), drive.turn).increments
    pose = start_pose(made, drive.fixes, drive.lever_m, int(made.start_ns[0]))
    heading_sd_rad = math.sqrt(pose.hh)
    if heading_sd_rad > MAX_HEADING_SD_RAD:
        return None
    found: dict[str, object] = {
        "heading_rad": pose.heading_rad,
        "heading_sd_rad": heading_sd_rad,
        "position_sd_m": math.sqrt(0.5 * (pose.xx + pose.yy)),
        "source": f"first seconds of {reference.name}",
    }
    if reference.is_map:
        return found | {"x_m": pose.x_m, "y_m": pose.y_m}
    if reference.origin is not None:
        away = (pose.x_m - vehicle.start.x_m, pose.y_m - vehicle.start.y_m)
        found["map_origin"] = _moved(reference.origin, *away)
    return found


def _moved(origin: GeodeticOrigin, east_m: float, north_m: float) -> GeodeticOrigin:
    """Return the geodetic position displaced by the given metres."""
    latitude, longitude, altitude = origin
    turn = ecef_to_enu_matrix(math.radians(latitude), math.radians(longitude))
    at = geodetic_to_ecef(latitude, longitude, altitude) + np.array([east_m, north_m, 0.0]) @ turn
    lat, lon, alt = ecef_to_geodetic(at)
    return float(lat[0]), float(lon[0]), float(alt[0])
