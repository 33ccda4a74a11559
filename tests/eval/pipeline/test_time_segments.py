"""Logs with gaps and clocks that were set, in every stage."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from crosscue.eval import cli
from crosscue.eval.pipeline.detecting import Detecting, choices_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.localization.gap import GapSettings, cross_gap
from crosscue.localization.landmarks.database import (
    LandmarkDatabase,
    LandmarkPosition,
    LandmarkWriter,
)
from crosscue.localization.pose_track import start_belief
from crosscue.replay.columns import Block, Floats
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.pose import Start
from crosscue.replay.vehicle.vehicle import Vehicle, load
from support.commands import output_of
from support.gap_drive import (
    BEGIN,
    BUS,
    CAMERA,
    ROW,
    SECOND,
    SPEED_MPS,
    START_M,
    Clock,
    distance_m,
    replay,
    replayed,
    write_drive,
)
from support.gap_landmarks import STEP_M, PlaceByNumber
from support.landmark_files import features_at
from support.memory_log import GYRO, WHEELS, MemoryLog, gyro_block, wheel_block
from support.refusals import refusal


def _drive(seconds: int = 20, rows_a_block: int = 7) -> list[Block]:
    """Ten wheel rows and twenty gyro rows per second, of a car that speeds up and turns."""
    wheel_t = np.arange(seconds * 10) * ROW + BEGIN
    gyro_t = np.arange(seconds * 20) * (ROW // 2) + BEGIN
    wheels = [
        wheel_block(part.tolist(), (5.0 + (part - BEGIN) * 1e-10).tolist())
        for part in np.array_split(wheel_t, max(len(wheel_t) // rows_a_block, 1))
    ]
    gyros = [
        gyro_block(part.tolist(), [0.05] * len(part))
        for part in np.array_split(gyro_t, max(len(gyro_t) // (2 * rows_a_block), 1))
    ]
    return [block for pair in zip(wheels, gyros, strict=True) for block in pair]


def _moved(blocks: Sequence[Block], at_ns: int, by_ns: int) -> list[Block]:
    """Set the clock of a log by the given amount at a time."""
    return [
        Block(b.topic, np.where(b.log_ns >= at_ns, b.log_ns + by_ns, b.log_ns), b.rows)
        for b in blocks
    ]


def _replay(path: Path, blocks: Sequence[Block], vehicle: Vehicle | None = None) -> Outcome:
    log = MemoryLog((WHEELS, GYRO), [b for b in blocks if len(b)], path=Path(__file__))
    vehicle = vehicle or Vehicle(version=1, start=Start(heading_rad=0.0))
    return replay_drive(Drive([log], vehicle), create(path, overwrite=True))


@pytest.mark.parametrize("by_s", [1000, -900])
def test_single_stray_stamp_is_skipped_and_reported(tmp_path: Path, by_s: int) -> None:
    blocks = _drive(rows_a_block=50)
    stray = blocks[2].log_ns.copy()
    stray[20] += by_s * SECOND
    kept = np.arange(len(stray)) != 20

    outcome = _replay(
        tmp_path / "run", [*blocks[:2], Block("wheels", stray, blocks[2].rows), *blocks[3:]]
    )
    without = _replay(tmp_path / "without", [*blocks[:2], blocks[2].take(kept), *blocks[3:]])

    assert len(outcome.segments) == 1
    assert outcome.travelled_m == without.travelled_m
    assert outcome.ledgers[0].topic("wheels").skipped == {"stray time stamp": 1}
    assert any("is far" in sentence for sentence in outcome.ledgers[0].notices)


@pytest.mark.parametrize("gap_s", [1.5, 4.0, 20.0, 1200.0])
def test_any_motion_in_gap_is_within_three_sigma(gap_s: float) -> None:
    limits = GapSettings()
    rng = np.random.default_rng(3)
    before = start_belief(0, 0.0, 0.0, 0.0, 15.0, 1.0, 0.01, 0.1)
    crossed = cross_gap(before, round(gap_s * 1e9), limits).belief
    for _ in range(200):
        accel = rng.uniform(-limits.max_accel_mps2, limits.max_accel_mps2)
        turn = rng.uniform(-limits.max_turn_rate_radps, limits.max_turn_rate_radps)
        time_s = np.linspace(0.0, gap_s, 2000)
        speed = np.clip(15.0 + accel * time_s, 0.0, limits.max_speed_mps)
        step_m = speed * gap_s / 2000
        xy = np.array(
            [(step_m * np.cos(turn * time_s)).sum(), (step_m * np.sin(turn * time_s)).sum()]
        )
        error = xy - crossed.mean[:2]
        assert error @ np.linalg.solve(crossed.cov[:2, :2], error) < 9.0


@pytest.mark.parametrize("by_ms", [-120, -150, -200, -250, -300])
def test_clock_set_back_by_few_rows_adds_no_distance(tmp_path: Path, by_ms: int) -> None:
    blocks = _drive()
    straight = _replay(tmp_path / "straight", blocks).travelled_m

    moved = _moved(blocks, BEGIN + 8 * SECOND, by_ms * 1_000_000)
    set_back = _replay(tmp_path / "moved", moved)

    # Wheel speeds of 5.9 m/s that overlap for up to 0.3 s cannot all be assigned.
    assert straight - 3.0 < set_back.travelled_m <= straight


LABELLED: Final = ("frames", "detections", "road", "cues", "range", "belief", "pose", "skipped")
NEVER_S: Final = 1e6
# Seconds of a gap that is too long to be crossed, above ``time.restart_after_s``.
RESTART_MS: Final = 5_000
ONE_ROW_MS: Final = ROW // 1_000_000


def _columns(
    outcome: Outcome, name: str, segment: int = 0, by_ms: int = 0
) -> dict[str, list[object]]:
    """Rows of a table in one segment, with the clock jump removed and counters starting at 0."""
    table = outcome.run.table(name)
    table = table.filter([number == segment for number in table["segment"].to_pylist()])
    columns: dict[str, list[object]] = table.to_pydict()
    columns["t_ns"] = (table["log_t_ns"].to_numpy() - by_ms * 1_000_000).tolist()
    for counter in columns.keys() & {"approach", "frame"}:
        numbers = table[counter].to_pylist()
        first = min((one for one in numbers if one is not None), default=0)
        columns[counter] = [None if one is None else one - first for one in numbers]
    return {key: rows for key, rows in columns.items() if key not in ("segment", "log_t_ns")}


def _assert_equal(one: dict[str, list[object]], other: dict[str, list[object]]) -> None:
    assert one.keys() == other.keys()
    for name, mine in one.items():
        if any(isinstance(value, float) for value in mine):
            ours, theirs = (np.array(rows, np.float64) for rows in (mine, other[name]))
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9, err_msg=name)
        else:
            assert mine == other[name], name


@pytest.mark.slow
@settings(max_examples=2, phases=[Phase.explicit, Phase.reuse, Phase.generate])
@given(
    cut=st.integers(40, 95),
    by_ms=st.one_of(st.integers(-4_000_000, -350), st.integers(1_100, 4_000_000)),
    rows_a_block=st.sampled_from([3, 7, 50]),
)
@example(cut=60, by_ms=3_000, rows_a_block=7)
@example(cut=60, by_ms=-3_000, rows_a_block=7)
def test_tables_around_clock_jump_equal_those_of_halves(
    tmp_path: Path, cut: int, by_ms: int, rows_a_block: int
) -> None:
    cut_s = cut * ROW / SECOND

    def run(name: str, clock: Clock) -> Outcome:
        log = write_drive(tmp_path, clock, rows_a_block=rows_a_block, name=f"{name}.mcap")
        return replay(tmp_path, log, name)

    first = run("first", Clock(pause_s=(cut_s, NEVER_S)))
    second = run("second", Clock(pause_s=(0.0, cut_s)))
    jumped = run("whole", Clock(set_at_s=cut_s, by_s=by_ms / 1000))

    assert len(jumped.segments) == 2
    assert jumped.exit_status == 3
    assert jumped.travelled_m == pytest.approx(first.travelled_m + second.travelled_m, abs=1e-9)
    assert jumped.detected is not None
    assert set(jumped.detected.counts.from_cache.values()) == {140}
    assert all(_columns(half, "range")["t_ns"] for half in (first, second))
    assert all(half.scene and half.scene.positive["stop_sign"] for half in (first, second))
    for name in ("frames", "detections", "cues", "range", "belief"):
        _assert_equal(_columns(jumped, name, 0), _columns(first, name))
    restarts = by_ms < 0 or by_ms + ONE_ROW_MS > RESTART_MS
    for name in ("cues", "range", "belief") if restarts else ("detections",):
        _assert_equal(_columns(jumped, name, 1, by_ms), _columns(second, name))


@pytest.mark.parametrize("by_s", [-3600.0, -7.0, 1200.0])
def test_every_table_records_segment_and_original_stamp(tmp_path: Path, by_s: float) -> None:
    jumped = replay(tmp_path, write_drive(tmp_path, Clock(set_at_s=6.0, by_s=by_s)))

    for name in LABELLED:
        assert {"segment", "log_t_ns"} <= set(jumped.run.schema(name).names)
    frames = jumped.run.table("frames")
    assert np.all(np.diff(frames["t_ns"].to_numpy()) > 0)
    assert set(frames["segment"].to_pylist()) == {0, 1}


@pytest.mark.parametrize("pause_s", [1.5, 3.0])
def test_short_gap_keeps_approach_and_range(tmp_path: Path, pause_s: float) -> None:
    begin_s = 5.0
    log = write_drive(tmp_path, Clock(pause_s=(begin_s, begin_s + pause_s)))

    outcome = replay(tmp_path, log)

    assert len(outcome.segments) == 2
    assert outcome.scene is not None
    assert outcome.scene.counts["approaches opened"] == 1
    assert "approaches closed: stale" not in outcome.scene.counts
    assert outcome.scene.without_odometry == 1
    after = outcome.run.table("range").to_pylist()
    after = [row for row in after if row["segment"] == 1]
    # A new range would begin with the second observation; this one was carried over the gap.
    assert after[0]["t_ns"] == outcome.segments[1].start_ns
    left_m = float(distance_m(np.array([after[0]["t_ns"]]))[0])
    assert after[0]["range_m"] == pytest.approx(left_m, abs=1.0)


@pytest.mark.parametrize("line", ["max_silence_s = 9.0", "restart_after_s = 2.0"])
def test_estimate_refuses_settings_that_split_frames_differently(tmp_path: Path, line: str) -> None:
    run = replay(tmp_path, write_drive(tmp_path, Clock(pause_s=(5.0, 8.0)))).run
    before = run.file("manifest.json").read_bytes()
    other = tmp_path / "other.toml"
    other.write_text((tmp_path / "car.toml").read_text() + f"[time]\n{line}\n")

    message = refusal(2, "estimate", run.path, "--vehicle", other)
    assert f"time.{line.split()[0]}" in message
    assert "run crosscue replay again" in message
    assert run.file("manifest.json").read_bytes() == before
    assert cli.run(["estimate", str(run.path), "--vehicle", str(tmp_path / "car.toml")]) == 3


@pytest.mark.parametrize("by_s", [3.0, -3.0])
def test_estimate_keeps_segments_of_detect(tmp_path: Path, by_s: float) -> None:
    log = write_drive(tmp_path, Clock(set_at_s=6.0, by_s=by_s))
    car, run = str(tmp_path / "car.toml"), tmp_path / "run"

    assert cli.run(["detect", str(log), "--vehicle", car, "-o", str(run), "--no-cache"]) == 3
    detected = RunFolder(run).table("frames")
    assert cli.run(["estimate", str(run), "--vehicle", car]) == 3

    assert set(detected["segment"].to_pylist()) == {0, 1}
    assert RunFolder(run).table("frames").equals(detected)
    assert set(RunFolder(run).table("pose")["segment"].to_pylist()) == {0, 1}


# Longer than ``time.restart_after_s``: the pose stays at its last estimate.
PAUSE: Final = Clock(pause_s=(4.0, 10.0))
MATCHER: Final = "support.gap_landmarks:matcher"


def _two_logs(folder: Path, wheels: Clock, camera: Clock, run: str) -> Outcome:
    """Wheels in one log and pictures in another, each with its own clock."""
    paths = [
        write_drive(folder, wheels, name=f"{run}_bus.mcap", topics=[BUS]),
        write_drive(folder, camera, name=f"{run}_camera.mcap", topics=[CAMERA]),
    ]
    vehicle = load(folder / "car.toml")
    detecting = Detecting(tuple(choices_of(vehicle).values()), cache=folder / "cache.sqlite")
    with ExitStack() as stack:
        logs = [stack.enter_context(open_log(path)) for path in paths]
        into = create(folder / run, overwrite=True)
        return replay_drive(Drive(logs, vehicle), into, detecting)


def _column(run: RunFolder, name: str, column: str) -> np.typing.NDArray[np.float64]:
    return np.asarray(run.table(name)[column].to_numpy())


def test_clock_set_back_in_camera_log_leaves_odometry_unchanged(tmp_path: Path) -> None:
    straight = _two_logs(tmp_path, Clock(), Clock(), "straight")
    camera = Clock(set_at_s=6.0, by_s=-3.0)

    shifted = _two_logs(tmp_path, Clock(), camera, "whole")

    assert (straight.exit_status, len(straight.segments)) == (0, 1)
    assert (shifted.exit_status, len(shifted.segments)) == (3, 2)
    assert shifted.travelled_m == straight.travelled_m
    for column in ("t_ns", "log_t_ns", "x_m", "travelled_m"):
        np.testing.assert_array_equal(
            _column(shifted.run, "pose", column), _column(straight.run, "pose", column)
        )
    frames = shifted.run.table("frames")
    true_ns = np.arange(140) * ROW + BEGIN
    assert frames["log_t_ns"].to_pylist() == camera.recorded(true_ns)[1].tolist()
    assert np.all(np.diff(frames["t_ns"].to_numpy()) > 0)
    assert frames["segment"].to_pylist() == [0] * 60 + [1] * 80


@pytest.mark.parametrize(
    ("part", "status", "rows", "way_m"),
    [
        (("--from", "3", "--to", "11"), 3, [20, 30], (19 + 29) * STEP_M),
        (("--from", "3", "--to", "6.5"), 0, [20], 19 * STEP_M),
        (("--from", "6"), 0, [60], 59 * STEP_M),
    ],
)
def test_selected_part_of_log_has_only_its_gaps(
    tmp_path: Path, part: tuple[str, ...], status: int, rows: list[int], way_m: float
) -> None:
    log = write_drive(tmp_path, Clock(pause_s=(5.0, 8.0)))

    run, car = RunFolder(tmp_path / "run"), tmp_path / "car.toml"
    output_of("replay", log, "--vehicle", car, "-o", run.path, "--no-cache", *part, status=status)

    numbers = run.table("frames")["segment"].to_pylist()
    assert [numbers.count(n) for n in sorted(set(numbers))] == rows
    assert _column(run, "pose", "travelled_m")[-1] == pytest.approx(way_m, abs=0.01)


def _with_landmarks(folder: Path, clock: Clock) -> Outcome:
    """Drive past a landmark every 4 m; each picture encodes where it was taken."""
    log = write_drive(folder, clock)
    with (folder / "car.toml").open("a") as file:
        file.write(f'[landmarks]\nmatcher = "{MATCHER}"\nrevisit_m = 10.0\n')
    path = folder / "marks.sqlite"
    with LandmarkWriter(path, PlaceByNumber.kind) as writer:
        for x_m in np.arange(2.0, 90.0, 4.0):
            xy = np.array([x_m, 0.0])
            writer.add(LandmarkPosition(f"{x_m:g}", xy, 0.25 * np.eye(2), 0.0), features_at(xy))
    vehicle = load(folder / "car.toml")
    with open_log(log) as opened, LandmarkDatabase(path) as database:
        into = create(folder / "run", overwrite=True)
        return replay_drive(Drive([opened], vehicle), into, landmarks=database)


def _off_m(run: RunFolder) -> Floats:
    """Distance of each pose from the true one; only for clocks that were not set."""
    true_m = SPEED_MPS * (_column(run, "pose", "log_t_ns") - BEGIN) / SECOND
    off_m: Floats = np.hypot(_column(run, "pose", "x_m") - true_m, _column(run, "pose", "y_m"))
    return off_m


@pytest.fixture(scope="module")
def marked(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    return _with_landmarks(tmp_path_factory.mktemp("marked"), PAUSE)


def test_landmarks_correct_pose_after_long_gap(marked: Outcome, tmp_path: Path) -> None:
    without = replayed(tmp_path, write_drive(tmp_path, PAUSE))

    after = _column(marked.run, "pose", "segment") == 1
    names = marked.run.table("pose")["landmark"].to_pylist()
    later = [name for name, is_after in zip(names, after, strict=True) if is_after and name]

    assert marked.exit_status == 3
    assert _off_m(without)[-1] > 30.0
    assert later
    assert all(float(name) > START_M - 15.0 for name in later)
    assert _off_m(marked.run)[-1] < 2.0
    # The displacement between poses is measured motion; a correction by a landmark is not.
    assert _column(marked.run, "pose", "travelled_m")[-1] == pytest.approx(
        _column(without, "pose", "travelled_m")[-1], abs=1e-6
    )
