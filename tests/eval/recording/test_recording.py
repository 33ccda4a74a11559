"""The recording of a run, read back from the file; it has no active content."""

from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr
from hypothesis import given, settings
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask
from crosscue.detectors.images import Encoded
from crosscue.eval import cli
from crosscue.eval.recording import save_rrd
from crosscue.eval.recording.camera import shown
from crosscue.eval.recording.columns import time_of
from crosscue.eval.recording.layout import ViewData, blueprint
from crosscue.eval.recording.marks import road_lines
from crosscue.eval.recording.notes import inert
from crosscue.eval.recording.plan import log_landmarks
from crosscue.eval.scoring.pose.truth_track import TruthTrack
from crosscue.replay.errors import LogError
from support.scene_run import FRAMES, LABEL, TOPIC, scene_run, write_pictures
from support.scoring import at, good_truth, truth_folder


def _rows(path: Path) -> Counter[str]:
    """Return the number of rows on the timeline by entity."""
    found: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            assert chunk.timeline_names == ["drive"]
            found[chunk.entity_path] += chunk.num_rows
    return found


def _cells(path: Path, entity: str, component: str) -> list[Any]:
    """Return the values of a component over time, one list for each row."""
    cells: list[Any] = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            name = next(n for n in batch.schema.names if n.endswith(component))
            cells += batch[name].to_pylist()
    return cells


def _saved_recording(tmp_path: Path, **more: Any) -> Path:
    run = scene_run(tmp_path / "drive", **more)
    track = TruthTrack(np.array([at(0), at(9)]), np.array([0.0, 9.0]), np.zeros(2))
    path = tmp_path / "drive.rrd"
    save_rrd(run, path, track, good_truth().ranges)
    return path


def test_each_frame_has_picture_marks_and_belief_on_the_timeline(
    tmp_path: Path,
) -> None:
    rows = _rows(_saved_recording(tmp_path))

    marks = (
        "picture",
        "objects",
        "far_objects",
        "outlines",
        "sign_windows",
        "road",
        "regions",
        "cars",
    )
    for name in marks:
        assert rows[f"/camera/{name}"] == FRAMES
    for name in ("intersection", "band", "mobileye_objects", "mobileye_lanes"):
        assert rows[f"/ahead/{name}"] == FRAMES
    for name in ("intersection", "left", "right", "straight"):
        assert rows[f"/plots/belief/{name}"] == FRAMES
    assert rows["/plots/range/start"] == 45 - 8
    assert rows["/plan/intersection"] == FRAMES
    assert rows["/plan/true_car"] == 2


def test_cue_state_changes_with_its_frames(tmp_path: Path) -> None:
    path = _saved_recording(tmp_path)

    states = _cells(path, "/cues/road_left", "state")
    assert states == [None, ["found"], None] or states == [[], ["found"], []]
    # Not found, found in the last frames, and not found after the last one.
    assert _rows(path)["/cues/cross_traffic_right"] == 3


def test_arrows_follow_a_crossing_car(tmp_path: Path) -> None:
    path = _saved_recording(tmp_path)

    vectors = _cells(path, "/camera/cars", "vectors")
    assert [len(one or []) for one in vectors] == [0] + [1] * (FRAMES - 1)
    assert all(one[0][0] > 0.0 == one[0][1] for one in vectors[1:])


def test_labels_are_plain_text_and_entity_paths_are_fixed(tmp_path: Path) -> None:
    path = _saved_recording(tmp_path)

    labels = _cells(path, "/camera/objects", "labels")
    assert labels[0][-1] == f"{LABEL} 0.50"
    assert {entity.split("/")[1] for entity in _rows(path)} == {
        "ahead",
        "camera",
        "cues",
        "plan",
        "plots",
    }
    assert inert("[a](http://b) <i>") == r"\[a\]\(http\:\/\/b\) \<i\>"


@pytest.mark.parametrize(
    "without",
    [
        frozenset({"pose"}),
        frozenset({"belief", "range"}),
        frozenset({"cues", "belief", "range"}),
        frozenset({"frames", "detections", "road", "cues", "belief", "range"}),
    ],
)
def test_run_without_some_tables_records_the_others(
    tmp_path: Path, without: frozenset[str]
) -> None:
    rows = _rows(_saved_recording(tmp_path, without=without))

    assert rows["/camera/picture"] == FRAMES
    assert ("/plan/car" in rows) == ("pose" not in without)
    assert ("/plots/belief/left" in rows) == ("belief" not in without)
    assert ("/camera/objects" in rows) == ("frames" not in without)


