"""The real drives of the documentation, and on how many of them each cue stands."""

import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from runpy import run_path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.datasets.real import recordings
from crosscue.datasets.real.recordings import FOLDER
from crosscue.datasets.truth.truth import read_truth as load_truth
from crosscue.detectors.catalog import fetch as weights
from crosscue.detectors.catalog import places
from crosscue.eval.cli import run
from crosscue.replay.errors import CrosscueError
from crosscue.replay.vehicle.cue_table import AT_INTERSECTIONS
from crosscue.replay.vehicle.vehicle import load as load_vehicle
from support.data import shared
from support.scene_run import scene_run

DRIVES = ("comma2k19", "pandaset_002", "us_dashcam")


@pytest.mark.parametrize("name", DRIVES)
def test_vehicle_files_and_annotations_load_with_their_source(name: str) -> None:
    vehicle = load_vehicle(FOLDER / name / "vehicle.toml")
    truth = load_truth(FOLDER / name)

    assert vehicle.name != "unnamed"
    assert vehicle.detectors
    assert "annotated for crosscue" in truth.source
    present = {one.cue: one.present for one in truth.cues}
    assert present["traffic_light"]
    assert not present["stop_sign"]


def test_dashcam_truth_passes_check_against_frames(tmp_path: Path) -> None:
    frames = shared("sequences", "us_signalized_intersection_dashcam")
    folder = tmp_path / "dashcam"
    folder.mkdir()
    for path in frames.glob("*.jpg"):
        shutil.copy(path, folder / path.name)
    (folder / "timestamps.txt").write_text("rate_hz: 15\n")

    assert run(["check", str(FOLDER / "us_dashcam"), str(folder)]) == 0


