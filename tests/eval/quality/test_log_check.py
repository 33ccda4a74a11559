"""``crosscue check LOG``: awkward logs are found out, good logs are not blamed."""

from collections.abc import Callable
from dataclasses import replace
from typing import Concatenate, Final, ParamSpec

import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.eval.quality.checks import CHECKS, PURPOSES
from crosscue.eval.quality.verdict import judge
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import parse
from support.quality_logs import CAR, Drive, Stream, Streams, examined, streams_of

Fault = Callable[[Streams], None]
Mask = NDArray[np.bool_]
P = ParamSpec("P")


def fault(change: Callable[Concatenate[Streams, P], None]) -> Callable[P, Fault]:
    """Return a function that takes the other arguments of a change of streams."""
    return lambda *given, **named: lambda streams: change(streams, *given, **named)


@fault
def without(streams: Streams, name: str) -> None:
    del streams[name]


@fault
def rows(streams: Streams, name: str, keep: Callable[[Floats], Mask]) -> None:
    """Keep the rows of a topic whose times fulfil a condition."""
    streams[name] = streams[name].take(np.flatnonzero(keep(streams[name].t_s)))


@fault
def thinned(streams: Streams, name: str, step: int, since_s: float = 0.0) -> None:
    """Keep every n-th row of a topic, from a time on."""
    t_s = streams[name].t_s
    keep = (t_s < since_s) | (np.arange(len(t_s)) % step == 0)
    streams[name] = streams[name].take(np.flatnonzero(keep))


@fault
def column(
    streams: Streams, name: str, column: str, edit: Callable[[Floats, Floats], Floats]
) -> None:
    """Change a column by its times and values; ``*`` is every column of wheels."""
    stream = streams[name]
    for one in stream.columns if column == "*" else (column,):
        stream = stream.with_column(one, edit(stream.t_s, stream.columns[one]))
    streams[name] = stream


@fault
def late(streams: Streams, name: str, by_s: float) -> None:
    """Move the time stamps of a topic."""
    stream = streams[name]
    moved = None if stream.header_s is None else stream.header_s + by_s
    streams[name] = replace(stream, t_s=stream.t_s + by_s, header_s=moved)


@fault
def stamps(streams: Streams, name: str, edit: Callable[[Floats], Floats]) -> None:
    """Change the sensor's stamps of a topic."""
    streams[name] = replace(streams[name], header_s=edit(streams[name].t_s))


@fault
def pictures(streams: Streams, since_s: float, edit: Callable[[Stream, int], None]) -> None:
    """Change the pictures from a time on."""
    camera = streams["camera"]
    for i in np.flatnonzero(camera.t_s >= since_s).tolist():
        edit(camera, i)


def painted(value: int) -> Callable[[Stream, int], None]:
    """Paint a picture in one brightness."""

    def edit(camera: Stream, i: int) -> None:
        assert camera.pictures is not None
        camera.pictures[i] = value

    return edit


def repeated(camera: Stream, i: int) -> None:
    assert camera.pictures is not None
    camera.pictures[i] = camera.pictures[i - 1]


def swapped(streams: Streams) -> None:
    wheels = streams["wheels"]
    columns = {**wheels.columns}
    columns["rear_left_mps"], columns["rear_right_mps"] = (
        columns["rear_right_mps"],
        columns["rear_left_mps"],
    )
    streams["wheels"] = replace(wheels, columns=columns)


@fault
def twice(streams: Streams, name: str) -> None:
    streams[name] = streams[name].take(np.repeat(np.arange(len(streams[name].t_s)), 2))


def clock_set_back(streams: Streams) -> None:
    """Set the stamps of the gyro back in the middle of the drive."""
    stream = streams["gyro"]
    header_s = stream.t_s - np.where(stream.t_s > 12.0, 3.0, 0.0)
    streams["gyro"] = replace(stream, header_s=header_s)


def still_camera(streams: Streams) -> None:
    """Show one picture throughout."""
    pictures = streams["camera"].pictures
    assert pictures is not None
    pictures[:] = pictures[0]


