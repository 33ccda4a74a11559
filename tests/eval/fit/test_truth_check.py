"""``check`` and ``score`` apply the same rule to a truth if a log's clock was set back."""

from pathlib import Path

import pytest

from support.commands import output_of
from support.gap_drive import Clock, replayed, write_drive


@pytest.mark.slow
@pytest.mark.parametrize("by_s", [-7.0, -3600.0])
def test_truth_of_log_with_clock_set_back_is_accepted(tmp_path: Path, by_s: float) -> None:
    log, truth = write_drive(tmp_path, Clock(set_at_s=6.0, by_s=by_s)), tmp_path / "truth.json"

    # The approach and its stop sign end at 11.6 s, the log's own clock at 6 or 7.
    assert "outside    2 of them reach beyond the log" in output_of("check", truth, log)
    output_of("score", replayed(tmp_path, log).path, "--truth", truth)
