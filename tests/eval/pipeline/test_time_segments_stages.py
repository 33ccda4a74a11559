"""Every stage and command across a gap: two logs, parts of a log, landmarks, smoother, batches."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from crosscue.eval import cli
from crosscue.eval.pipeline.detect import Detecting, choices_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.localization.landmarks.database import (
    LandmarkDatabase,
    LandmarkPosition,
    LandmarkWriter,
)
from crosscue.replay.columns import Floats
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load
from support.gap_drive import (
    BEGIN,
    BUS,
    CAMERA,
    ROW,
    SECOND,
    SPEED_MPS,
    START_M,
    Clock,
    replayed,
    write_drive,
)
from support.gap_landmarks import STEP_M, PlaceByNumber
from support.landmark_drive import features_at

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


def _replayed_part(folder: Path, log: Path, run: str, *part: str) -> tuple[int, RunFolder]:
    argv = ["replay", str(log), "--vehicle", str(folder / "car.toml"), "-o", str(folder / run)]
    return cli.run([*argv, "--no-cache", *part]), RunFolder(folder / run)


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

    ended, run = _replayed_part(tmp_path, log, "run", *part)

    assert ended == status
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
