"""Fits of beliefs from run folders and truth files, up to the command line."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.truth.truth import read_truth, save
from crosscue.eval.cli import run as crosscue
from crosscue.eval.fit.annotated_runs import annotated_approaches, annotated_drives
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.scoring.truth import read_scored_truth
from crosscue.fusion.fit.annotated_approach import AnnotatedApproach
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.commands import json_of, output_of
from support.fusion_runs import (
    made_up_drive,
    write_drives,
    write_empty_truth,
    write_run,
    write_truth,
)
from support.refusals import refusal

DRIVES = 16
Drives = tuple[list[Path], list[Path]]


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    """Run folders and truth files, half with a road to the left."""
    return write_drives(tmp_path_factory.mktemp("drives"), [True, False] * (DRIVES // 2))


def annotated_run(run: RunFolder, truth: Path) -> tuple[list[AnnotatedApproach], Counter[str]]:
    known, used = read_scored_truth(truth, "drive"), Counter[str]()
    return list(annotated_approaches(run, known, Vehicle(version=1), used)), used


def test_approach_has_features_of_truth_and_ends_at_intersection(drives: Drives) -> None:
    (one,), used = annotated_run(open_run(drives[0][0]), drives[1][0])

    assert one.features == {"intersection": True, "left": True, "right": True, "straight": True}
    assert len(one.way_m) == 59
    assert one.way_m.tolist() == pytest.approx(list(range(59)))
    assert not one.is_established[0]
    assert one.is_established[1:].all()
    assert not one.is_near[:36].any()
    assert one.is_near[-15:].all()
    assert one.counts["stop_sign"].tolist() == [1] * 59
    assert (one.counts["parked_left"] == 0).all()
    assert used == {"to an intersection": 1}


def test_drive_without_intersection_is_annotated_as_negative(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    run = write_run(tmp_path / "run", made_up_drive(rng, left=False, signed=False))

    found, _ = annotated_run(run, write_empty_truth(tmp_path / "truth"))

    assert {tuple(one.features.items()) for one in found} == {
        (("intersection", False), ("left", False), ("right", False))
    }
    assert not found[0].is_near.any()


def test_approach_that_begins_in_an_intersection_is_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    late = [one for one in made_up_drive(rng, left=True, signed=True) if one.t_ns >= 3_000_000_000]
    run = write_run(tmp_path / "run", late)

    truth = write_truth(tmp_path / "truth", left=True, enter_ns=2_000_000_000)
    found, used = annotated_run(run, truth)

    assert not found
    assert used == {"in an intersection, left out": 1}


def test_approach_with_unknown_roads_is_left_out(tmp_path: Path) -> None:
    run = write_run(
        tmp_path / "run", made_up_drive(np.random.default_rng(0), left=True, signed=True)
    )

    found, used = annotated_run(run, write_truth(tmp_path / "truth", left=None))

    assert not found
    assert used == {"to an intersection with unknown roads, left out": 1}


def test_command_writes_a_section_for_the_vehicle_file(drives: Drives, tmp_path: Path) -> None:
    runs, truths = drives
    section = tmp_path / "calibrated.toml"
    command = ["fit", "messages", *map(str, runs), "--truth", *map(str, truths)]

    reported = output_of(*command, "-o", section)
    assert f"{DRIVES} annotated approaches" in reported
    assert "road_left -> left, near" in reported
    assert "stop_sign -> intersection, far: 16 places with it, 0 without, 16 positive" in reported
    text = "version = 1\n[fusion]\nkind = 'calibrated'\n" + section.read_text()
    learned = parse(text, "car.toml").fusion.calibrated
    assert learned is not None
    by_place = {(one.cue, one.feature, one.near): one for one in learned.rates}
    for near in (False, True):
        rates = by_place["road_left", "left", near]
        assert rates.if_there > 0.4 > 0.25 > rates.if_not
    assert set(by_place) == {("road_left", "left", near) for near in (False, True)}


def test_section_is_printed_without_output_option(drives: Drives) -> None:
    runs, truths = drives
    command = ["fit", "messages", *map(str, runs), "--truth", *map(str, truths)]

    assert "\n[fusion.calibrated]\nrates = [\n" in output_of(*command)
    printed = json_of(*command)
    assert printed["approaches"] == DRIVES
    (rate,) = [
        one
        for one in printed["rates"]
        if (one["cue"], one["feature"], one["near"]) == ("road_left", "left", True)
    ]
    for interval in ("wilson", "by_places"):
        low, high = rate["there"][interval]
        assert low < rate["there"]["rate"] < high


@pytest.fixture(scope="module")
def timed_drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    """Run folders and truth files with and without a road to the left, or an intersection."""
    return write_drives(tmp_path_factory.mktemp("drives"), [True, False, None] * 3)


def test_drive_is_divided_at_the_intersection(timed_drives: Drives) -> None:
    before, *after = annotated_drives(
        open_run(timed_drives[0][0]), read_scored_truth(timed_drives[1][0], "a"), Vehicle(version=1)
    )

    assert before.features == {"intersection": True, "left": True, "right": True, "straight": True}
    assert before.advanced_m[0] == 0.0
    assert before.counts["stop_sign"].max() == 1
    assert not any(one.features["intersection"] for one in after)


def test_fit_of_chains_writes_a_section_for_the_vehicle_file(
    timed_drives: Drives, tmp_path: Path
) -> None:
    runs, truths = timed_drives
    section = tmp_path / "temporal.toml"
    command = ["fit", "temporal", *map(str, runs), "--truth", *map(str, truths)]

    reported = json_of(*command, "-o", section)
    assert reported["runs"] == 9
    fusion = parse("version = 1\n" + section.read_text(), "car.toml").fusion
    assert fusion.kind == "combined"
    assert fusion.temporal is not None
    assert fusion.temporal.model_dump(mode="json") == reported["temporal"]
    assert fusion.combined is not None
    weights = fusion.combined.positive["intersection"]
    assert weights == pytest.approx(reported["combined"]["positive"]["intersection"], rel=1e-3)
    assert weights["stop_sign"] > 0.0


def test_threshold_for_a_rate_is_fitted_on_request(timed_drives: Drives, tmp_path: Path) -> None:
    runs, truths = timed_drives
    section = tmp_path / "fusion.toml"
    command = ["fit", "temporal", *map(str, runs), "--truth", *map(str, truths)]

    reported = json_of(*command, "--false-features", "0.1", "-o", section)
    fusion = parse("version = 1\n" + section.read_text(), "car.toml").fusion
    assert fusion.kind == "combined"
    assert fusion.established >= min(reported["threshold"]["threshold"], 0.9999)
    assert reported["threshold"]["false_features"] <= reported["threshold"]["wanted"] == 0.1
    assert crosscue([*command, "--false-features", "-1"]) == 2


def test_drives_are_grouped_by_place_as_in_scores(timed_drives: Drives, tmp_path: Path) -> None:
    """Positions within 50 m are one place, whatever the names of their intersections."""
    runs, truths = timed_drives
    placed = []
    for i, truth in enumerate(truths):
        north = ("52.0000", "52.0003", "52.1000")[i % 3]
        known = read_truth(truth).model_copy(update={"place": f"geo:{north},13.0"})
        folder = tmp_path / f"truth{i}"
        folder.mkdir()
        placed.append(str(save(known, folder)))

    assert json_of("fit", "temporal", *runs, "--truth", *placed)["places"] == 2
    messages = ["fit", "messages", *map(str, runs), "--truth", *placed]
    assert "too few to learn from" in refusal(1, *messages)
