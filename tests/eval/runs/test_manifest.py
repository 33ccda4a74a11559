"""Files of a run folder: manifest, tags and what replaces them."""

import errno
import json
from pathlib import Path
from typing import Any

import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.batch.merge import gathered, merge_runs
from crosscue.eval.runs.account import account
from crosscue.eval.runs.folder import RunFolder, create, open_run, write_manifest
from crosscue.eval.runs.manifest import FORMAT_VERSION, Manifest, TimeSegments
from crosscue.replay.errors import OutputError, RunError, UnreadableRunError, UsageError
from crosscue.replay.files.whole_file import write_text, write_whole
from crosscue.replay.time.segments import Cause, Epoch, EpochMarks, LogClock, TimeSegment
from support.catalog_runs import add_run, runs_below
from support.commands import output_of
from support.manifests import detected, estimated, log_account
from support.refusals import refusal
from support.trees import tree

SET_BACK = TimeSegments(
    segments=(
        TimeSegment(0, 0, 1, 2, 1, 2, Cause.START),
        TimeSegment(1, 5, 5, 9, 3, 7, Cause.SET_BACK, None, -2, breaks_odometry=True),
    ),
    clocks=(LogClock((Epoch(0, 0), Epoch(5, 2)), {"/a": EpochMarks((3, None), (7,), ((1, 2),))}),),
    notices=("set back",),
)
RICH = detected("/cam", {"finder": "objects"}, time=SET_BACK)
LOST = account([log_account("a", "/t", used=7, skipped={"dull": 2}, dropped={"cut": 1})])


@pytest.mark.parametrize(
    "manifest",
    [estimated(), estimated(detect=RICH, account=LOST), RICH],
    ids=["bare", "rich", "detect"],
)
def test_manifest_is_read_back_unchanged(manifest: Manifest, tmp_path: Path) -> None:
    run = create(tmp_path / "run", overwrite=False)
    write_manifest(run, manifest)
    first = run.file("manifest.json").read_bytes()

    assert run.manifest() == manifest
    write_manifest(run, run.manifest())
    assert run.file("manifest.json").read_bytes() == first


@pytest.mark.parametrize("command", ["score", "estimate", "view"])
def test_single_drive_commands_refuse_merged_run_in_one_line(command: str, tmp_path: Path) -> None:
    merged = create(tmp_path / "merged", overwrite=False).path
    merge_runs({}, RunFolder(merged), {})

    assert "many drives" in refusal(1, command, merged)


@pytest.mark.parametrize(("text", "message"), [("{", "unreadable"), ("[1]", "format None")])
def test_manifest_that_is_no_object_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "manifest.json").write_text(text)

    with pytest.raises(RunError, match=message):
        open_run(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 2}, rf"format 2, this crosscue reads {FORMAT_VERSION}: replay again"),
        ({"format_version": None}, r"format None"),
        ({"stage": "dream"}, r"stage: .*'dream'.*replay again"),
        ({"settings": {"version": 1, "wings": 2}}, r"settings: wings: extra inputs.*replay again"),
        ({"notices": "none"}, r"notices: .*replay again"),
        ({"pose": {"rows": "7", "travelled_m": 0.0, "major_axis_m": None}}, r"pose\.rows: "),
        ({"colour": "red"}, r"colour: extra inputs are not permitted"),
    ],
)
def test_invalid_manifest_is_refused_in_one_line(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    run = create(tmp_path / "run", overwrite=False)
    write_manifest(run, estimated())
    path = run.file("manifest.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    with pytest.raises(RunError, match=message) as error:
        open_run(run.path)
    assert "\n" not in str(error.value)


def test_schema_of_the_truth_is_printed() -> None:
    assert json.loads(output_of("truth", "schema"))["title"] == "Truth"


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")

    def fail(partial: Path) -> None:
        partial.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="disk is full"):
        write_whole(tmp_path / "a.txt", fail)

    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two drives, each with two settings."""
    return runs_below(tmp_path / "fleet")


def test_tags_are_set_listed_and_removed(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monday, tuesday = str(runs / "a/monday"), str(runs / "a/tuesday")

    assert cli.run(["tag", monday, tuesday, "weather=rain", "route=5 = north", "--json"]) == 0
    both = {"weather": "rain", "route": "5 = north"}
    assert json.loads(capsys.readouterr().out) == {monday: both, tuesday: both}

    assert cli.run(["tag", monday, "weather=dry", "--remove", "route", "-q"]) == 0
    capsys.readouterr()
    assert output_of("tag", runs / "a").splitlines() == [
        f"{monday}  weather=dry",
        f"{tuesday}  route=5 = north weather=rain",
    ]


def test_copies_of_a_run_with_different_tags_are_not_merged(runs: Path) -> None:
    add_run(runs / "copy/monday", "monday")
    gathered([runs / "a", runs / "copy"])
    crosscue.tag_runs([runs / "copy/monday"], {"weather": "rain"})

    with pytest.raises(UsageError, match="one run with different tags"):
        gathered([runs / "a", runs / "copy"])


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["weather="], "weather=: expected KEY=VALUE"),
        (["1weather=rain"], "expected KEY=VALUE"),
        (["weather=a\nb"], "expected KEY=VALUE"),
        (["weather=rain", "weather=dry"], "weather: set twice"),
        (["weather=rain", "--remove", "weather"], "set twice, or set and removed"),
        (["--remove", "a b"], "a b: not a valid key of a tag"),
    ],
)
def test_invalid_tags_are_refused_without_changes(
    runs: Path, argv: list[str], message: str
) -> None:
    before = tree(runs)

    assert message in refusal(2, "tag", runs / "a", *argv)
    assert tree(runs) == before


def test_damaged_tags_are_reported_and_not_overwritten(runs: Path) -> None:
    path = runs / "a/monday/tags.json"
    path.write_text('{"format_version": 1, "tags": {"weather": 3}}')

    with pytest.raises(UnreadableRunError, match=r"tags\.json: unreadable"):
        crosscue.tag_runs([runs / "a"], {"weather": "rain"})

    assert "3" in path.read_text()
    assert not (runs / "a/tuesday/tags.json").exists()
    assert "tags.json: unreadable" in crosscue.catalog(runs).left_out["a/monday"]


def test_removing_the_last_tag_restores_the_run_folder(runs: Path) -> None:
    before = tree(runs / "a/monday")

    crosscue.tag_runs([runs / "a/monday"], {"weather": "rain"})
    assert tree(runs / "a/monday") != before
    crosscue.tag_runs([runs / "a/monday"], remove=["weather", "never_set"])

    assert tree(runs / "a/monday") == before
