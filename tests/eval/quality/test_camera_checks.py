"""Checks that need pictures of a scene: delay, sign, standstill, and a camera that moves."""

import math
from functools import cache

import numpy as np
import pytest

from crosscue.datasets.simulated.drive import DriveSettings, integrated, sense
from crosscue.eval.quality.drive import QualityDrive
from crosscue.eval.quality.verdict import judge
from crosscue.eval.vehicle.mounting import CarMotion, MountingWatch, watch_mounting
from crosscue.eval.vehicle.picture_pass import PicturePass
from crosscue.localization.camera_watch import steps_of, windows_of
from crosscue.localization.visual_odometry import Travel
from crosscue.replay.columns import Bytes, Floats
from crosscue.replay.vehicle.drafting.agreement import judge_yaw_rate, of_wheels
from crosscue.replay.vehicle.drafting.series import Grid, Series
from crosscue.replay.vehicle.vehicle import Vehicle
from support.plane_pictures import CAMERA, picture
from support.quality_logs import Stream, Streams, examined

HZ = 8.0
CAR = Vehicle(version=1, camera=CAMERA, start={"x_m": 0.0})  # type: ignore[arg-type]


@cache
def scenes(kind: str) -> tuple[Floats, Floats, Floats, Bytes]:
    """Times, speed, yaw rate and pictures of a drive between walls."""
    t_s = np.arange(0.0, 5.0, 1.0 / HZ)
    fine_s = np.arange(0.0, 5.0, 0.005)
    speed = np.full(len(fine_s), 5.0)
    rate = np.zeros(len(fine_s))
    if kind == "turn":
        rate = 0.25 * np.sin(1.6 * fine_s)
    if kind == "stop":
        speed = np.clip(3.0 * np.abs(fine_s - 2.5) - 2.0, 0.0, 5.0)
    heading = np.cumsum(rate) * 0.005
    x, y = (np.cumsum(speed * f(heading)) * 0.005 for f in (np.cos, np.sin))
    poses = [np.interp(t_s, fine_s, one) for one in (x, y, heading)]
    shown = np.stack([picture(*map(float, pose)) for pose in zip(*poses, strict=True)])
    return fine_s, speed, rate, shown


def drive_of(
    kind: str, *, late_s: float = 0.0, sign: float = 1.0, gain: float = 1.0
) -> QualityDrive:
    """The drive as logged, with pictures late, and a wrong sign or unit."""
    fine_s, speed, rate, shown = scenes(kind)
    noise = np.random.default_rng(1).normal(size=(2, len(fine_s)))
    speeds = gain * speed + 0.01 * noise[0] * (speed > 0.0)
    names = ("front_left_mps", "front_right_mps", "rear_left_mps", "rear_right_mps")
    streams: Streams = {
        "wheels": Stream(fine_s[::4], dict.fromkeys(names, speeds[::4])),
        "gyro": Stream(fine_s[::2], {"gyro_z_radps": (sign * rate + 0.001 * noise[1])[::2]}),
        "camera": Stream(np.arange(0.0, 5.0, 1.0 / HZ) + late_s, pictures=shown),
    }
    return examined(streams, CAR)


def found_by(drive: QualityDrive) -> dict[str, str]:
    """Findings by check, without those of the missing GNSS."""
    return {one.check: one.text for one in judge(drive)}


def test_pictures_of_a_sound_drive_are_not_blamed() -> None:
    assert found_by(drive_of("turn")) == {}


@pytest.mark.parametrize("late_s", [-0.15, 0.2])
def test_late_pictures_are_found_with_the_delay_to_set(late_s: float) -> None:
    drive = drive_of("turn", late_s=late_s)

    assert "camera delay" in found_by(drive)
    assert drive.delays[0].delay_s == pytest.approx(late_s, abs=0.02)
    (advice,) = [one.help for one in judge(drive) if one.check == "camera delay"]
    assert float(advice.rpartition(" ")[2]) == pytest.approx(late_s, abs=0.02)


def test_yaw_rate_of_the_other_sign_than_the_pictures_is_found() -> None:
    assert "other side than the pictures" in found_by(drive_of("turn", sign=-1.0))["camera delay"]


def test_speed_that_is_not_that_of_the_pictures_is_found() -> None:
    assert "above the road" in found_by(drive_of("turn", gain=3.6))["mounting"]


