"""The recording of a run: what each frame shows, its parts and its marks."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import rerun as rr
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rerun.chunk import RrdReader

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.cues.tracked.motion import CarMotion
from crosscue.detectors.images import Encoded
from crosscue.eval.recording import save_rrd
from crosscue.eval.recording.anchored import motion_px
from crosscue.eval.recording.camera import shown
from crosscue.eval.recording.marks import Overlays, label_places, labelled
from crosscue.eval.recording.notes import inert
from crosscue.eval.recording.plan import log_landmarks
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import run_between
from crosscue.eval.scoring.pose.truth_track import TruthTrack
from crosscue.replay.colours import QUIET, TRUTH
from crosscue.replay.errors import LogError, UsageError
from crosscue.replay.vehicle.vehicle import Camera, Vehicle
from support.recordings import cells
from support.refusals import refusal
from support.scene_run import FRAMES, LABEL, scene_run
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
    return [value for _, value in cells(path, entity, component)]


def _saved_recording(tmp_path: Path, **more: Any) -> Path:
    run = scene_run(tmp_path / "drive", **more)
    track = TruthTrack(np.array([at(0), at(9)]), np.array([0.0, 9.0]), np.zeros(2))
    path = tmp_path / "drive.rrd"
    save_rrd(run, path, track, good_truth().ranges)
    return path


def test_each_frame_has_picture_marks_and_belief_on_the_timeline(tmp_path: Path) -> None:
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


def test_labels_are_plain_text_and_entity_paths_are_fixed(tmp_path: Path) -> None:
    path = _saved_recording(tmp_path)

    labels = _cells(path, "/camera/far_objects", "labels")
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


def test_labelled_boxes_are_drawn_beside_detections_in_the_colour_of_the_truth(
    tmp_path: Path,
) -> None:
    run = scene_run(tmp_path / "drive")
    folder = truth_folder(tmp_path / "truth").parent
    labelled = {at(3): [(4.0, 5.0, 20.0, 15.0)], at(4): []}
    categories = [{"id": 1, "name": "stop sign"}]
    images = [
        {"id": i, "file_name": f"{i}.jpg", "width": 64, "height": 48, "t_ns": t}
        for i, t in enumerate(labelled)
    ]
    boxes = [
        {"id": i, "image_id": i, "category_id": 1, "bbox": [x0, y0, x1 - x0, y1 - y0]}
        for i, found in enumerate(labelled.values())
        for x0, y0, x1, y1 in found
    ]
    tree = {"categories": categories, "images": images, "annotations": boxes}
    (folder / "objects.json").write_text(json.dumps(tree))
    written = json.loads((folder / "truth.json").read_text()) | {"objects": "objects.json"}
    (folder / "truth.json").write_text(json.dumps(written))

    path = crosscue.save_recording(run.path, tmp_path / "a.rrd", folder / "truth.json")

    assert _rows(path)["/camera/truth"] == FRAMES
    labels = _cells(path, "/camera/truth", "labels")
    assert [row for row in labels if row] == [["true: stop sign"]]
    assert labels.index(["true: stop sign"]) == 3
    (colour,) = next(row for row in _cells(path, "/camera/truth", "colors") if row)
    assert colour == (TRUTH[0] << 24 | TRUTH[1] << 16 | TRUTH[2] << 8 | 255)
    crosscue.save_recording(run.path, tmp_path / "b.rrd")
    assert "/camera/truth" not in _rows(tmp_path / "b.rrd")


def test_unsupported_picture_encodings_become_jpeg() -> None:
    pixels = np.full((20, 30, 3), (10, 200, 30), np.uint8)
    layout = (30, 20, 90, "bgr8")

    jpeg = shown(Encoded("raw", memoryview(pixels.tobytes()), layout))

    again = cv2.imdecode(np.frombuffer(jpeg, np.uint8), 1)
    assert again is not None
    assert np.abs(again.astype(int) - pixels).max() < 12
    with pytest.raises(LogError, match="fewer bytes"):
        shown(Encoded("raw", memoryview(b"too short"), layout))


@settings(max_examples=30)
@given(st.integers(0, 30), st.integers(0, 20), st.integers(3, 30), st.integers(3, 20))
def test_outline_follows_the_border_of_the_mask(x: int, y: int, width: int, height: int) -> None:
    mask = rle.encode_mask(np.ones((height, width), np.bool_), (x, y), (64, 48))
    box = np.array([x, y, x + width, y + height], np.float64)

    (line,) = rle.outline(mask, (64, 48), box)

    assert (line[0] == line[-1]).all()
    assert line.min(axis=0).tolist() == [x + 0.5, y + 0.5]
    assert line.max(axis=0).tolist() == [x + width - 0.5, y + height - 0.5]


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


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return scene_run(tmp_path_factory.mktemp("part"))


def test_tables_of_a_part_have_only_its_rows_and_selected_columns(run: RunFolder) -> None:
    part = run_between(run, at(10), at(19))

    assert part.table("frames")["t_ns"].to_pylist() == [at(frame) for frame in range(10, 20)]
    assert part.table("frames", ["frame"]).column_names == ["frame"]
    assert sum(len(batch) for batch in part.batches("detections", ["label"])) == 2 * 10


def test_moment_in_nanoseconds_yields_the_same_recording(run: RunFolder, tmp_path: Path) -> None:
    rows = [
        sum(
            chunk.num_rows
            for chunk in RrdReader(
                crosscue.save_recording(run.path, tmp_path / name, at=moment)
            ).stream()
        )
        for name, moment in (("a.rrd", 3.0), ("b.rrd", f"{at(30)}ns"))
    ]

    assert rows[0] == rows[1]


def test_approach_is_recorded_from_its_first_step_to_its_last(tmp_path: Path) -> None:
    run = scene_run(tmp_path / "drive")
    belief = run.table("belief")
    column = belief.schema.get_field_index("approach")
    numbers = [7 if 10 <= frame < 30 else None for frame in range(len(belief))]
    numbers = pa.array(numbers, belief.schema.field("approach").type)
    pq.write_table(belief.set_column(column, "approach", numbers), run.file("belief.parquet"))

    path = crosscue.save_recording(run.path, tmp_path / "a.rrd", approach=7, only=("belief",))

    times: set[int] = set()
    for chunk in RrdReader(path).stream():
        if not chunk.is_static:
            times.update(chunk.to_record_batch().column("drive").cast("int64").to_pylist())
    assert times == {at(frame) for frame in range(10, 30)}
    with pytest.raises(UsageError, match="it has: 7"):
        crosscue.save_recording(run.path, tmp_path / "none.rrd", approach=8)


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ("--at 99", "lasts from 0 to 4.9"),
        ("--at noon", "expected seconds"),
        ("--at nan", "expected seconds"),
        ("--at 1 --approach 7", "not allowed"),
        ("--only sky,sun", "--only sky,sun: expected some of cameras"),
    ],
)
def test_invalid_part_options_are_refused_in_one_line(
    run: RunFolder, tmp_path: Path, flags: str, named: str
) -> None:
    output = tmp_path / "x.rrd"

    assert named in refusal(2, "view", run.path, "-o", output, *flags.split())
    assert not output.exists()


SIZE = (1280, 720)
CAMERA = Camera(x_m=1.7, z_m=1.4, focal_px=700.0, center_px=(640.0, 360.0))
BOX = (700.0, 380.0, 740.0, 400.0)


def car(right_mps: float, ahead_mps: float) -> CarMotion:
    """A car below and to the right of the optical axis, 40 m away."""
    seen = CarMotion(1, 10, 40.0, 0.1, right_mps, 0.1, ahead_mps, 0.1, True, 2.0, 0.0)
    return seen._replace(box_px=BOX)


def test_oncoming_car_moves_from_the_optical_axis_and_outgoing_towards_it() -> None:
    assert (motion_px(car(0.0, -10.0), CAMERA, SIZE) > 0.0).all()
    assert (motion_px(car(0.0, 10.0), CAMERA, SIZE) < 0.0).all()


def test_arrow_of_crossing_car_equals_pinhole_projection() -> None:
    np.testing.assert_allclose(motion_px(car(8.0, 0.0), CAMERA, SIZE), [700.0 * 8.0 / 40.0, 0.0])


def test_boxes_at_one_place_get_one_label_and_the_surest_keeps_it(tmp_path: Path) -> None:
    run = scene_run(tmp_path / "drive")
    table = run.table("detections")
    cars = table.filter(pc.equal(table["label"], "car"))
    twins = cars.set_column(
        cars.schema.get_field_index("score"), cars.schema.field("score"), pa.array([0.93] * 50)
    )
    pq.write_table(
        pa.concat_tables([table, twins]).sort_by("frame"), run.file("detections.parquet")
    )

    save_rrd(run, tmp_path / "run.rrd")

    assert {len(row) for row in _cells(tmp_path / "run.rrd", "/camera/objects", "labels")} == {1}
    assert all(
        row[0].startswith("car 0.97")
        for row in _cells(tmp_path / "run.rrd", "/camera/objects", "labels")
    )
    far = _cells(tmp_path / "run.rrd", "/camera/far_objects", "labels")
    assert all(any(text.startswith("car 0.93") for text in row) for row in far)


@given(
    st.lists(
        st.tuples(
            st.integers(0, 1800), st.integers(0, 1000), st.integers(20, 800), st.integers(20, 600)
        ),
        max_size=12,
    ),
    st.lists(st.floats(0.0, 1.0), min_size=12, max_size=12),
)
def test_no_label_covers_another_or_leaves_the_picture(
    corners: list[tuple[int, int, int, int]], scores: list[float]
) -> None:
    boxes = np.array([(x, y, x + w, y + h) for x, y, w, h in corners], float).reshape(-1, 4)
    texts = [f"traffic light {score:.2f}" for score in scores[: len(boxes)]]

    kept = labelled(boxes, texts, scores[: len(boxes)], (1920, 1080))

    places = label_places(boxes, texts, 1920)
    inside = [bool((at[:2] >= 0).all() and (at[2:] <= (1920, 1080)).all()) for at in places]
    for i, at_i in enumerate(places):
        within = [bool((b[:2] <= at_i[:2]).all() and (at_i[2:] <= b[2:]).all()) for b in boxes]
        crossed = [meet(box, at_i) and not within[j] for j, box in enumerate(boxes)]
        others = [j for j in range(len(boxes)) if j != i and kept[j] and meet(places[j], at_i)]
        assert not (kept[i] and (others or any(crossed) or not inside[i]))
        # A label is left out only for the picture's edge, a box, or a surer label.
        is_lesser = any(scores[j] >= scores[i] for j in others)
        assert kept[i] or not inside[i] or any(crossed) or is_lesser


def meet(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    return bool((np.minimum(one[2:], other[2:]) > np.maximum(one[:2], other[:2])).all())


def test_regions_end_at_the_edge_of_the_picture() -> None:
    marks = Overlays(Vehicle(version=1))
    marks.regions.begin(0)
    beside = np.array([(-900.0, 400.0), (-20.0, 400.0), (-20.0, 600.0)])

    marks.region(beside, QUIET, "left not seen", SIZE)
    marks.region(beside + np.array([100.0, 0.0]), QUIET, "left 5 %", SIZE)
    marks.region(beside + np.array([300.0, 0.0]), QUIET, "left 10 %", SIZE)

    assert marks.regions.labels == ["left 10 %"]
    assert (marks.regions.geometry[0] >= 0.0).all()
    assert (marks.regions.geometry[0] <= SIZE).all()


@given(st.floats(0.0, 1280.0), st.floats(0.0, 720.0), st.floats(-3e3, 3e3), st.floats(-3e3, 3e3))
def test_arrow_keeps_its_direction_and_ends_in_the_picture(
    x: float, y: float, right: float, down: float
) -> None:
    marks = Overlays(Vehicle(version=1))
    marks.cars.begin(0)

    marks.arrow((x, y), np.array([right, down]), QUIET, "crossing", SIZE)

    tail, way = np.split(marks.cars.geometry[0], 2)
    assert (tail == (x, y)).all()
    assert ((tail + way >= -1e-6) & (tail + way <= np.array(SIZE) + 1e-6)).all()
    assert way[0] * down == pytest.approx(way[1] * right, abs=1e-3)
    is_inside = 0.0 <= x + right <= SIZE[0] and 0.0 <= y + down <= SIZE[1]
    assert not is_inside or (way == (right, down)).all()
