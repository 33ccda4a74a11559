"""Pictures to train on by the public interface, as the command makes them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import crosscue
from crosscue.eval.cli import run


def test_training_frames_are_those_of_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[tuple[int, int]] = []

    found = crosscue.render_training_frames(
        tmp_path / "a",
        ["L400-L401"],
        per_layout=1,
        width_px=64,
        on_runs=lambda done, of: seen.append((done, of)),
    )
    line = ["train", "frames", "L400-L401", "--per-layout", "1", "--width", "64"]
    assert run([*line, "-o", str(tmp_path / "b"), "--json"]) == 0

    assert seen == [(1, 2), (2, 2)]
    assert json.loads(capsys.readouterr().out) == found.as_dict() | {
        "coco": str(tmp_path / "b" / "coco.json")
    }
    made = [sorted((tmp_path / name).rglob("*.*")) for name in "ab"]
    assert [one.read_bytes() for one in made[0]] == [one.read_bytes() for one in made[1]]
    assert len(made[0]) == 1 + found.pictures == 3
    with pytest.raises(crosscue.UsageError, match="only for scoring"):
        crosscue.render_training_frames(tmp_path / "c", ["A"])


def test_a_study_of_intersections_refuses_layouts_that_are_not_scored() -> None:
    with pytest.raises(crosscue.UsageError, match="expected some of A to H"):
        crosscue.IntersectionStudy(layouts=("L1",))
