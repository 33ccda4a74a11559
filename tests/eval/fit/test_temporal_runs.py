"""The fit of the belief over time from run folders and truth files, up to the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crosscue.datasets.truth.truth import read_truth, save
from crosscue.eval.cli import run as crosscue
from crosscue.eval.fit.annotated_runs import annotated_drives
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.truth import read_scored_truth
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.fusion_runs import made_up_drive, write_empty_truth, write_run, write_truth

Drives = tuple[list[Path], list[Path]]


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Drives:
    """Run folders and truth files with and without a road to the left, or an intersection."""
    folder = tmp_path_factory.mktemp("drives")
    rng = np.random.default_rng(4)
    runs, truths = [], []
    for i in range(9):
        left, is_empty = i % 3 == 0, i % 3 == 2
        evidence = made_up_drive(rng, left=left, signed=not is_empty)
        run = write_run(folder / f"run{i}", evidence).path
        frames = pa.table({"t_ns": [one.t_ns for one in evidence]})
        pq.write_table(frames, run / "frames.parquet", write_page_checksum=True)
        runs.append(run)
        truth = folder / f"truth{i}"
        truths.append(write_empty_truth(truth) if is_empty else write_truth(truth, left=left))
    return runs, truths


def test_drive_is_divided_at_the_intersection(drives: Drives) -> None:
    before, *after = annotated_drives(
        open_run(drives[0][0]), read_scored_truth(drives[1][0], "a"), Vehicle(version=1)
    )

    assert before.features == {"intersection": True, "left": True, "right": True, "straight": True}
    assert before.advanced_m[0] == 0.0
    assert before.counts["stop_sign"].max() == 1
    assert not any(one.features["intersection"] for one in after)


def test_command_writes_a_section_for_the_vehicle_file(
    drives: Drives, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, truths = drives
    section = tmp_path / "temporal.toml"
    command = ["fit", "temporal", *map(str, runs), "--truth", *map(str, truths)]

    assert crosscue([*command, "-o", str(section), "--json"]) == 0

    reported = json.loads(capsys.readouterr().out)
    assert reported["runs"] == 9
    text = "version = 1\n[fusion]\nkind = 'temporal'\n" + section.read_text()
    learned = parse(text, "car.toml").fusion.temporal
    assert learned is not None
    assert learned.model_dump(mode="json") == reported["temporal"]


def test_threshold_for_a_rate_is_fitted_on_request(
    drives: Drives, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs, truths = drives
    section = tmp_path / "fusion.toml"
    command = ["fit", "temporal", *map(str, runs), "--truth", *map(str, truths)]

    assert crosscue([*command, "--false-features", "0.1", "-o", str(section), "--json"]) == 0

    reported = json.loads(capsys.readouterr().out)
    fusion = parse("version = 1\n" + section.read_text(), "car.toml").fusion
    assert fusion.kind == "temporal"
    assert fusion.established >= min(reported["threshold"]["threshold"], 0.9999)
    assert reported["threshold"]["false_features"] <= reported["threshold"]["wanted"] == 0.1
    assert crosscue([*command, "--false-features", "-1"]) == 2


def test_drives_are_grouped_by_place_as_in_scores(
    drives: Drives, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Positions within 50 m are one place, whatever the names of their intersections."""
    runs, truths = drives
    placed = []
    for i, truth in enumerate(truths):
        north = ("52.0000", "52.0003", "52.1000")[i % 3]
        known = read_truth(truth).model_copy(update={"place": f"geo:{north},13.0"})
        folder = tmp_path / f"truth{i}"
        folder.mkdir()
        placed.append(str(save(known, folder)))

    assert crosscue(["fit", "temporal", *map(str, runs), "--truth", *placed, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["places"] == 2
    messages = ["fit", "messages", *map(str, runs), "--truth", *placed]
    assert crosscue(messages) == 1
    assert "too few to learn from" in capsys.readouterr().err
