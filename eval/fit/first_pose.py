"""Where a drive begins and which way the car faces: from GNSS, a truth file, or three numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, get_args

import numpy as np

from crosscue.datasets.geodesy import ecef_to_enu_matrix, ecef_to_geodetic, geodetic_to_ecef
from crosscue.eval.pipeline.pose import fused_positions, odometry_settings, turn_signal_of
from crosscue.localization.fit.known_drive import KnownDrive
from crosscue.localization.odometry import integrate
from crosscue.localization.start_pose import START_S, start_pose
from crosscue.replay.base import Log, MissingTopicError, Selection, UsageError, VehicleError
from crosscue.replay.logs.log_part import first_ns
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.vehicle.pose import GnssUse, Start
from crosscue.replay.vehicle.vehicle import Vehicle

from .log_signals import plan_of, read_signals
from .reference import GeodeticOrigin, Reference, of_gnss, of_truth
from .turns import turn_samples, wheel_speeds

READ_S: Final = START_S + 10.0
"""Receivers and buses begin some seconds apart."""
MAX_HEADING_SD_RAD: Final = math.radians(30.0)
"""A heading less certain than this is left to the compass, or to the map's own axes."""


def with_start(
    logs: Sequence[Log],
    vehicle: Vehicle,
    selection: Selection,
    gnss: GnssUse | None = None,
    start: str | None = None,
) -> Vehicle:
    """The settings with a first pose, where one can be had.

    Args:
        logs: Of the drive, open.
        vehicle: A heading under ``[start]`` is kept, unless ``start`` says otherwise.
        selection: Which part of the logs.
        gnss: Overrides ``gnss.use`` of the vehicle file.
        start: ``X,Y,HEADING`` in metres and degrees counter-clockwise from east, or a truth file.

    Raises:
        UsageError: ``start`` or ``gnss`` is not understood.
        SchemaError: The truth file holds no pose.
        VehicleError: Its track does not cover the first seconds, or the car stands still in them.
    """
    if gnss is not None:
        if gnss not in get_args(GnssUse):
            raise UsageError(f"--gnss {gnss}: expected one of {', '.join(get_args(GnssUse))}")
        vehicle = vehicle.model_copy(update={"gnss": vehicle.gnss.model_copy(update={"use": gnss})})
    vehicle = _started(logs, vehicle, selection, start)
    # Refused here, before detectors have worked for an hour.
    fused_positions(vehicle)
    return vehicle


def _started(
    logs: Sequence[Log], vehicle: Vehicle, selection: Selection, start: str | None
) -> Vehicle:
    if start is not None and (numbers := _numbers(start)) is not None:
        return _changed(vehicle, numbers)
    if start is not None:
        found = _laid(logs, vehicle, selection, Path(start))
        if found is None:
            raise VehicleError(
                f"{start}: does not show the first pose: expected a track and wheel speeds in the "
                f"first {READ_S:.0f} s, and a car that moves; try another part of the log"
            )
        return _changed(vehicle, found)
    if vehicle.gnss.use not in ("start", "fuse") or vehicle.start.heading_rad is not None:
        return vehicle
    found = _laid(logs, vehicle, selection, None)
    return vehicle if found is None else _changed(vehicle, found)


def with_start_of(run: Vehicle, vehicle: Vehicle) -> Vehicle:
    """Settings for estimating a run again: the first pose that it found stays, if none is given."""
    if not run.start.source or vehicle.start.heading_rad is not None:
        return vehicle
    return vehicle.model_copy(update={"start": run.start})


def without_found_start(vehicle: Vehicle) -> Vehicle:
    """A run's settings as they were before it looked for the first pose."""
    start = vehicle.start
    if not start.source:
        return vehicle
    # GNSS leaves x and y as the vehicle file has them; a truth file and a flag do not.
    kept = {} if start.map_origin is None else {"x_m": start.x_m, "y_m": start.y_m}
    return vehicle.model_copy(update={"start": Start.model_validate(kept)})


def _changed(vehicle: Vehicle, start: dict[str, object]) -> Vehicle:
    section = Start.model_validate(vehicle.start.model_dump() | start)
    return vehicle.model_copy(update={"start": section})


def _numbers(text: str) -> dict[str, object] | None:
    """The three numbers of ``X,Y,HEADING``; None for a path.

    Raises:
        UsageError: There are other than three numbers, or they are not finite.
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


def _laid(
    logs: Sequence[Log], vehicle: Vehicle, selection: Selection, truth: Path | None
) -> dict[str, object] | None:
    """The first seconds' odometry laid onto known positions; None where that shows no heading."""
    planned = plan_of(logs, vehicle)
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
    # The first stored row need not be the earliest, so nothing is cut off before it.
    part = replace(selection, end_ns=end_ns)
    found = read_signals(logs, planned, vehicle, part, wanted, warns=False)
    samples = found.get(Signal.POSITION)
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


def _first(drive: KnownDrive, vehicle: Vehicle, reference: Reference) -> dict[str, object] | None:
    """The pose at the first wheel speeds, which is where a run begins."""
    if len(drive.fixes) < 2:
        return None
    made = integrate(drive.wheels, odometry_settings(vehicle), drive.turn).increments
    pose = start_pose(made, drive.fixes, drive.lever_m, int(drive.wheels.t_ns[0]))
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
    """The geodetic place so far away."""
    latitude, longitude, altitude = origin
    turn = ecef_to_enu_matrix(math.radians(latitude), math.radians(longitude))
    at = geodetic_to_ecef(latitude, longitude, altitude) + np.array([east_m, north_m, 0.0]) @ turn
    lat, lon, alt = ecef_to_geodetic(at)
    return float(lat[0]), float(lon[0]), float(alt[0])
