"""What a drive shows of its camera: focal length, pitch, yaw, height, and delay of its stamps."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.localization.camera_delay import (
    CameraDelay,
    delay_by_speed,
    delay_by_yaw_rate,
    mean_delay,
)
from crosscue.localization.camera_watch import (
    MountingStep,
    MountingWindow,
    steps_of,
    whole,
    windows_of,
    without_explained,
)
from crosscue.localization.visual_odometry import Travel
from crosscue.replay.base import EVERYTHING, Log, Selection
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.safe_text import counted
from crosscue.replay.vehicle.drafting.camera import Intrinsics, MountingParameter
from crosscue.replay.vehicle.drafting.series import Series
from crosscue.replay.vehicle.vehicle import Camera, Vehicle

from .picture_pass import PicturePass, watch_pictures

MIN_PAIRS: Final = 10
# Max s.d. of an estimated focal length and height, as fractions.
FOCAL_SD: Final = 0.03
HEIGHT_SD: Final = 0.05
# Min speed at which distances by wheels and by pictures are compared.
MOVING_MPS: Final = 2.0
# Nod of a car that brakes, per m/s2; how much one nods follows from the drive. Pictures count where
# the acceleration of the last second has changed by less than this: nods come late.
NOD_RAD: Final = math.radians(0.3)
STEADY_MPS2: Final = 0.6
NODS_NS: Final = 1_000_000_000
# Longest time between two pictures that show the direction of travel of a moving car.
MOVES_S: Final = 1.0
# Smallest delay that is set, so that stamps of a run differ from those of the log only for a cause.
DELAY_S: Final = 0.01
# Passes over the pictures, each with the focal length and height that the last one found.
PASSES: Final = 3
CONVERGED: Final = 0.05
NOT_CAN: Final = "not estimated: "


class Estimate(NamedTuple):
    """Estimate of a camera from the pictures of a drive; None for what they do not determine.

    Attributes:
        pitch_rad: Angle of the optical axis below the direction of travel.
        yaw_rad: Angle of the optical axis to the left of the direction of travel.
        z_m: Height above the road.
        focal_px: Focal length, if no other is known.
        delay_s: Delay of the time stamps.
        pairs: Number of pairs of pictures used for pitch and yaw.
        why_not: What is missing and what would be needed, one sentence each.
    """

    pitch_rad: MountingParameter | None = None
    yaw_rad: MountingParameter | None = None
    z_m: MountingParameter | None = None
    focal_px: MountingParameter | None = None
    delay_s: MountingParameter | None = None
    pairs: int = 0
    why_not: tuple[str, ...] = ()


class MountingWatch(NamedTuple):
    """Mounting of the camera over a drive.

    Attributes:
        windows: Pitch, yaw and height of every ten seconds.
        steps: Changes that were found.
        whole: Pitch, yaw and height of the drive, where they could be measured.
    """

    windows: tuple[MountingWindow, ...]
    steps: tuple[MountingStep, ...]
    whole: dict[str, MountingWindow]


class CameraWatch(NamedTuple):
    """What the pictures of a drive show of its camera.

    Attributes:
        seen: The last pass over the pictures.
        delays: Delay of the pictures by each signal.
        mounting: Pitch, yaw and height over the drive; None without a focal length.
        focal: Focal length, if it was estimated.
    """

    seen: PicturePass
    delays: tuple[CameraDelay, ...]
    mounting: MountingWatch | None
    focal: MountingParameter | None


def estimate_mounting(
    log: Log,
    camera: str,
    intrinsics: Intrinsics | None,
    speed: Series | None,
    yaw_rate: Series | None = None,
) -> Estimate:
    """Return what the first minute of pictures shows of a log's camera.

    Args:
        log: The open log.
        camera: Topic of the camera.
        intrinsics: Intrinsics of the camera, if known; otherwise a focal length is estimated.
        speed: Speed of the vehicle, m/s, if known.
        yaw_rate: Yaw rate of the vehicle, rad/s, if known.
    """
    known = Camera()
    if intrinsics is not None:
        focal_px, center_px, _, size_px = intrinsics
        known = Camera(focal_px=focal_px, center_px=center_px, size_px=size_px)
    found = watch_camera(log, 0, camera, Vehicle(version=1), known, CarMotion(speed, yaw_rate))
    size_px = found.seen.size_px
    if size_px is not None and (why := known.mismatch(size_px)) is not None:
        return Estimate(why_not=(f"pitch and yaw {NOT_CAN}{why}",))
    notes = []
    if intrinsics is None and found.focal is None:
        notes.append(
            f"focal_px {NOT_CAN}needs a calibration, or pictures of a turn with a yaw rate"
        )
    late = mean_delay(found.delays)
    if late is None or not late.is_observable:
        late = None
        notes.append(f"delay_s {NOT_CAN}{_why_no_delay(found.delays)}")
    estimate = Estimate(focal_px=found.focal, delay_s=_delay(late), why_not=tuple(notes))
    if found.mounting is None:
        return estimate._replace(why_not=(*notes, f"pitch, yaw and height {NOT_CAN}need focal_px"))
    return _with_angles(estimate, found.seen, found.mounting)


class CarMotion(NamedTuple):
    """Signals of the vehicle's motion, where they are known.

    Attributes:
        speed: Speed, m/s.
        yaw_rate: Yaw rate, rad/s.
    """

    speed: Series | None
    yaw_rate: Series | None


def watch_camera(
    log: Log,
    number: int,
    camera: str,
    vehicle: Vehicle,
    known: Camera,
    motion: CarMotion,
    selection: Selection = EVERYTHING,
) -> CameraWatch:
    """Look at the pictures, again where the focal length or height turns out to be another.

    Args:
        log: The open log.
        number: Index of the log in the drive.
        camera: Topic of the camera.
        vehicle: The vehicle file.
        known: What is known of the camera; without ``focal_px``, it is estimated in turns.
        motion: Signals of the vehicle's motion.
        selection: Part of the log to read; its topics are ignored.
    """
    has_focal, focal = known.focal_px is not None, None
    for last in range(PASSES):
        seen = watch_pictures(log, number, camera, vehicle, known, selection)
        delays = delays_of(seen, motion)
        off = 0.0
        if not has_focal and (focal := _focal(seen, delays)) is not None:
            off = abs(focal.value * seen.scale / _focal_px(seen) - 1.0)
            known = known.model_copy(update={"focal_px": focal.value})
        watch = watch_mounting(seen, motion) if has_focal or focal is not None else None
        if watch is not None and (height := watch.whole.get("height")) is not None:
            off = max(off, abs(height.mean / known.z_m - 1.0))
            known = known.model_copy(update={"z_m": height.mean})
        if off < CONVERGED or last == PASSES - 1:
            break
    return CameraWatch(seen, delays, watch, focal)


def _with_angles(found: Estimate, seen: PicturePass, watch: MountingWatch) -> Estimate:
    notes = list(found.why_not)
    pitch = yaw = None
    if len(seen.travel) >= MIN_PAIRS and {"pitch", "yaw"} <= watch.whole.keys():
        pitch, yaw = (_angle(watch.whole[name]) for name in ("pitch", "yaw"))
    else:
        notes.append(
            f"pitch and yaw {NOT_CAN}{counted(len(seen.travel), 'pair')} of pictures of a "
            f"straight road, {seen.bends} in bends; needs {MIN_PAIRS} or more"
        )
    height = watch.whole.get("height")
    if height is None or height.sd > HEIGHT_SD * height.mean:
        notes.append(f"z_m {NOT_CAN}needs the speed, and pictures of textured road without traffic")
        height = None
    return found._replace(
        pitch_rad=pitch,
        yaw_rad=yaw,
        z_m=None if height is None else _height(height),
        pairs=len(seen.travel),
        why_not=tuple(notes),
    )


def delays_of(seen: PicturePass, motion: CarMotion) -> tuple[CameraDelay, ...]:
    """Return the delay of the pictures by each signal that is known."""
    speed, yaw_rate = motion
    found = []
    if yaw_rate is not None:
        found.append(delay_by_yaw_rate(seen.motion, yaw_rate.t_ns, yaw_rate.values))
    if speed is not None:
        found.append(delay_by_speed(seen.motion, speed.t_ns, speed.values))
    return tuple(found)


def watch_mounting(seen: PicturePass, motion: CarMotion) -> MountingWatch:
    """Return pitch, yaw and height over a drive, and their steps.

    Args:
        seen: The pictures.
        motion: Signals of the vehicle's motion; without a speed the height is unknown.
    """
    speed, yaw_rate = motion
    travel = np.array(seen.travel, np.float64).reshape(-1, len(Travel._fields))
    measured, explained = {"pitch": travel[:, 1], "yaw": travel[:, 0]}, {}
    times = dict.fromkeys(measured, seen.travel_ns)
    if speed is not None and len(speed) > 1:
        times["height"], measured["height"] = _heights(seen, speed)
        nod, is_steady = _nod(seen.travel_ns, speed)
        if is_steady.sum() >= MIN_PAIRS:
            explained["pitch"] = nod
            measured["pitch"] = np.where(is_steady, travel[:, 1] + nod, np.nan)
    if yaw_rate is not None and len(yaw_rate) > 1:
        by_turn, slip = _by_turn(seen, travel, yaw_rate, speed)
        if np.isfinite(by_turn).sum() >= MIN_PAIRS:
            explained["yaw"] = by_turn
            measured["yaw"] = travel[:, 0] + slip
    steps = []
    for name, t_ns in times.items():
        found = steps_of(name, t_ns, measured[name], explained.get(name))
        steps += found
        if name in explained:
            measured[name] = without_explained(t_ns, measured[name], explained[name], found)
    return MountingWatch(
        tuple(one for name in times for one in windows_of(name, times[name], measured[name])),
        tuple(steps),
        {name: one for name in times if (one := whole(name, times[name], measured[name]))},
    )


def _nod(t_ns: Int64s, speed: Series) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the nod of a car by its acceleration, and where that has not been changing."""
    now, before, earlier = (
        np.interp(t_ns - round(at * NODS_NS), speed.t_ns, speed.values) for at in (0.0, 0.5, 1.0)
    )
    changes = 2.0 * np.abs(now - 2.0 * before + earlier) * 1e9 / NODS_NS
    return NOD_RAD * (now - earlier) * 1e9 / NODS_NS, changes < STEADY_MPS2


