"""Studies: reproducible with any number of workers, with checked input."""

import math
from pathlib import Path

import numpy as np
import pytest

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.studies.intervals import (
    logistic,
    range_at,
    ratio_of_means,
)
from crosscue.eval.studies.town import work
from crosscue.eval.studies.town.field_study import drive_field, finish_field, through_log
from crosscue.eval.studies.town.landmark_study import summarise_landmarks
from crosscue.eval.studies.town.range_study import calibrate, drive_choices, summarise_ranges
from crosscue.eval.studies.town.run import drive_study, finish_landmarks, finish_range
from crosscue.eval.studies.town.settings import FieldStudy, LandmarkStudy, RangeStudy
from crosscue.eval.studies.town.work import chunks_of, run, split
from crosscue.localization.town.drive import DriveResult, Keys
from crosscue.localization.town.settings import City, Navigation, Sensors, TownDrive
from crosscue.replay.columns import Floats
from crosscue.replay.errors import RunError, WorkerError
from support.refusals import refusal

TOWN = TownDrive(city=City(largest_km2=2.0))
SMALL = LandmarkStudy(
    drives=3, drive=TOWN, densities_per_km2=(0.5, 5.0), detection_rates=(0.6,), points=()
)


@pytest.fixture(autouse=True)
def _small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, "CHUNK_DRIVES", 2)


