"""The scoreboard of real drives says on how many drives and places each cue stands."""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from runpy import run_path
from typing import Any, cast

import pyarrow as pa
import pytest

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "real_roads.py"


def test_each_cue_states_its_drives_and_places() -> None:
    names = run_path(str(BENCHMARK))
    drive, score = names["Drive"], names["Score"]
    drives = {
        "a": drive("one", "*.jpg", 10.0, is_development=False, cut=(0, 9, 1)),
        "a again": drive("one", "*.jpg", 10.0, is_development=False, cut=(0, 9, 1)),
        "b": drive("one", "*.jpg", 10.0, is_development=False, cut=(20, 29, 1)),
        "c": drive("two", "*.jpg", 10.0, is_development=False),
        "seen": drive("three", "*.jpg", 10.0),
    }
    scores = {
        "a": score(cues={"traffic_light": Counter(right=3)}, legs={"1 left": "right"}),
        "a again": score(cues={"traffic_light": Counter(missed=9)}, legs={"1 left": "WRONG"}),
        "b": score(cues={"traffic_light": Counter(right=2, false=1)}, legs={"left": "not seen"}),
        "c": score(cues={"stop_sign": Counter()}, legs={"left": "undecided 0.61"}),
        "seen": score(cues={"traffic_light": Counter(missed=4)}),
    }
    evidence = cast("Callable[..., Iterator[str]]", names["evidence"])

    lines: dict[str, Any] = {line.split()[0]: line.split()[1:] for line in evidence(scores, drives)}

    assert lines["traffic_light"] == ["1", "2", "1", "false,", "5", "right"]
    assert lines["traffic_light*"] == ["1", "1", "4", "missed"]
    assert lines["stop_sign"] == ["0", "0", "-"]
    assert lines["left"] == ["2", "3", "1", "not", "seen,", "1", "right,", "1", "undecided"]


def test_messages_of_roads_are_counted_apart_from_the_beliefs_they_lead_to() -> None:
    names = run_path(str(BENCHMARK))
    drive, score = names["Drive"], names["Score"]
    drives = {
        "a": drive("one", "*.jpg", 10.0, is_development=False),
        "b": drive("two", "*.jpg", 10.0, is_development=False),
        "kitti": drive("three", "*.jpg", 10.0, "focal_px = 700.0"),
    }
    scores = {
        "a": score(messages={"1 left": (True, True), "2 left": (True, False)}),
        "b": score(messages={"left": (False, True), "right": (False, False)}),
        "kitti": score(messages={"left": (True, True)}),
    }
    evidence = cast("Callable[..., Iterator[str]]", names["evidence"])

    lines = {line.split()[0]: " ".join(line.split()[1:]) for line in evidence(scores, drives)}

    each = "a 1 of 2 true, 0 of 0 absent, b 0 of 0 true, 1 of 2 absent"
    assert lines["shape"] == f"2 2 1 of 2 true, 1 of 2 absent ({each})"
    assert lines["shape*"] == "0 0 0 of 0 true, 0 of 0 absent (-)"
    assert lines["openings*"].startswith("1 1 1 of 1 true, 0 of 0 absent (kitti")


def test_a_message_in_any_annotated_frame_shows_its_leg() -> None:
    names = run_path(str(BENCHMARK))
    approach = names["Approach"](
        1, 2, {"intersection": True, "left": True, "right": False, "straight": None}
    )
    drive = names["Drive"]("none", "*.jpg", 10.0, approaches=(approach,))
    frames = pa.table({"t_ns": [0, 10, 20, 30]})
    rows = [(0, "road_right", 1), (10, "road_left", 0), (20, "road_left", 1), (30, "road_right", 1)]
    cues = pa.table(dict(zip(("t_ns", "cue", "count"), zip(*rows, strict=True), strict=True)))
    belief = pa.table({"t_ns": pa.array([], pa.int64())})

    scored = names["scored"]({"frames": frames, "cues": cues, "belief": belief}, drive)

    assert scored.messages == {"left": (True, True), "right": (False, False)}
    assert scored.legs == {"left": "not seen", "right": "not seen"}


def test_belief_is_judged_in_each_annotated_frame_and_outside_approaches_by_its_prior() -> None:
    names = run_path(str(BENCHMARK))
    approach = names["Approach"](0, 1, {"intersection": True, "left": None})
    row = {"t_ns": 20, "approach": 0, "intersection": 0.9, "left": 0.5}
    run = {
        "frames": pa.table({"t_ns": [10, 20, 30]}),
        "cues": pa.table({"t_ns": [10], "cue": ["stop_sign"], "count": [0]}),
        "belief": pa.Table.from_pylist([row]),
    }

    score = names["scored"](run, names["Drive"]("one", "*.jpg", 10.0, approaches=(approach,)))

    assert score.brier == [pytest.approx((0.5**2 + 0.1**2) / 2.0)]
