"""The cue of a map: legs of the next intersection by the pose, and what may not judge it."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.fit.annotated_runs import read_annotated
from crosscue.replay.errors import UsageError
from support.kitti_drive import raw_drive
from support.refusals import refusal
from support.street_map import write_crossing, write_map

SPEED = '[topics]\nodometry = "oxts/ins_speed"\n'


def _replayed(folder: Path, setting: str) -> Path:
    """Replay 28 m of a drive toward a crossing with arms to the left and straight on."""
    (folder / "car.toml").write_text(f"version = 1\n{setting}\n{SPEED}")
    argv = ["replay", raw_drive(folder / "kitti"), "--vehicle", folder / "car.toml"]
    argv += ["--detectors", "support.detecting:Nothing", "--no-cache", "-q", "-o", folder / "run"]
    assert cli.run([str(one) for one in argv]) in (0, 3)
    return folder / "run"


def _counts(run: Path) -> dict[str, set[int]]:
    rows = pq.read_table(run / "cues.parquet", columns=["cue", "count"]).to_pylist()
    found: dict[str, set[int]] = {}
    for row in rows:
        if row["cue"].startswith("map_"):
            found.setdefault(row["cue"], set()).add(row["count"])
    return found


def test_legs_of_the_map_are_cues_that_open_an_approach(tmp_path: Path) -> None:
    write_crossing(tmp_path / "streets.osm")

    run = _replayed(tmp_path, 'road_map = "streets.osm"')

    assert _counts(run) == {"map_left": {1}, "map_straight": {1}, "map_right": {0}}
    last = pq.read_table(run / "belief.parquet").to_pylist()[-1]
    assert min(last["left"], last["straight"]) > 0.85
    assert last["right"] == 0.5


def test_without_a_map_there_is_no_such_cue(tmp_path: Path) -> None:
    assert not _counts(_replayed(tmp_path, ""))


def test_a_run_that_used_a_map_is_not_scored_by_truth_from_it(tmp_path: Path) -> None:
    streets = write_crossing(tmp_path / "streets.osm")
    other = tmp_path / "other.osm"
    other.write_text(streets.read_text() + "\n")
    run = _replayed(tmp_path, 'road_map = "streets.osm"')
    drive = tmp_path / "kitti"
    same = crosscue.truth_from_map(drive, streets, tmp_path / "same").path
    another = crosscue.truth_from_map(drive, other, tmp_path / "another").path

    said = refusal(2, "score", run, "--truth", same, "-o", tmp_path / "score")

    assert "its approaches are from the map that" in said
    assert not (tmp_path / "score").exists()
    with pytest.raises(UsageError, match="its approaches are from the map that"):
        read_annotated([run], [same], lambda *_: ())
    assert cli.run(["score", str(run), "--truth", str(another), "-q"]) in (0, 3)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ('road_map = "none.osm"', "none.osm: No such file"),
        ('road_map = "streets.osm"\n[gnss]\nuse = "off"', "road_map: the position on the map"),
    ],
)
def test_a_map_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, setting: str, said: str
) -> None:
    write_map(tmp_path / "streets.osm", {"a": (0.0, 0.0), "b": (9.0, 0.0)}, [("ab", "")])
    (tmp_path / "car.toml").write_text(f"version = 1\n{setting}\n{SPEED}")
    argv = ["replay", raw_drive(tmp_path / "kitti"), "--vehicle", tmp_path / "car.toml"]
    argv += ["--detectors", "support.detecting:Nothing", "--no-cache", "-o", tmp_path / "run"]

    assert said in refusal(4 if "none" in setting else 2, *argv)
