"""Tags of runs: they are stored apart from the run's inputs and results."""

import json
from pathlib import Path

import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.batch.merge import gathered
from crosscue.replay.errors import UnreadableRunError, UsageError
from support.catalog_runs import add_run, runs_below
from support.refusals import refusal
from support.trees import tree


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
    assert cli.run(["tag", str(runs / "a")]) == 0
    assert capsys.readouterr().out.splitlines() == [
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