def _by_turn(
    seen: PicturePass, travel: Floats, yaw_rate: Series, speed: Series | None
) -> tuple[Floats, Floats]:
    """Return what the yaw rate explains of the direction of travel, and the camera's sideslip.

    Few pictures tell a turn from a movement to the side, so that most of an error of the direction
    is that of the turn they show, which the yaw rate knows better. A camera ahead of the rear axle
    moves sideways in bends.
    """
    _, _, turned, _, per_turn, seconds = travel.T
    start_ns = seen.travel_ns - np.round(seconds * 1e9).astype(np.int64)
    inside = (start_ns >= yaw_rate.t_ns[0]) & (seen.travel_ns <= yaw_rate.t_ns[-1])
    usable = inside & (seconds > 0.0) & (seconds < MOVES_S)
    seconds = np.where(usable, seconds, np.nan)
    rate = (yaw_rate.integral(seen.travel_ns) - yaw_rate.integral(start_ns)) / seconds
    bias = np.median((turned / seconds - rate)[usable]) if usable.any() else np.nan
    slip = np.zeros(len(seconds))
    if speed is not None and len(speed) > 1:
        mps = np.interp(seen.travel_ns, speed.t_ns, speed.values)
        slip = (rate + bias) * seen.camera.x_m / np.maximum(mps, MOVING_MPS)
    return per_turn * (turned - (rate + bias) * seconds), slip


