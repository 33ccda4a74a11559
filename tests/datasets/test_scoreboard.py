"""The scoreboard of real drives says on how many drives and places each cue stands."""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from runpy import run_path

import pyarrow as pa
import pytest

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
        "kitti": Drive("three", "*.jpg", 10.0, "focal_px = 700.0"),
    }
    scores = {
        "a": Score(messages={"1 left": (True, True), "2 left": (True, False)}),
        "b": Score(messages={"left": (False, True), "right": (False, False)}),
        "kitti": Score(messages={"left": (True, True)}),
    }

    lines = {line.split()[0]: " ".join(line.split()[1:]) for line in EVIDENCE(scores, drives)}

    each = "a 1 of 2 true, 0 of 0 absent, b 0 of 0 true, 1 of 2 absent"
    assert lines["shape"] == f"2 2 1 of 2 true, 1 of 2 absent ({each})"
    assert lines["shape*"] == "0 0 0 of 0 true, 0 of 0 absent (-)"
    assert lines["openings*"].startswith("1 1 1 of 1 true, 0 of 0 absent (kitti")


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