def study_bytes(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def run_study(study: LandmarkStudy, folder: Path, workers: int = 1) -> Path:
    assert list(drive_study(study, folder, workers))[-1] == 1.0
    finish_landmarks(study, folder)
    return folder


@pytest.mark.slow
def test_study_files_do_not_depend_on_number_of_workers(tmp_path: Path) -> None:
    one = study_bytes(run_study(SMALL, tmp_path / "one", workers=1))
    three = study_bytes(run_study(SMALL, tmp_path / "three", workers=3))

    assert {"drives.parquet", "summary.json", "study.html", "landmarks_range.svg"} <= set(one)
    assert one == three


def test_extra_distance_is_averaged_over_pairs_reached_goals_and_all_drives() -> None:
    study = SMALL.model_copy(
        update={"strategies": ("straight to goal", "hybrid"), "densities_per_km2": (0.5,)}
    )
    distances_m = np.array([[1000.0, 2000.0, 9000.0], [1100.0, 2200.0, 12_000.0]])
    outcomes = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    assert math.isnan(
        ratio_of_means(distances_m[0], outcomes[1], distances_m[1], outcomes[1]).value
    )
    rows = [
        {
            **dict.fromkeys(DriveResult._fields, np.ones(3)),
            "travelled_m": distance_m,
            "outcome": outcome,
        }
        for distance_m, outcome in zip(distances_m, outcomes, strict=True)
    ]
    (found,) = summarise_landmarks(study, rows).comparisons

    assert found.pairs == 2
    assert found.extra.value == pytest.approx(0.1)
    assert found.extra_reached.value == pytest.approx((15_300.0 / 3.0) / (3000.0 / 2.0) - 1.0)
    assert found.extra_all.value == pytest.approx(15_300.0 / 12_000.0 - 1.0)
    # The only cell is below 10 landmarks per km2, and all cities have 1 km2.
    assert found.extra_sparse.value == found.extra_reached.value
    assert found.by_city[0].extra.value == found.extra_reached.value
    assert all(math.isnan(one.extra.value) for one in found.by_city[1:])


@pytest.mark.slow
def test_distance_until_loss_decreases_with_compass_interval() -> None:
    study = RangeStudy(drives=100)
    found = {
        (round(one.slip_per_sqrt_m, 4), round(one.compass_interval_m, 3)): one
        for one in drive_choices(study)
    }

    assert [key for key, one in found.items() if one.is_studied] == [(0.003, 1.876)]
    for slip in (0.0015, 0.003, 0.006, 0.009):
        means = [one.lost_after_m[30.0].value for key, one in found.items() if key[0] == slip]
        # The longer a compass error lasts, the sooner the car loses its pose: about 1 / interval.
        assert means == sorted(means, reverse=True)
        assert 1.5 < means[0] / means[-1] < 4.0
    for one in found.values():
        assert one.lost_after_m[20.0].value > one.lost_after_m[30.0].value
        assert one.lost_after_m[None].value < 1000.0


@pytest.mark.slow
def test_distance_until_loss_scales_with_squared_compass_error(tmp_path: Path) -> None:
    """The distance until loss is inversely proportional to the squared compass error (r ds D)."""
    study = RangeStudy(drives=120, compass_2sigma_deg=(20.0, 30.0))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(work, "CHUNK_DRIVES", 60)
        list(drive_study(study, tmp_path, 2))
    finish_range(study, tmp_path)
    twenty, thirty, none = summarise_ranges(study, list(split(RunFolder(tmp_path).table("drives"))))

    ratio = twenty.lost_after_m.value / thirty.lost_after_m.value
    assert ratio == pytest.approx(2.25, rel=0.12)
    assert thirty.lost_after_m.value > thirty.law_m
    assert none.lost_after_m.value < 500.0


@pytest.mark.slow
def test_simulated_drive_replayed_from_log_matches_simulation(tmp_path: Path) -> None:
    settings = TownDrive(
        city=City(largest_km2=1.5),
        landmarks_per_km2=20.0,
        navigation=Navigation(strategy="landmark to landmark"),
        sensors=Sensors(detection_rate=0.7),
    )
    done = through_log(tmp_path, settings, seed=9)
    result, score = done.traced.result, done.score

    assert done.is_whole
    assert result.detected > 0
    assert done.landmark_counts["accepted"] == result.detected
    assert done.landmark_counts["frames"] == 2 * result.passed
    assert score.distance_m == pytest.approx(result.travelled_m, rel=0.02)
    assert score.major_axis_m == pytest.approx(result.major_axis_m, rel=0.35)
    assert score.nees_xyh.mean < 15.0


def test_logistic_fit_recovers_generating_curve() -> None:
    rng = np.random.default_rng(3)
    x = rng.uniform(0.0, 12_000.0, 4000)
    success = (rng.uniform(size=4000) < 1.0 / (1.0 + np.exp(-(8.0 - 1e-3 * x)))).astype(float)
    a, b = logistic(x, success, np.ones((1, 4000)))
    at_80 = range_at(x, success, 0.8)

    assert a[0] == pytest.approx(8.0, rel=0.15)
    assert b[0] == pytest.approx(-1e-3, rel=0.15)
    assert at_80.low < 8000.0 - 1000.0 * math.log(4.0) < at_80.high


def test_folder_of_another_study_is_refused(tmp_path: Path) -> None:
    run_study(SMALL, tmp_path)
    other = SMALL.model_copy(update={"seed": 9})

    with pytest.raises(RunError, match="other settings"):
        list(drive_study(other, tmp_path, 1))
    list(drive_study(other, tmp_path, 1, overwrite=True))


@pytest.mark.parametrize("flags", [["--drives", "0"], ["--workers", "0"], ["--seed", "-3"]])
def test_study_options_out_of_range_are_refused(tmp_path: Path, flags: list[str]) -> None:
    assert flags[0] in refusal(2, "study", "range", "-o", tmp_path, *flags)


@pytest.mark.slow
def test_default_compass_interval_equals_calibrated_one() -> None:
    default = TownDrive()

    assert calibrate(default, 2, tolerance=0.01) == default.sensors.compass_interval_m


@pytest.mark.slow
def test_field_runs_are_reused(tmp_path: Path) -> None:
    study = FieldStudy(range_runs=1, landmark_runs=1, minutes=2.0)
    first = [run for _, run in drive_field(study, tmp_path, 1)]
    logs = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*/drive.mcap")}
    again = [run for _, run in drive_field(study, tmp_path, 1)]
    finish_field(study, again, tmp_path)

    assert first == again
    assert {path: path.stat().st_mtime_ns for path in logs} == logs
    assert [run.has_landmarks for run in first] == [False, True]
    assert all(run.is_whole and run.minutes == pytest.approx(2.0, abs=0.01) for run in first)
    with pytest.raises(RunError, match="other settings"):
        list(drive_field(FieldStudy(minutes=3.0), tmp_path, 1))


def test_study_without_memory_writes_no_table(tmp_path: Path) -> None:
    def drive(settings: TownDrive, seeds: Keys) -> Floats:
        raise MemoryError("too many cities")

    chunks = chunks_of(SMALL.cases(), SMALL.drives, SMALL.seed)
    with pytest.raises(WorkerError, match=r"ran out of memory \(too many cities\); run it again"):
        list(run(chunks, tmp_path, 2, drive))
    assert not list(tmp_path.iterdir())
