"""Drives are grouped by place, and intervals of scores are over places."""

import math
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.truth.truth import Origin, Truth
from crosscue.datasets.truth.tum import planar, write_tum
from crosscue.eval.scoring.columns import NONE
from crosscue.eval.scoring.drives import pool_scores, score_drive
from crosscue.eval.scoring.intervals import MIN_CLUSTERS, fraction, mean
from crosscue.eval.scoring.places import group_drives, group_places, places_of
from crosscue.eval.scoring.truth import DriveTruth, read_scored_truth
from support.scoring import approach, good_tables, good_truth, truth_folder

TIMES = 400


def test_place_of_the_truth_comes_before_names_of_intersections(tmp_path: Path) -> None:
    named = read_scored_truth(truth_folder(tmp_path / "a"), "a")
    placed = read_scored_truth(truth_folder(tmp_path / "b", place="Elm Street"), "b")

    intersection = named.truth.approaches[0].intersection
    assert named.places == {NONE: intersection, 0: intersection}
    assert set(placed.places.values()) == {"Elm Street"}


def test_positions_within_50_m_are_one_place(tmp_path: Path) -> None:
    def truth_at(east_m: float) -> Truth:
        name = f"{east_m:g}.tum"
        t_ns = np.arange(5) * 10**9
        x_m = east_m + np.linspace(-30.0, 0.0, 5)
        write_tum(tmp_path / name, planar(t_ns, x_m, np.zeros(5), np.zeros(5)), "made up")
        one = approach().model_copy(update={"start_ns": 0, "enter_ns": 4 * 10**9})
        origin = Origin(latitude_deg=52.5, longitude_deg=13.4, altitude_m=40.0)
        return Truth(
            version=1, start_ns=0, end_ns=5 * 10**9, pose=name, origin=origin, approaches=(one,)
        )

    found = [places_of(truth_at(east_m), tmp_path) for east_m in (0.0, 45.0, 90.0, 200.0)]
    first = found[0][0]
    assert first == found[0][NONE]
    assert first == "geo:52.500000,13.400000"
    # The second connects the first and the third, which are 90 m apart.
    assert group_places([one[0] for one in found]).tolist() == [0, 0, 0, 1]
    assert group_places([found[0][0], found[2][0]]).tolist() == [0, 1]


def test_drives_that_share_a_place_are_one_group() -> None:
    drives = [["a"], ["b"], ["b", "c"], ["d"], ["c"]]

    assert group_drives(drives).tolist() == [0, 1, 1, 2, 1]
    assert group_drives([]).tolist() == []


def test_drives_to_one_intersection_have_no_interval_of_scores() -> None:
    def scored(names: list[str]) -> float:
        drives = []
        for number, name in enumerate(names):
            truth = good_truth()
            placed = DriveTruth(f"drive {number}", truth.truth, truth.ranges, {0: name, NONE: name})
            drives.append(score_drive(good_tables(), placed))
        found = pool_scores(drives)
        assert found.approaches is not None
        precision = found.cues["stop_sign"].precision
        brier = found.belief["left"].brier
        clusters = {precision.clusters, brier.clusters, found.approaches.detected_m.clusters}
        assert clusters == {len(set(names))}
        return brier.low

    assert math.isnan(scored(["A"] * 8))
    assert math.isfinite(scored([f"{i % MIN_CLUSTERS}" for i in range(8)]))


@pytest.mark.parametrize("places", [4, 5, 8])
def test_intervals_over_places_cover_what_intervals_over_drives_miss(places: int) -> None:
    """Four drives per place; as drives, 20 of 5 places covered 81 to 83 %."""
    rng = np.random.default_rng(places)
    at = np.repeat(np.arange(places), 4)
    right = {"places": 0, "drives": 0, "fraction": 0}
    for _ in range(TIMES):
        values = rng.normal(0.0, 1.0, places)[at] + rng.normal(0.0, 0.7, len(at))
        for name, clusters in (("places", at), ("drives", np.arange(len(at)))):
            found = mean(values, clusters)
            right[name] += found.low <= 0.0 <= found.high
        level = rng.beta(8.0, 2.0, places)[at]
        rows = np.repeat(np.arange(len(at)), 10)
        found_fraction = fraction(rng.random(len(rows)) < level[rows], at[rows])
        low, high = found_fraction.clusters_low, found_fraction.clusters_high
        right["fraction"] += low <= 0.8 <= high

    assert right["drives"] / TIMES < 0.85
    assert right["places"] / TIMES > 0.95 - 3.0 * math.sqrt(0.95 * 0.05 / TIMES)
    assert right["fraction"] / TIMES > 0.93 - 2.0 * math.sqrt(0.95 * 0.05 / TIMES)