def test_recording_is_little_larger_than_its_pictures(tmp_path: Path) -> None:
    bytes_ = write_pictures(tmp_path / "pictures.mcap")
    size = _saved_recording(tmp_path).stat().st_size

    assert bytes_ < size < 1.05 * bytes_ + 300_000


def test_unsupported_picture_encodings_become_jpeg() -> None:
    pixels = np.full((20, 30, 3), (10, 200, 30), np.uint8)
    layout = (30, 20, 90, "bgr8")

    jpeg = shown(Encoded("raw", memoryview(pixels.tobytes()), layout))

    again = cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1)
    assert again is not None
    assert np.abs(again.astype(int) - pixels).max() < 12
    with pytest.raises(LogError, match="fewer bytes"):
        shown(Encoded("raw", memoryview(b"too short"), layout))


def test_view_refuses_to_replace_another_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    letter = tmp_path / "letter.md"
    letter.write_text("keep me")

    assert cli.run(["view", str(tmp_path), "-o", str(letter)]) == 2

    assert "letter.md: expected a name that ends in .rrd" in capsys.readouterr().err
    assert letter.read_text() == "keep me"


def test_view_accepts_truth_without_a_track(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = scene_run(tmp_path / "drive")
    truth = truth_folder(tmp_path / "truth")
    out = tmp_path / "out.rrd"

    assert cli.run(["view", str(run.path), "-o", str(out), "--truth", str(truth)]) == 3
    assert capsys.readouterr().out == f"{out}\n"
    rows = _rows(out)
    assert rows["/plots/range/true_start"] == rows["/plots/range/true_end"] == 40
    assert "/plan/true_car" not in rows


def test_layout_has_views_for_available_data() -> None:
    pose = {name: np.array([0.0, 1.0]) for name in ("x_m", "y_m")}
    complete = blueprint(ViewData(TOPIC, pose, has_truth=True, has_scene=True))
    bare = blueprint(ViewData(None, None, has_truth=False, has_scene=True))
    alone = blueprint(ViewData(None, pose, has_truth=False, has_scene=False))

    counted = [len(list(_views(one.root_container))) for one in (complete, bare, alone)]
    assert counted == [11, 5, 6]


def _views(part: Any) -> Any:
    for one in getattr(part, "contents", None) or []:
        if hasattr(one, "contents") and not hasattr(one, "origin"):
            yield from _views(one)
        else:
            yield one


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 30), st.integers(0, 20), st.integers(3, 30), st.integers(3, 20))
def test_outline_follows_the_border_of_the_mask(x: int, y: int, width: int, height: int) -> None:
    mask = rle.encode_mask(np.ones((height, width), np.bool_), (x, y), (64, 48))
    box = np.array([x, y, x + width, y + height], np.float64)

    (line,) = rle.outline(mask, (64, 48), box)

    assert (line[0] == line[-1]).all()
    assert line.min(axis=0).tolist() == [x + 0.5, y + 0.5]
    assert line.max(axis=0).tolist() == [x + width - 0.5, y + height - 0.5]


def test_road_lines_are_in_picture_pixels() -> None:
    mask = rle.encode_mask(np.ones((4, 8), np.bool_), (0, 5), (8, 9))

    lines = road_lines(RoadMask(0, (80, 90), mask, (8, 9)))

    everything = np.vstack(lines)
    assert everything.min() >= 0.0
    assert everything[:, 0].max() <= 80.0
    assert everything[:, 1].min() == pytest.approx(55.0)


def test_time_since_boot_is_shown_as_a_duration() -> None:
    assert not time_of(5).is_date
    assert time_of(1_700_000_000_000_000_000).is_date


def test_used_landmarks_are_labelled_on_the_map(tmp_path: Path) -> None:
    path = tmp_path / "landmarks.rrd"
    recording = rr.RecordingStream("test")
    recording.save(path)
    pose = {"x_m": np.array([0.0, 5.0, 9.0]), "y_m": np.array([1.0, 1.0, 2.0])}
    log_landmarks(recording, pose, [None, "wall 1", None])
    recording.flush()
    recording.disconnect()

    found = [
        chunk.to_record_batch().to_pydict()
        for chunk in RrdReader(path).stream()
        if chunk.entity_path == "/plan/landmarks"
    ]
    assert "wall 1" in str(found)
