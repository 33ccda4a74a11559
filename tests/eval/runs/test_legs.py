"""Roads of an intersection in a run's pictures: believed, or not seen with the reason."""

from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from crosscue.detectors.cues.candidates import REGION_NOT_SEEN
from crosscue.eval.pipeline.scene.looked_for import NO_ROAD
from crosscue.eval.recording import save_rrd
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.eval.report.page import write_report_without_truth
from crosscue.eval.runs.candidates import CandidateRow
from crosscue.eval.runs.folder import RunFolder, write_manifest
from crosscue.eval.runs.legs import leg_texts
from crosscue.eval.runs.manifest import SceneSummary
from support.manifests import estimate_manifest
from support.recordings import cells
from support.scene_run import FRAMES, scene_run
from support.scoring import at

HIDDEN = CandidateRow(
    unit="frames",
    setting=None,
    threshold=None,
    seen=50,
    used=0,
    skipped={"too little road": 1, REGION_NOT_SEEN: 49},
    max_score=None,
)


def run_without_road(tmp_path: Path, without: frozenset[str] = frozenset()) -> RunFolder:
    """The made-up drive, whose road to the left nobody looked for; the others were hidden."""
    run = scene_run(tmp_path / "drive", without=without)
    scene = SceneSummary(
        frames=FRAMES,
        positive={},
        counts={},
        without_odometry=0,
        approaches=(),
        candidates={"road_right": HIDDEN, "road_straight": HIDDEN},
        not_looked_for={"road_left": NO_ROAD},
        ranged={},
    )
    write_manifest(run, estimate_manifest(run).model_copy(update={"scene": scene}))
    return run


def test_each_frame_says_which_roads_are_believed_and_why_the_others_are_not_seen(
    tmp_path: Path,
) -> None:
    texts = leg_texts(run_without_road(tmp_path))

    why = "hidden, too far, or never in view"
    assert texts[at(5)] == (
        "intersection 0.50",
        f"left not seen: {NO_ROAD}",
        f"right, straight not seen: {why}",
    )
    assert texts[at(21)] == (
        "intersection 0.95, left 0.97",
        f"right, straight not seen: {why}",
    )
    assert texts[at(35)] == ("intersection 0.95, left 0.97, right 0.92, straight 0.20",)


@pytest.mark.parametrize("without", ["belief", "scene"])
def test_run_without_beliefs_says_nothing_about_roads(tmp_path: Path, without: str) -> None:
    if without == "scene":
        assert leg_texts(scene_run(tmp_path / "drive")) == {}
    else:
        assert leg_texts(run_without_road(tmp_path, frozenset({without}))) == {}


def test_a_road_without_a_column_in_the_beliefs_is_left_out(tmp_path: Path) -> None:
    run = run_without_road(tmp_path)
    path = run.file("belief.parquet")
    pq.write_table(pq.read_table(path).drop_columns(["right"]), path)

    assert leg_texts(run)[at(21)] == (
        "intersection 0.95, left 0.97",
        "straight not seen: hidden, too far, or never in view",
    )


def test_recording_writes_them_at_the_top_of_the_picture(tmp_path: Path) -> None:
    run = run_without_road(tmp_path)
    save_rrd(run, tmp_path / "drive.rrd")

    labels = dict(cells(tmp_path / "drive.rrd", "/camera/legs", "labels"))
    assert labels[at(21)] == ["\n".join(leg_texts(run)[at(21)])]
    assert len(labels) == FRAMES


def test_pictures_of_a_report_have_them_at_the_top(tmp_path: Path) -> None:
    drawn = []
    for run in (run_without_road(tmp_path / "with"), scene_run(tmp_path / "none")):
        assert not draw_pictures(run, [at(21)], lambda _, jpeg, __: drawn.append(jpeg))

    with_text, without = (
        np.asarray(cv2.imdecode(np.frombuffer(one, np.uint8), 0), np.int16) for one in drawn
    )
    apart = np.abs(with_text - without).max(axis=1) > 60
    assert apart[: len(apart) // 3].any()
    assert not apart[len(apart) // 2 :].any()


def test_report_writes_the_reasons_below_its_pictures(tmp_path: Path) -> None:
    run = run_without_road(tmp_path)
    (tmp_path / "page").mkdir()
    write_report_without_truth(run, tmp_path / "page" / "report.html", 0.9)

    page = (tmp_path / "page" / "report.html").read_text(encoding="utf-8")
    captions = page.split("<figcaption>")[1:]
    (first,) = (one for one in captions if "<b>intersection believed" in one)
    assert f"left not seen: {NO_ROAD}<br>right, straight not seen: hidden" in first
