"""Rows that are not scored because their log time occurs twice are counted separately."""

import json
from pathlib import Path

import numpy as np

from crosscue.eval.drives.score import ScoringSettings
from crosscue.eval.report.summary import pose_summary, scores_text
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.log_time import ambiguous
from crosscue.eval.scoring.columns import AMBIGUOUS
from crosscue.eval.scoring.runs import pooled_scores
from support.gap_drive import Clock, replayed, write_drive


def _ambiguous_rows(run: RunFolder, name: str) -> int:
    """Return the number of rows whose stamp also occurs in the other segment."""
    timeline = run.drive_manifest().timeline
    table = run.table(name)
    log_ns, numbers = table["log_t_ns"].to_numpy(), table["segment"].to_numpy().astype(np.int64)
    return int(ambiguous(timeline, log_ns, numbers).sum())


def test_rows_with_repeated_log_time_are_counted_in_all_scores(tmp_path: Path) -> None:
    run = replayed(tmp_path, write_drive(tmp_path, Clock(set_at_s=6, by_s=-3)))
    frames, belief, ranges = (_ambiguous_rows(run, name) for name in ("frames", "belief", "range"))
    assert min(frames, belief, ranges) > 0

    scored = ScoringSettings(tmp_path / "truth.json")(run.path)

    metrics = json.loads(run.file("score/metrics.json").read_text())
    assert metrics["coverage"]["frames"] == run.table("frames").num_rows
    assert metrics["coverage"]["frames_ambiguous"] == frames
    for cue in metrics["cues"].values():
        for judged in cue["readings"].values():
            assert judged["left_out"][AMBIGUOUS] == frames
            assert judged["frames"] == judged["scored"] + sum(judged["left_out"].values())
    for one in metrics["belief"].values():
        assert one["left_out"][AMBIGUOUS] == belief
        assert one["steps"] >= run.table("belief").num_rows
    reported = [one["left_out"].get(AMBIGUOUS, 0) for one in metrics["range"].values()]
    assert sum(reported) == ranges
    pose = metrics["pose"]["coverage"]
    assert pose["ambiguous"] > 0
    assert metrics["account"]["scoring"]["poses"]["skipped"][AMBIGUOUS] == pose["ambiguous"]
    parts = ("scored", "before_estimate", "after_estimate", "in_gap", "ambiguous")
    assert pose["truth_poses"] == sum(pose[part] for part in parts)
    printed = scores_text(pooled_scores([scored.one]))
    assert f"ambiguous  {frames} frames not scored" in printed
    assert scored.one.pose is not None
    assert f"{pose['ambiguous']} whose log time comes twice" in pose_summary(scored.one.pose)
    page = scored.report.read_text()
    assert metrics["account"]["scoring"]
    for name, one in metrics["account"]["scoring"].items():
        row = f'<td>scoring</td><td class="text">{name}</td><td>{one["in"]}</td><td>{one["used"]}'
        assert row in page
        assert one["in"] == one["used"] + sum(one["skipped"].values())
    assert f"<b>Ambiguous:</b> {frames} frames" in page
    assert f"{pose['ambiguous']} lie at moments that come twice" in page
