"""A run remembers with which truth it was scored; later commands need not be told."""

from pathlib import Path

import pytest

import crosscue
from crosscue.eval import cli, recording
from crosscue.eval.recording import view
from crosscue.replay.errors import SchemaError
from support.scene_run import scene_run
from support.scoring import truth_folder


@pytest.fixture
def scored(tmp_path: Path) -> tuple[Path, Path]:
    """Score a run with a truth that is not next to its log; return both."""
    run, truth = scene_run(tmp_path / "drive").path, truth_folder(tmp_path / "elsewhere")
    crosscue.score_run(run, truth)
    return run, truth


def test_failures_and_score_use_the_truth_of_the_last_score(scored: tuple[Path, Path]) -> None:
    run, truth = scored
    told = crosscue.failures(run, truth=truth).failures

    assert told
    assert crosscue.failures(run).failures == told
    assert crosscue.score_run(run).one.truth_path.samefile(truth)


def test_changed_truth_is_refused_until_the_run_is_scored_again(
    scored: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    run, truth = scored
    truth.write_text(truth.read_text().replace('"A"', '"B"'))

    assert cli.run(["failures", str(run)]) != 0
    printed = capsys.readouterr()
    assert "changed since" in printed.out + printed.err
    with pytest.raises(SchemaError, match="changed since"):
        view.save_recording(run, run / "drive.rrd")
    assert cli.run(["score", str(run), "-q"]) == 3
    assert crosscue.failures(run).failures


def test_truth_that_is_gone_counts_as_none(scored: tuple[Path, Path]) -> None:
    run, truth = scored
    truth.rename(truth.with_name("moved.json"))

    assert crosscue.failures(run).without_truth


def test_recording_draws_the_truth_of_the_last_score(
    scored: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[object] = []
    monkeypatch.setattr(recording, "save_rrd", lambda *given: drawn.append(given[3]))
    run, truth = scored

    view.save_recording(run, run / "told.rrd", truth)
    view.save_recording(run, run / "drive.rrd")
    truth.unlink()
    view.save_recording(run, run / "drive.rrd")

    assert [ranges is None for ranges in drawn] == [False, False, True]