def in_middle(t_s: Floats, since_s: float = 5.0, until_s: float = 9.0) -> Mask:
    """Whether times are in a part of the drive."""
    return (t_s > since_s) & (t_s < until_s)


def frozen(t_s: Floats, values: Floats) -> Floats:
    """The same value for four seconds of motion."""
    return np.where(in_middle(t_s), values[np.argmax(in_middle(t_s))], values)


def spiked(by: float) -> Callable[[Floats, Floats], Floats]:
    """One reading that no car can produce."""
    return lambda t_s, values: values + by * (np.arange(len(values)) == len(values) // 3)


def lost(t_s: Floats, values: Floats) -> Floats:
    """Not a number in every tenth reading."""
    return np.where(np.arange(len(values)) % 10 == 0, np.nan, values)


@fault
def of_another_drive(streams: Streams, name: str) -> None:
    """Put in a topic that was recorded on another drive."""
    streams[name] = streams_of(Drive(seed=5, turn_rad=-1.4, stops=False, speed_mps=14.0))[name]


def continued_elsewhere(streams: Streams) -> None:
    """Continue with a drive in another town, as a script that joins files does."""
    other = streams_of(Drive(seed=6))
    gnss = other["gnss"]
    other["gnss"] = gnss.with_column("latitude_deg", gnss.columns["latitude_deg"] + 0.2)
    for name, stream in streams.items():
        early = np.flatnonzero(stream.t_s < 12.0)
        late = np.flatnonzero(other[name].t_s >= 12.0)
        first, second = stream.take(early), other[name].take(late)
        has_stamps, has_pictures = first.header_s is not None, first.pictures is not None
        streams[name] = Stream(
            np.concatenate([first.t_s, second.t_s]),
            {k: np.concatenate([first.columns[k], second.columns[k]]) for k in first.columns},
            np.concatenate([first.pictures, second.pictures]) if has_pictures else None,
            np.concatenate([first.header_s, second.header_s]) if has_stamps else None,
        )


def log_set_back(streams: Streams) -> None:
    """Set the sensors' clock back by two minutes, once."""
    for name, stream in streams.items():
        header_s = stream.t_s - np.where(stream.t_s > 12.0, 120.0, 0.0)
        streams[name] = replace(stream, header_s=header_s)


@fault
def again(streams: Streams, name: str, step: int) -> None:
    """Log a topic a second time, at another rate and with other noise."""
    other = streams_of(Drive(seed=7))[name]
    streams[f"{name}_again"] = other.take(np.arange(0, len(other.t_s), step))


def degrees(t_s: Floats, values: Floats) -> Floats:
    """Radians, and from the middle on degrees."""
    return np.where(t_s > 0.2 * t_s[-1], np.degrees(values), values)


def no_fix(t_s: Floats, values: Floats) -> Floats:
    """Zeros until the receiver finds satellites."""
    return np.where(t_s < 8.0, 0.0, values)


def constant(t_s: Floats, values: Floats) -> Floats:
    """A set value with noise, not a measurement."""
    return 8.0 + 0.02 * np.random.default_rng(1).normal(size=len(t_s))


def zero(t_s: Floats, values: Floats) -> Floats:
    """No pulse of a wheel."""
    return 0.0 * values


def noise(t_s: Floats, values: Floats) -> Floats:
    """What an axis measures about which the car does not turn."""
    return 0.004 * np.random.default_rng(2).normal(size=len(t_s))


def exchanged(streams: Streams) -> None:
    gnss = streams["gnss"]
    there = {"latitude_deg": "longitude_deg", "longitude_deg": "latitude_deg"}
    columns = {there.get(name, name): values for name, values in gnss.columns.items()}
    streams["gnss"] = replace(gnss, columns=columns)


NO_FOCAL: Final = parse("version = 1\n[start]\nx_m = 0.0\n", "test")
NO_START: Final = parse("version = 1\n[camera]\nfocal_px = 40.0\n", "test")
SMALLER: Final = parse(
    "version = 1\n[camera]\nfocal_px = 40.0\nsize_px = [24, 18]\n[start]\nx_m = 0.0\n", "test"
)
TWO: Final = parse('version = 1\n[topics]\nimu = "other"\n', "test")

# Name, check that must find it, fault.
AWKWARD: Final[tuple[tuple[str, str, Fault], ...]] = (
    ("no wheels", "speed", without("wheels")),
    ("no gyro and one wheel for both", "turning", lambda s: _one_wheel(s)),
    ("no GNSS", "position", without("gnss")),
    ("no camera", "camera", without("camera")),
    ("no focal length", "calibration", lambda s: None),
    ("focal length of another size", "calibration", lambda s: None),
    ("a named topic is missing", "topics", lambda s: None),
    ("wheels at a quarter of the rate", "rate", thinned("wheels", 5)),
    ("gyro at 4 Hz", "rate", thinned("gyro", 12)),
    ("camera at half the rate", "rate", thinned("camera", 2)),
    ("GNSS every four seconds", "rate", thinned("gnss", 8)),
    ("wheels halved from the middle on", "rate", thinned("wheels", 2, 15.0)),
    ("gyro halved from the middle on", "rate", thinned("gyro", 2, 15.0)),
    ("camera dropped to a third", "rate", thinned("camera", 3, 15.0)),
    ("gap of the wheels", "gaps", rows("wheels", lambda t: ~in_middle(t, 5.0, 6.0))),
    ("gap of the gyro", "gaps", rows("gyro", lambda t: ~in_middle(t, 5.0, 6.0))),
    ("gap of the camera", "gaps", rows("camera", lambda t: ~in_middle(t, 5.0, 7.0))),
    ("gap of GNSS", "gaps", rows("gnss", lambda t: ~in_middle(t, 5.0, 11.0))),
    ("wheels begin late", "gaps", rows("wheels", lambda t: t > 5.0)),
    ("camera ends early", "gaps", rows("camera", lambda t: t < 18.0)),
    ("gyro stamps 0.4 s ahead", "clocks", stamps("gyro", lambda t: t + 0.4)),
    ("gyro stamps drift", "clocks", stamps("gyro", lambda t: t * 1.003)),
    ("gyro stamps do not move", "clocks", stamps("gyro", lambda t: 0.0 * t + 1.0)),
    ("gyro stamps set back", "clocks", clock_set_back),
    ("gyro 0.35 s late", "lag", late("gyro", 0.35)),
    ("wheels 0.5 s late", "lag", late("wheels", 0.5)),
    ("all wheels frozen", "frozen", column("wheels", "*", frozen)),
    ("rear left wheel frozen", "frozen", column("wheels", "rear_left_mps", frozen)),
    ("gyro frozen", "frozen", column("gyro", "gyro_z_radps", frozen)),
    ("position frozen", "frozen", column("gnss", "latitude_deg", frozen)),
    ("wheels not numbers", "invalid", column("wheels", "rear_left_mps", lost)),
    ("gyro not numbers", "invalid", column("gyro", "gyro_z_radps", lost)),
    ("a spike of the speed", "jumps", column("wheels", "*", spiked(30.0))),
    ("a spike of the gyro", "jumps", column("gyro", "gyro_z_radps", spiked(3.0))),
    ("position jumps", "jumps", column("gnss", "latitude_deg", spiked(0.01))),
    ("position at zero", "jumps", column("gnss", "*", lambda t, v: 0.0 * v)),
    ("rear wheels swapped", "agreement", swapped),
    ("yaw rate of the wrong sign", "agreement", column("gyro", "gyro_z_radps", lambda t, v: -v)),
    ("yaw rate in degrees", "agreement", column("gyro", "gyro_z_radps", lambda t, v: 57.3 * v)),
    ("speed in km/h", "agreement", column("wheels", "*", lambda t, v: 3.6 * v)),
    ("a wheel in km/h", "agreement", column("wheels", "rear_left_mps", lambda t, v: 3.6 * v)),
    ("gyro with a large bias", "agreement", column("gyro", "gyro_z_radps", lambda t, v: v + 0.1)),
    ("black pictures", "pictures", pictures(12.0, painted(0))),
    ("white pictures", "pictures", pictures(12.0, painted(255))),
    ("grey pictures", "pictures", pictures(12.0, painted(90))),
    ("repeated pictures", "pictures", pictures(15.0, repeated)),
    ("one picture throughout", "pictures", still_camera),
    ("wheels stored twice", "duplicates", twice("wheels")),
    ("pictures stored twice", "duplicates", twice("camera")),
    ("two seconds", "length", lambda s: _cut(s, 2.0)),
    ("gyro of another drive", "agreement", of_another_drive("gyro")),
    ("GNSS of another drive", "agreement", of_another_drive("gnss")),
    ("two drives one after the other", "jumps", continued_elsewhere),
    ("all clocks set back", "clocks", log_set_back),
    ("gyro a second time at another rate", "topics", again("gyro", 5)),
    ("wheels a second time at another rate", "topics", again("wheels", 4)),
    ("camera at 1 Hz", "rate", thinned("camera", 6)),
    ("yaw rate in degrees from the middle on", "agreement", column("gyro", "*", degrees)),
    ("GNSS without a fix", "jumps", column("gnss", "*", no_fix)),
    ("no row of the wheels", "speed", rows("wheels", lambda t: t < 0.0)),
    ("no picture", "camera", rows("camera", lambda t: t < 0.0)),
    ("wheels constant while the car moves", "agreement", column("wheels", "*", constant)),
    ("wheels at zero while the car moves", "agreement", column("wheels", "*", zero)),
    ("gyro of another axis", "agreement", column("gyro", "gyro_z_radps", noise)),
    ("latitude and longitude exchanged", "agreement", exchanged),
)
# Vehicle files of some of them.
VEHICLES: Final = {
    "no GNSS": NO_START,
    "no focal length": NO_FOCAL,
    "focal length of another size": SMALLER,
    "a named topic is missing": TWO,
}


def _one_wheel(streams: Streams) -> None:
    del streams["gyro"]
    wheels = streams["wheels"]
    columns = {**wheels.columns, "rear_right_mps": wheels.columns["rear_left_mps"]}
    streams["wheels"] = replace(wheels, columns=columns)


def _cut(streams: Streams, seconds: float) -> None:
    for name in streams:
        rows(name, lambda t: t < seconds)(streams)


GOOD: Final = (
    *(Drive(seed=seed) for seed in range(6)),
    *(Drive(seed=10 + seed, stops=False) for seed in range(4)),
    *(Drive(seed=20 + seed, turn_rad=0.0) for seed in range(3)),
    *(Drive(seed=30 + seed, turn_rad=0.0, stops=False) for seed in range(3)),
    *(Drive(seed=40 + seed, turn_rad=-1.5) for seed in range(3)),
    Drive(seed=50, wheels_hz=100.0),
    Drive(seed=51, wheels_hz=10.0, gyro_hz=10.0),
    Drive(seed=52, gyro_hz=200.0),
    Drive(seed=53, gnss_hz=1.0),
    Drive(seed=54, gnss_hz=10.0),
    Drive(seed=55, camera_hz=15.0, seconds=12.0),
    Drive(seed=56, speed_mps=33.0, turn_rad=0.3),
    Drive(seed=57, speed_mps=4.0),
    Drive(seed=58, noise=3.0),
    Drive(seed=59, noise=0.3),
    Drive(seed=60, seconds=6.0, stops=False),
    Drive(seed=61, seconds=60.0),
)


@pytest.mark.parametrize(("name", "check", "fault"), AWKWARD, ids=[a[0] for a in AWKWARD])
def test_awkward_log_is_found_out_by_the_check_for_it(name: str, check: str, fault: Fault) -> None:
    streams = streams_of(Drive())
    fault(streams)

    found = judge(examined(streams, VEHICLES.get(name, CAR)))

    assert check in {one.check for one in found}, [one.text for one in found]


def spared(t_s: Floats) -> Mask:
    """All rows but each twentieth."""
    return np.asarray(np.arange(len(t_s)) % 20 != 7)


def brightening(streams: Streams) -> None:
    """Pictures that become slowly brighter, as in the morning."""
    camera = streams["camera"]
    assert camera.pictures is not None
    light = np.linspace(0.3, 1.3, len(camera.t_s))[:, None, None]
    dawn = np.clip(camera.pictures * light, 0, 255).astype(np.uint8)
    streams["camera"] = replace(camera, pictures=dawn)


def jittered(streams: Streams) -> None:
    """Rows that a busy recorder stamps up to 15 ms late."""
    rng = np.random.default_rng(3)
    for name, stream in streams.items():
        late_s = rng.uniform(0.0, 0.015, len(stream.t_s))
        streams[name] = replace(stream, t_s=np.sort(stream.t_s + late_s), header_s=stream.header_s)


def rounded(to: float) -> Callable[[Floats, Floats], Floats]:
    """Readings in steps."""
    return lambda t_s, values: np.round(values / to) * to


# Good logs of other kinds: how the car is driven, and how its sensors differ.
GOOD_KINDS: Final[tuple[tuple[str, Drive, Fault], ...]] = (
    ("morning", Drive(seed=70), brightening),
    ("a busy recorder", Drive(seed=71), jittered),
    ("speed in steps of 0.1 km/h", Drive(seed=72), column("wheels", "*", rounded(0.1 / 3.6))),
    (
        "yaw rate in steps of 0.1 degrees a second",
        Drive(seed=73),
        column("gyro", "gyro_z_radps", rounded(np.radians(0.1))),
    ),
    ("one picture dropped", Drive(seed=74), rows("camera", lambda t: np.arange(len(t)) != 40)),
    ("one reading of each twentieth lost", Drive(seed=75, wheels_hz=50.0), rows("wheels", spared)),
    ("two turns in a row", Drive(seed=76, turn_rad=3.0), lambda s: None),
    ("south of the equator", Drive(seed=77), column("gnss", "latitude_deg", lambda t, v: v - 82.0)),
    ("in the mountains", Drive(seed=78), column("gnss", "altitude_m", lambda t, v: v + 2000.0)),
    ("stamps of the sensor 4 ms early", Drive(seed=79), stamps("gyro", lambda t: t - 0.004)),
    ("two minutes", Drive(seed=80, seconds=120.0), lambda s: None),
    ("in a car park", Drive(seed=81, speed_mps=3.0, turn_rad=2.5, stops=False), lambda s: None),
)


GOOD_LOGS: Final = (*((str(one.seed), one, lambda s: None) for one in GOOD), *GOOD_KINDS)


@pytest.mark.parametrize(("name", "drive", "kind"), GOOD_LOGS, ids=[one[0] for one in GOOD_LOGS])
def test_good_log_is_not_blamed(name: str, drive: Drive, kind: Fault) -> None:
    streams = streams_of(drive)
    kind(streams)

    found = judge(examined(streams))

    assert [f"{one.check}: {one.text}" for one in found] == []


# Checks that other files test: lost rows by the readers, the camera by rendered pictures.
ELSEWHERE: Final = {"damage", "camera delay", "standstill", "mounting"}


@pytest.mark.parametrize("name", [one.name for one in CHECKS])
def test_every_row_of_the_table_finds_something(name: str) -> None:
    assert name in {one[1] for one in AWKWARD} | ELSEWHERE


def test_names_of_checks_are_unique_and_purposes_known() -> None:
    assert len({one.name for one in CHECKS}) == len(CHECKS)
    streams = streams_of(Drive())
    for name in ("wheels", "gyro", "camera"):
        del streams[name]
    for finding in judge(examined(streams)):
        assert set(finding.purposes) <= set(PURPOSES)
        assert finding.help
