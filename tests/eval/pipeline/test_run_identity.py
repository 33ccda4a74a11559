"""Runs record their inputs: no other run overwrites them, and merging keeps all of them."""

import json
import shutil
from dataclasses import fields, replace
from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.detectors.base import DetectorChoice
from crosscue.eval.cli import run
from crosscue.eval.pipeline.detecting import Detecting
from crosscue.eval.runs.manifest import FORMAT_VERSION
from crosscue.replay.files.log_identity import of_row
from support.refusals import refusal
from support.trees import contents, tree

pytestmark = pytest.mark.slow

DRIVES: int = 4
REFUSAL: str = f"format 1, this crosscue reads {FORMAT_VERSION}: replay again"


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Some short drives, one of which is not a recording."""
    folder = tmp_path_factory.mktemp("place") / "drives"
    for i in range(DRIVES):
        write_drive(folder / f"D-{i}", DriveSettings(seed=i, blocks=2, block_m=40.0))
    (folder / "D-3" / "drive.mcap").write_bytes(b"junk")
    return folder


def _replay(place: Path | str, out: Path, *more: str) -> int:
    return run(["replay", str(place), "-o", str(out), "-q", *more])


def test_resume_with_another_log_or_setting_is_refused_and_changes_nothing(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    keep = tmp_path / "keep"
    assert _replay(drives / "D-0", keep) == 0
    before, replayed = contents(keep), tree(keep)
    theirs = of_row(json.loads((keep / "input.json").read_text())["identity"])

    message = refusal(2, "replay", drives / "D-1", "-o", keep, "-q", "--resume")
    assert theirs.short in message
    assert "drive.mcap" in message
    assert contents(keep) == before

    assert _replay(drives / "D-0", keep, "--resume", "--to", "2") == 2
    assert "selection.end_ns: null there, " in capsys.readouterr().err
    assert contents(keep) == before

    assert _replay(drives / "D-0", keep, "--resume") == 0
    assert tree(keep) == replayed
    (keep / "input.json").unlink()
    assert _replay(drives / "D-1", keep, "--resume") == 2
    assert "without input.json" in capsys.readouterr().err


def test_run_of_older_format_is_refused(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = tmp_path / "old" / "manifest.json"
    manifest.parent.mkdir()
    manifest.write_text('{"format_version": 1}')

    for argv in (
        ["estimate", "old"],
        ["view", "old", "-o", "x.rrd"],
        ["score", "old"],
        ["merge", "old", "-o", "all"],
    ):
        argv = [str(tmp_path / word) if word in ("old", "all") else word for word in argv]
        assert REFUSAL in refusal(4, *argv)
    assert _replay(drives / "D-0", manifest.parent, "--resume") == 4
    assert REFUSAL in capsys.readouterr().err


def test_moved_logs_are_accepted_and_changed_logs_refused(drives: Path, tmp_path: Path) -> None:
    place = tmp_path / "one"
    shutil.copytree(drives / "D-0", place / "drive")
    assert _replay(place / "drive", place / "run") == 0
    vehicle = str(drives / "D-0" / "vehicle.toml")
    estimate = ["estimate", str(place / "run"), "--vehicle", vehicle, "-q"]
    assert run(estimate) == 0

    # If run and logs move together, no option is needed.
    (tmp_path / "one").rename(tmp_path / "two")
    estimate[1] = str(tmp_path / "two" / "run")
    assert run(estimate) == 0
    log = tmp_path / "two" / "drive" / "drive.mcap"
    moved = tmp_path / "elsewhere" / "deep" / "drive.mcap"
    moved.parent.mkdir(parents=True)
    log.rename(moved)
    assert "is gone; name its folder with --logs DIR" in refusal(4, *estimate)
    shutil.copy(drives / "D-1" / "drive.mcap", log)
    assert "has changed since" in refusal(4, *estimate)
    assert run([*estimate, "--logs", str(drives / "D-1")]) == 4
    assert run([*estimate, "--logs", str(tmp_path / "elsewhere")]) == 0


def test_every_option_that_detects_differently_is_among_the_inputs_of_a_run() -> None:
    """A resumed run compares them, so that a forgotten one would keep stale detections."""
    plain = Detecting(())
    changed = {
        "choices": replace(plain, choices=(DetectorChoice("lamp", "lamp"),)),
        "draw": replace(plain, draw=3),
    }

    assert changed.keys() == {one.name for one in fields(Detecting) if one.compare}
    assert all(one.as_json() != plain.as_json() for one in changed.values())
