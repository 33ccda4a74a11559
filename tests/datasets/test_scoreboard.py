"""The scoreboard of real drives says on how many drives and places each cue stands."""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from runpy import run_path
from typing import Any, cast

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