@pytest.mark.slow
def test_can_segment_and_single_picture_are_replayed_as_one_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run the commands of the documentation, up to the traffic light in the picture."""
    (segment,) = shared("comma2k19", "Example_1").glob("*/40")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(places.VARIABLE, str(tmp_path / "models"))
    monkeypatch.setenv(weights.DATA, str(shared("weights").parent))
    weights.fetch_weights("yolox-nano")
    front = tmp_path / "front"
    front.mkdir()
    shutil.copy(segment / "preview.png", front / "00.png")
    (front / "timestamps.txt").write_text("46408.547498\n")
    (tmp_path / "toyota_2017.dbc").symlink_to(shared("comma2k19", "toyota_2017.dbc"))
    settings = tmp_path / "vehicle.toml"
    settings.write_text((FOLDER / "comma2k19" / "vehicle.toml").read_text())
    line = f"replay {segment} front --vehicle {settings} -o run --no-cache -q"

    assert run(line.split()) == 3
    assert run(["truth", str(segment), "-o", "truth", "-q"]) in (0, 3)
    (tmp_path / "truth" / "truth.json").write_bytes(
        (FOLDER / "comma2k19" / "truth.json").read_bytes()
    )
    assert run(["score", "run", "--truth", "truth", "-q"]) == 3

    cues = pq.read_table("run/cues.parquet", filters=[("cue", "=", "traffic_light")])
    assert [count > 0 for count in cues["count"].to_pylist()] == [True]


@pytest.mark.parametrize("is_there", [False, True])
def test_fetching_without_a_network_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_there: bool
) -> None:
    monkeypatch.delenv(weights.DATA, raising=False)
    monkeypatch.setenv(places.VARIABLE, str(tmp_path / "models"))
    for mirror in (recordings.MIRROR, weights.MIRROR):
        monkeypatch.setenv(mirror, "http://127.0.0.1:9")
    folder = tmp_path / "drives" / "pandaset"
    if is_there:
        folder.mkdir(parents=True)

    with pytest.raises(CrosscueError, match="not fetched"):
        recordings.fetch("pandaset_002", folder)
    with pytest.raises(CrosscueError, match="not fetched"):
        weights.fetch_weights("yolox-nano")

    assert [*tmp_path.rglob("*")] == ([folder.parent, folder] if is_there else [])


NAMES = run_path(str(Path(__file__).parents[2] / "benchmarks" / "real_roads.py"))
Drive, Score, Approach = (NAMES[name] for name in ("Drive", "Score", "Approach"))
EVIDENCE: Callable[..., Iterator[str]] = NAMES["evidence"]


def test_each_cue_states_its_drives_and_places() -> None:
    drives = {
        "a": Drive("one", "*.jpg", 10.0, is_development=False, cut=(0, 9, 1)),
        "a again": Drive("one", "*.jpg", 10.0, is_development=False, cut=(0, 9, 1)),
        "b": Drive("one", "*.jpg", 10.0, is_development=False, cut=(20, 29, 1)),
        "c": Drive("two", "*.jpg", 10.0, is_development=False),
        "seen": Drive("three", "*.jpg", 10.0),
    }
    scores = {
        "a": Score(cues={"traffic_light": Counter(right=3)}, legs={"1 left": "right"}),
        "a again": Score(cues={"traffic_light": Counter(missed=9)}, legs={"1 left": "WRONG"}),
        "b": Score(cues={"traffic_light": Counter(right=2, false=1)}, legs={"left": "not seen"}),
        "c": Score(cues={"stop_sign": Counter()}, legs={"left": "undecided 0.61"}),
        "seen": Score(cues={"traffic_light": Counter(missed=4)}),
    }

    lines = {line.split()[0]: line.split()[1:] for line in EVIDENCE(scores, drives)}

    assert lines["traffic_light"] == ["1", "2", "1", "false,", "5", "right"]
    assert lines["traffic_light*"] == ["1", "1", "4", "missed"]
    assert lines["stop_sign"] == ["0", "0", "-"]
    assert lines["left"] == ["2", "3", "1", "not", "seen,", "1", "right,", "1", "undecided"]


def test_messages_of_roads_are_counted_apart_from_the_beliefs_they_lead_to() -> None:
    drives = {
        "a": Drive("one", "*.jpg", 10.0, is_development=False),
        "b": Drive("two", "*.jpg", 10.0, is_development=False),
        "kitti": Drive("three", "*.jpg", 10.0),
    }
    scores = {
        "a": Score(messages={"1 left": (True, True), "2 left": (True, False)}),
        "b": Score(messages={"left": (False, True), "right": (False, False)}),
        "kitti": Score(messages={"left": (True, True)}),
    }

    lines = {line.split()[0]: " ".join(line.split()[1:]) for line in EVIDENCE(scores, drives)}

    each = "a 1 of 2 true, 0 of 0 absent, b 0 of 0 true, 1 of 2 absent"
    assert lines["messages"] == f"2 2 1 of 2 true, 1 of 2 absent ({each})"
    assert lines["messages*"].startswith("1 1 1 of 1 true, 0 of 0 absent (kitti")


def test_sums_of_legs_and_intersections_are_apart_for_drives_of_development() -> None:
    drives = {
        "a": Drive("one", "*.jpg", 10.0, is_development=False),
        "a again": Drive("one", "*.jpg", 10.0, is_development=False),
        "b": Drive("two", "*.jpg", 10.0, is_development=False),
        "seen": Drive("three", "*.jpg", 10.0),
    }
    there, absent = (True, False), (False, False)
    first = Score(
        legs={"1 left": "right", "2 left": "not seen", "2 right": "right", "2 straight": "WRONG"},
        messages={"1 left": there, "2 left": there, "2 right": absent, "2 straight": absent},
        pieces=[1, 0],
        false_intersections=1,
        minutes=1.5,
    )
    scores = {
        "a": first,
        "a again": first,
        "b": Score(
            legs={"left": "undecided 0.61"},
            messages={"left": there},
            pieces=[2],
            false_intersections=2,
            unannotated=1,
            minutes=0.5,
        ),
        "seen": Score(legs={"left": "WRONG"}, messages={"left": absent}),
    }

    development, others = NAMES["sums"](scores, drives)

    assert " ".join(development.split()) == (
        "sums* legs there 0 of 0, absent wrong 1 of 1; intersections 0 of 0, in one piece 0; "
        "false 0 in 0.0 minutes, 0 of them where nobody annotated"
    )
    assert " ".join(others.split()) == (
        "sums legs there 1 of 3, absent wrong 1 of 2; intersections 2 of 3, in one piece 1; "
        "false 3 in 2.0 minutes (1.50 a minute), 1 of them where nobody annotated"
    )


def test_a_message_in_any_annotated_frame_shows_its_leg() -> None:
    approach = Approach(
        1, 2, {"intersection": True, "left": True, "right": False, "straight": None}
    )
    drive = Drive("none", "*.jpg", 10.0, approaches=(approach,))
    frames = pa.table({"t_ns": [0, 10, 20, 30]})
    rows = [(0, "road_right", 1), (10, "road_left", 0), (20, "road_left", 1), (30, "road_right", 1)]
    cues = pa.table(dict(zip(("t_ns", "cue", "count"), zip(*rows, strict=True), strict=True)))
    belief = pa.table({"t_ns": pa.array([], pa.int64())})

    scored = NAMES["scored"]({"frames": frames, "cues": cues, "belief": belief}, drive)

    assert scored.messages == {"left": (True, True), "right": (False, False)}
    assert scored.legs == {"left": "not seen", "right": "not seen"}
    assert scored.pieces == [0]


def test_belief_is_judged_in_each_annotated_frame_and_outside_approaches_by_its_prior() -> None:
    approach = Approach(0, 1, {"intersection": True, "left": None})
    row = {"t_ns": 20, "approach": 0, "intersection": 0.9, "left": 0.5}
    run = {
        "frames": pa.table({"t_ns": [10, 20, 30]}),
        "cues": pa.table({"t_ns": [10], "cue": ["stop_sign"], "count": [0]}),
        "belief": pa.Table.from_pylist([row]),
    }

    score = NAMES["scored"](run, Drive("one", "*.jpg", 10.0, approaches=(approach,)))

    assert score.brier == [pytest.approx((0.5**2 + 0.1**2) / 2.0)]


def test_ranges_are_scored_where_the_distance_to_a_start_is_annotated() -> None:
    """Between the annotated frames by interpolation; the camera is 1.03 m ahead of the axle."""
    rows = [(10, "start", 21.0), (20, "start", 17.0), (20, "end", 30.0), (30, "start", 9.0)]
    ranges = [
        {"t_ns": t_ns, "reference": reference, "range_m": range_m, "var_m2": 1.0}
        for t_ns, reference, range_m in rows
    ]
    run = {
        "frames": pa.table({"t_ns": [10, 20, 30]}),
        "cues": pa.table({"t_ns": [10], "cue": ["stop_sign"], "count": [0]}),
        "belief": pa.table({"t_ns": pa.array([], pa.int64())}),
        "range": pa.Table.from_pylist(ranges),
    }
    drive = Drive(
        "one", "*.jpg", 10.0, approaches=(Approach(0, 0, {}),), starts=[[(0, 20.0), (2, 10.0)]]
    )

    assert NAMES["scored"](run, drive).ranges == (2, 3)


def test_frames_with_something_wrong_are_drawn(tmp_path: Path) -> None:
    folder = scene_run(tmp_path / "drive")
    times = folder.table("frames")["t_ns"].to_pylist()
    there = {"intersection": True, "left": False, "right": True}
    tables = {name: folder.table(name) for name in ("frames", "cues", "belief", "range")}
    drive = Drive(
        "none",
        "*.jpg",
        10.0,
        approaches=(Approach(15, 49, there),),
        in_view={"stop_sign": [(5, 10, True), (15, 15, False)], "traffic_light": []},
    )

    score = NAMES["scored"](tables, drive)

    # The sign is found from frame 10 on, the left believed from frame 20 on.
    assert score.wrong == [
        (times[5], "missed stop_sign"),
        (times[15], "false stop_sign"),
        (times[20], "false left"),
    ]
    none = {"intersection": False}
    for approach, unannotated in ((Approach(0, 9, there), 1), (Approach(0, 49, none), 0)):
        alone = NAMES["scored"](tables, Drive("none", "*.jpg", 10.0, approaches=(approach,)))
        assert [what for _, what in alone.wrong] == ["false intersection"]
        assert alone.unannotated == unannotated

    wrong = tmp_path / "wrong"
    wrong.mkdir()
    for name in ("made up frame 0001 false left.jpg", "other frame 0001 false left.jpg"):
        (wrong / name).write_text("of an earlier run")
    assert NAMES["draw_wrong"]("made up", crosscue.open_run(folder.path), score, wrong) == ""
    assert sorted(path.name for path in wrong.iterdir()) == [
        "made up frame 0005 missed stop_sign.jpg",
        "made up frame 0015 false stop_sign.jpg",
        "made up frame 0020 false left.jpg",
        "other frame 0001 false left.jpg",
    ]


def test_lights_of_annotated_approaches_are_at_intersections_as_often_as_the_message_says() -> None:
    lit = []
    for _, drive in NAMES["recorded_drives"]():
        shown = [
            (first, last) for first, last, is_there in drive.in_view["traffic_light"] if is_there
        ]
        for one in drive.approaches:
            if any(first <= one.last and one.first <= last for first, last in shown):
                lit.append(one.features["intersection"])

    assert (sum(lit), len(lit)) == (42, 44)
    assert sum(lit) / len(lit) == pytest.approx(AT_INTERSECTIONS, abs=0.01)


def test_annotations_of_recorded_drives_lie_within_the_pictures_of_their_cut() -> None:
    drives = dict(NAMES["recorded_drives"]())

    for name, drive in drives.items():
        first, last, step = drive.cut
        stretches = [(one.first, one.last) for one in drive.approaches]
        stretches += [cue[:2] for cues in drive.in_view.values() for cue in cues]
        assert stretches, name
        for start, end in stretches:
            assert 0 <= start <= end <= (last - first) // step, name
        for one in drive.approaches:
            assert set(one.features) == {"intersection", *NAMES["FEATURES"]}, name