def test_standing_pictures_of_a_moving_car_are_found() -> None:
    fine_s, speed, rate, shown = scenes("stop")
    still = np.repeat(shown[:1], len(shown), axis=0).copy()
    still[:, 0, 0] = np.arange(len(still))
    names = ("front_left_mps", "front_right_mps", "rear_left_mps", "rear_right_mps")
    noise = 0.01 * np.random.default_rng(2).normal(size=len(fine_s))
    streams: Streams = {
        "wheels": Stream(fine_s[::4], dict.fromkeys(names, (5.0 + noise)[::4])),
        "gyro": Stream(fine_s[::2], {"gyro_z_radps": (rate + 0.1 * noise)[::2]}),
        "camera": Stream(np.arange(0.0, 5.0, 1.0 / HZ), pictures=still),
    }
    assert speed.min() == 0.0
    assert "stands in" in found_by(examined(streams, CAR))["standstill"]


def measured(seed: int, step_rad: float, seconds: float = 40.0) -> tuple[Floats, Floats]:
    """Direction of travel at 8 Hz, with errors as on real roads, and a step at 20 s."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, 1.0 / 8.0)
    slow = np.convolve(rng.normal(size=len(t_s) + 7), np.ones(8) / 8.0**0.5, "valid")
    angle = 0.02 + np.radians(0.15) * rng.normal(size=len(t_s)) + np.radians(0.05) * slow
    return t_s, angle + step_rad * (t_s >= 20.0)


@pytest.mark.parametrize("value", ["pitch", "yaw"])
@pytest.mark.parametrize("step_deg", [0.5, -0.5])
def test_step_of_half_a_degree_is_found_within_ten_seconds(value: str, step_deg: float) -> None:
    for seed in range(20):
        t_s, angle = measured(seed, math.radians(step_deg), 30.0)
        t_ns = np.round(t_s * 1e9).astype(np.int64)

        (step,) = steps_of(value, t_ns, angle)

        assert step.t_ns * 1e-9 == pytest.approx(20.0, abs=2.0)
        assert abs(step.by - math.radians(step_deg)) < 4.0 * step.sd


def test_no_step_is_reported_where_there_is_none() -> None:
    for seed in range(60):
        t_s, angle = measured(seed, 0.0)
        assert steps_of("pitch", np.round(t_s * 1e9).astype(np.int64), angle) == []


def braking(step_rad: float = 0.0, at_s: float = 28.0) -> MountingWatch:
    """A car brakes, stands, and accelerates; it nods by 0.35 degrees per m/s2, as in simulation."""
    t_s = np.arange(0.0, 40.0, 0.1)
    acceleration = np.select(
        [(t_s > 8.0) & (t_s < 13.0), (t_s > 15.0) & (t_s < 21.0)], [-1.9, 1.6], 0.0
    )
    speed = np.maximum(9.5 + np.cumsum(acceleration) * 0.1, 0.05)
    _, angle = measured(3, 0.0)
    angle = np.interp(t_s, np.arange(0.0, 40.0, 1.0 / 8.0), angle)
    angle -= math.radians(0.35) * acceleration
    angle += step_rad * (t_s >= at_s)
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    travel = tuple(Travel(0.0, float(one), 0.0, 200) for one in angle)
    seen = PicturePass(t_ns, t_s, t_s, t_ns, (960, 540), CAMERA, 1.0, (), t_s[:0], t_ns, travel, 0)
    return watch_mounting(seen, CarMotion(Series("speed", t_ns, speed), None))


def test_camera_that_nods_while_the_car_brakes_has_not_moved() -> None:
    watch = braking()

    assert watch.steps == ()
    for window in watch.windows:
        if window.value == "pitch":
            assert abs(window.mean - 0.02) < 1.96 * window.sd
    (step,) = braking(math.radians(0.5)).steps
    assert step.t_ns * 1e-9 == pytest.approx(28.0, abs=2.0)


@pytest.mark.parametrize("at_s", [7.0, 9.0, 11.0])
def test_step_beside_a_nod_is_found(at_s: float) -> None:
    """The car brakes from 8 to 13 s and accelerates from 15 s on."""
    for by_deg in (-0.5, 0.5):
        (step,) = braking(math.radians(by_deg), at_s).steps

        assert step.t_ns * 1e-9 == pytest.approx(at_s, abs=1.5)
        assert math.degrees(step.by) == pytest.approx(by_deg, abs=0.25)


def swaying(seed: int, step_rad: float = 0.0, *, has_rate: bool = True) -> MountingWatch:
    """A car that sways; pictures mistake a part of a turn for a movement to the side.

    The error of the turn wanders, and the gyro has a bias. The camera is 1.7 m ahead of the axle.
    """
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, 30.0, 0.1)
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    rate = 0.02 * np.sin(2.0 * np.pi * t_s / 12.0)
    turn = np.diff(np.concatenate([[0.0], np.cumsum(rate) * 0.1]))
    wrong = np.radians(0.02) * np.convolve(rng.normal(size=len(t_s) + 29), np.ones(30) / 30.0**0.5)
    wrong = wrong[29 : 29 + len(t_s)]
    left = 20.0 * wrong - 1.7 * rate / 10.0 + np.radians(0.1) * rng.normal(size=len(t_s))
    left += step_rad * (t_s >= 15.0)
    travel = tuple(
        Travel(float(x), 0.0, float(y), 200, 20.0, 0.1)
        for x, y in zip(left, turn + wrong, strict=True)
    )
    camera = CAMERA.model_copy(update={"x_m": 1.7})
    seen = PicturePass(t_ns, t_s, t_s, t_ns, (960, 540), camera, 1.0, (), t_s[:0], t_ns, travel, 0)
    gyro = Series("gyro", t_ns, rate + 0.003)
    motion = CarMotion(Series("speed", t_ns, np.full(len(t_s), 10.0)), gyro if has_rate else None)
    return watch_mounting(seen, motion)


@pytest.mark.parametrize("step_deg", [0.5, -0.5])
def test_step_of_the_yaw_is_found_though_pictures_mistake_turns(step_deg: float) -> None:
    for seed in range(4):
        (step,) = swaying(seed, math.radians(step_deg)).steps

        assert step.value == "yaw"
        assert step.t_ns * 1e-9 == pytest.approx(15.0, abs=2.0)
        assert swaying(seed).steps == ()
    found = [swaying(seed, math.radians(step_deg), has_rate=False).steps for seed in range(4)]
    assert sum(len(one) == 1 for one in found) < 3


def test_wheels_of_a_straight_drive_do_not_contradict_the_gyro() -> None:
    """Tyres differ and wheels slip: the simulated car's do so by one per cent and more."""
    speed = np.concatenate([np.full(700, 9.5), np.linspace(9.5, 0.0, 500), np.zeros(100)])
    speed = np.concatenate([speed, np.linspace(0.0, 9.5, 600)])
    motion = integrated(np.zeros(len(speed)), speed)
    grid = Grid.over(int(motion.t_ns[0]), int(motion.t_ns[-1]))
    blamed = []
    for seed in range(60):
        sensed = sense(motion, DriveSettings(seed=seed))
        left, right = (
            Series.of(str(i), sensed.wheel_t_ns, sensed.wheels_mps[:, i]) for i in (2, 3)
        )
        gyro = Series.of("gyro", sensed.gyro_t_ns, sensed.gyro_radps[:, 2])
        found = judge_yaw_rate(gyro, [of_wheels(left, right, grid)], None, grid)
        blamed += [found.wrong] if found.wrong else []

    assert blamed == []


def test_windows_of_ten_seconds_have_intervals_that_hold_the_truth() -> None:
    inside = []
    for seed in range(40):
        t_s, angle = measured(seed, 0.0)
        windows = windows_of("pitch", np.round(t_s * 1e9).astype(np.int64), angle)
        assert len(windows) == 4
        inside += [abs(one.mean - 0.02) < 1.96 * one.sd for one in windows]

    assert np.mean(inside) > 0.93


def test_values_that_never_vary_have_no_step() -> None:
    t_ns = np.arange(60, dtype=np.int64) * 100_000_000
    same = np.zeros(60)

    assert steps_of("pitch", t_ns, same, same) == []
    (step,) = steps_of("pitch", t_ns, np.where(t_ns < t_ns[30], 0.0, 0.01), same)
    assert step.t_ns == t_ns[30]
