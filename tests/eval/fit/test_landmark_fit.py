"""Fit of the landmark threshold: required rates, intervals, pairs from tables and drives."""

import json
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.truth.truth import Truth, save
from crosscue.datasets.truth.tum import planar, write_tum
from crosscue.eval import cli
from crosscue.eval.fit.landmarks.threshold import Rate, ScoredPairs, fit_threshold
from crosscue.replay.vehicle.vehicle import load
from support.data import shared
from support.landmark_files import encoded, seen_from, wall


def simulated_pairs(seed: int, false: int = 4000, same: int = 400) -> ScoredPairs:
    """Simulate exponential two-place scores of mean 5, and same-place scores around 40."""
    rng = np.random.default_rng(seed)
    score = np.concatenate([rng.exponential(5.0, false), rng.normal(40.0, 12.0, same)])
    is_same = np.arange(false + same) >= false
    return ScoredPairs(score, is_same, rng.integers(0, (false + same) // 20, false + same))


@pytest.mark.parametrize("required", [0.0, 0.002, 0.05])
def test_threshold_is_the_lowest_that_meets_the_required_rate(required: float) -> None:
    pairs = simulated_pairs(1)
    fitted = fit_threshold(pairs, required)

    assert fitted.fitted_false.hits <= required * fitted.fitted_false.of
    assert fitted.fitted_false.hits + 1 > required * fitted.fitted_false.of - 1
    assert fitted.fitted_false.of + fitted.held_out_false.of == 4000
    assert fitted.fitted_found.of + fitted.held_out_found.of == 400


def test_intervals_equal_published_values() -> None:
    """Clopper and Pearson's of 10 of 100, from published tables; all is possible without pairs."""
    pairs = ScoredPairs(np.arange(200.0), np.zeros(200, bool), np.arange(200))
    fitted = fit_threshold(pairs, 0.1)

    false = fitted.fitted_false
    assert (false.hits, false.of) == (10, 100)
    assert (false.low, false.high) == pytest.approx((0.0490047, 0.1762226), abs=1e-6)
    assert fitted.fitted_found == fitted.held_out_found == Rate(0, 0, 0.0, 1.0)


def test_threshold_fitted_to_a_table_of_pairs_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Eight simulated walls, each observed again, compared with all eight."""
    for i in range(8):
        (tmp_path / f"a{i}.png").write_bytes(encoded(wall(i, 320, 240)))
        again = seen_from(wall(i, 320, 240), 6.0, 1.1, 5.0, i)
        (tmp_path / f"b{i}.png").write_bytes(encoded(again))
    rows = [f"b{i}.png,a{j}.png,{int(i == j)}" for i in range(8) for j in range(8)]
    (tmp_path / "pairs.csv").write_text("query,known,same\n" + "\n".join(rows) + "\n")
    car = tmp_path / "car.toml"
    car.write_text("version = 1 # mine\n")
    command = ["fit", "landmarks", "--pairs", str(tmp_path / "pairs.csv"), "--vehicle", str(car)]
    assert cli.run([*command, "-o", str(car), "--json"]) == 0

    fitted = json.loads(capsys.readouterr().out)
    assert (fitted["held_out_found"]["hits"], fitted["held_out_found"]["of"]) == (4, 4)
    # OpenCV 4.14 and 5.0 match features differently: one of the 28 passes, or none.
    assert fitted["held_out_false"]["of"] == 28
    assert fitted["held_out_false"]["hits"] <= 1
    assert not fitted["is_shown"]
    assert load(car).landmarks.min_score == fitted["min_score"]
    assert "# mine" in car.read_text()
    assert cli.run(command) == 0
    assert "28 held-out pairs cannot show a rate of 0.001" in capsys.readouterr().out


def test_threshold_is_fitted_to_a_recorded_drive_with_poses(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """KITTI, 51 frames: even frames are landmarks, odd frames the drive; far is over 25 m."""
    folder = shared("sequences", "kitti_seq2_right_turn_98deg")
    pose = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    heading = np.arctan2(-pose[:, 0, 2], pose[:, 2, 2])
    t_ns = np.arange(51, dtype=np.int64) * 100_000_000
    write_tum(tmp_path / "pose.tum", planar(t_ns, pose[:, 2, 3], -pose[:, 0, 3], heading))
    truth = Truth(version=1, start_ns=0, end_ns=10**10, pose="pose.tum", pose_point="camera")
    save(truth, tmp_path)
    for name, first in (("even", 0), ("odd", 1)):
        (tmp_path / name).mkdir()
        for i in range(first, 51, 2):
            picture = (folder / "image_l" / f"{i:06d}.png").read_bytes()
            (tmp_path / name / f"{i:06d}.png").write_bytes(picture)
        times = "\n".join(f"{t * 1e-9:.3f}" for t in t_ns[first::2])
        (tmp_path / name / "timestamps.txt").write_text(times + "\n")
    poses = ["--poses", str(tmp_path / "truth.json")]
    database = str(tmp_path / "even.sqlite")
    add = ["landmarks", "add", database, str(tmp_path / "even"), *poses, "--every", "1"]
    assert cli.run(add) == 0
    fit = ["fit", "landmarks", str(tmp_path / "odd"), "--database", database, *poses]
    near = [
        "--every",
        "0.5",
        "--same-within",
        "3",
        "--different-beyond",
        "25",
        "--false-match-rate",
        "0.05",
    ]
    capsys.readouterr()
    assert cli.run([*fit, *near, "--json"]) == 0

    fitted = json.loads(capsys.readouterr().out)
    found = fitted["held_out_found"]
    assert found["hits"] == found["of"] > 20
    assert 4 < fitted["min_score"] < 100
