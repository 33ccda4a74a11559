"""``check`` and ``score`` apply the same rule to a truth if a log's clock was set back."""

from pathlib import Path

import pytest

from crosscue.eval import cli
from support.gap_drive import Clock, replayed, write_drive


def _status_of_check(folder: Path, log: Path) -> int:
    return cli.run(["check", str(folder / "truth.json"), str(log)])


def _status_of_score(folder: Path, log: Path) -> int:
    run = replayed(folder, log)
    return cli.run(["score", str(run.path), "--truth", str(folder / "truth.json")])


@pytest.mark.slow
@pytest.mark.parametrize("by_s", [-7.0, -3600.0])
def test_truth_of_log_with_clock_set_back_is_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], by_s: float
) -> None:
    log = write_drive(tmp_path, Clock(set_at_s=6.0, by_s=by_s))

    assert _status_of_check(tmp_path, log) == 0
    # The approach and its stop sign end at 11.6 s, the log's own clock at 6 or 7.
    assert "outside    2 of them reach beyond the log" in capsys.readouterr().out
    assert _status_of_score(tmp_path, log) == 0
