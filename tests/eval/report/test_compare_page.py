"""Page of a comparison: verdicts, and pictures of what two runs of one drive found differently."""

import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.fleet.compare_page import differences_of
from crosscue.eval.runs.folder import open_run
from support.refusals import refusal
from support.scene_run import scene_run
from support.scoring import CUES, at, cue_table, truth_folder


@pytest.fixture
def sides(tmp_path: Path) -> tuple[Path, Path]:
    """Write two scored runs of one drive; the second finds the stop sign for ten frames less."""
    before, after = scene_run(tmp_path / "a").path, scene_run(tmp_path / "b").path
    later = {**CUES, "stop_sign": {frame: int(frame >= 20) for frame in range(40)}}
    pq.write_table(cue_table(later), after / "cues.parquet", write_page_checksum=True)
    truth = truth_folder(tmp_path / "truth")
    for run in (before, after):
        crosscue.score_run(run, truth)
    return before, after


def test_frames_in_which_runs_differ_are_found(sides: tuple[Path, Path]) -> None:
    (one,) = differences_of(*(open_run(path) for path in sides))

    assert (one.text, one.frames, one.t_ns) == ("stop sign found only before", 10, at(15))
    assert list(differences_of(open_run(sides[0]), open_run(sides[0]))) == []


def test_compare_writes_a_page_with_pairs_of_pictures(
    sides: tuple[Path, Path], tmp_path: Path
) -> None:
    page = tmp_path / "compare.html"
    words = ["compare", *map(str, sides), "-o", str(page)]

    assert cli.run(words) in (0, 1, 3)
    text = page.read_text(encoding="utf-8")
    assert re.search(r'class="told">.*at too few places to decide', text)
    assert "stop sign found only before</b>, in 10 frames together" in text
    assert len(re.findall(r'src="data:image/jpeg;base64,[^"]{200,}"', text)) == 2
    for run in sides:
        assert f"<code>crosscue view {run} --at 1.500</code>" in text
    assert page.stat().st_size < 3_000_000
    assert "exists; give another name or --overwrite" in refusal(1, *words)
    assert cli.run([*words, "--overwrite"]) in (0, 1, 3)