def _heights(seen: PicturePass, speed: Series) -> tuple[Int64s, Floats]:
    """Return the height by each pair of pictures: NaN where the car is slow or turns."""
    start_ns = np.array([one.start_ns for one in seen.steps], np.int64)
    t_ns = np.array([one.t_ns for one in seen.steps], np.int64)
    shown_m = np.array([one.distance_m for one in seen.steps], np.float64)
    turn = np.array([one.turn_rad for one in seen.steps], np.float64)
    seconds = (t_ns - start_ns) * 1e-9
    mps = np.abs(np.interp(start_ns + (t_ns - start_ns) // 2, speed.t_ns, speed.values))
    inside = (start_ns >= speed.t_ns[0]) & (t_ns <= speed.t_ns[-1])
    good = inside & (mps > MOVING_MPS) & (shown_m > 0.0) & (np.abs(turn) < 0.1 * seconds)
    with np.errstate(divide="ignore", invalid="ignore"):
        return t_ns, np.where(good, seen.camera.z_m * mps * seconds / shown_m, np.nan)


def _focal(seen: PicturePass, delays: tuple[CameraDelay, ...]) -> MountingParameter | None:
    turn = next((one for one in delays if math.isfinite(one.scale)), None)
    if turn is None or not turn.scale > 0.2 or turn.scale_sd > FOCAL_SD * turn.scale:
        return None
    focal_px = turn.scale * _focal_px(seen) / seen.scale
    # Rotation by corners near the edge is not quite in proportion to the focal length.
    sd_px = math.hypot(turn.scale_sd / turn.scale, 0.01) * focal_px
    return MountingParameter(
        focal_px,
        f"ESTIMATED: {focal_px:.0f} +- {1.96 * sd_px:.0f} px, from turns in the pictures and by "
        "the yaw rate",
    )


def _focal_px(seen: PicturePass) -> float:
    assert seen.camera.focal_px is not None
    return seen.camera.focal_px


def _delay(late: CameraDelay | None) -> MountingParameter | None:
    if late is None:
        return None
    is_set = abs(late.delay_s) > max(1.96 * late.sd_s, DELAY_S)
    return MountingParameter(late.delay_s, f"ESTIMATED: {late}", is_set)


def _why_no_delay(delays: tuple[CameraDelay, ...]) -> str:
    if not delays:
        return "needs a yaw rate or the speed"
    return "; ".join(map(str, delays)) + "; needs a turn"


def _angle(window: MountingWindow) -> MountingParameter:
    return MountingParameter(
        window.mean,
        f"ESTIMATED: {window}, vanishing point of {counted(window.measured, 'pair')} of pictures",
    )


def _height(window: MountingWindow) -> MountingParameter:
    return MountingParameter(
        window.mean,
        f"ESTIMATED: {window}, by speed and road in {counted(window.measured, 'pair')} of pictures",
    )
