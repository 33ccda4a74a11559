"""Tests that a cue without a capable detector is not evaluated, rather than counted as zero."""

from pathlib import Path

import numpy as np
import pytest

from crosscue.detectors.base import Detections, DetectorChoice, reportable
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import FrameDetections, all_labels
from crosscue.detectors.registry import make
from crosscue.eval.pipeline.scene.looked_for import (
    NEVER,
    NO_LABEL,
    NO_MASKS,
    NO_MOBILEYE,
    NO_OBJECTS,
    NO_ROAD,
    needing_masks,
    not_looked_for,
)
from crosscue.eval.runs.manifest import DetectorRow
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Cues, OwnCue, Vehicle
from support.detecting import yolox_card

VEHICLE = Vehicle(version=1, cues=Cues(own={"crossing": OwnCue(labels=("zebra",))}))
SIGNS = {"one_way_left", "one_way_right", "do_not_enter"}
PARKED = {"parked_left", "parked_right"}
CONTROLS = {"stop_sign", "traffic_light"}


def _found(*labels: str) -> Detections:
    n = len(labels)
    boxes = np.tile((5.0, 5.0, 25.0, 45.0), (n, 1)).reshape(-1, 4)
    return Detections(0, (640, 480), boxes, np.full(n, 0.99), labels, (b"",) * n)


def _counts(labels: tuple[str, ...] | None, *found: str) -> dict[str, int]:
    seen = FrameDetections(0, objects=(_found(*found),), labels=all_labels([labels]))
    return dict(CuePass(VEHICLE)(seen).counts)


def test_detector_without_labels_evaluates_all_box_cues() -> None:
    of_boxes = {name for name, cue in CUES.items() if cue.observed_by in ("objects", "signs")}

    assert of_boxes >= CONTROLS | SIGNS
    assert set(_counts(None)) == of_boxes | {"crossing"}


@pytest.mark.parametrize(
    ("label", "cue"),
    [
        ("one way left", "one_way_left"),
        ("one way right", "one_way_right"),
        ("do not enter", "do_not_enter"),
        ("no entry", "do_not_enter"),
    ],
)
def test_sign_cues_accept_labels_of_any_detector(label: str, cue: str) -> None:
    assert _counts((label, "car"), label) == {cue: 1}


def test_labels_are_unknown_if_one_detector_lists_none() -> None:
    assert all_labels([("car",), None]) is None
    assert all_labels([("car",), ("stop sign", "car")]) == frozenset({"car", "stop sign"})


def test_built_in_detectors_list_their_labels(tmp_path: Path) -> None:
    signs = make(DetectorChoice("signs", "signs"))
    card = make(DetectorChoice("yolox", "model", {"card": str(yolox_card(tmp_path))}))

    assert reportable(signs) == ("do not enter", "one way left", "one way right")
    assert reportable(make(DetectorChoice("road", "road"))) == ()
    assert {"car"} < {*(reportable(card) or ())}
    assert {"car", "stop sign", "traffic light"} <= {
        *(reportable(make(DetectorChoice("cars", "mask-rcnn"))) or ())
    }


def _row(role: str, labels: tuple[str, ...] | None) -> DetectorRow:
    return DetectorRow(name=role, identity="0", kind="", role=role, labels=labels, settings={})


def test_every_cue_that_is_not_evaluated_has_a_reason() -> None:
    lights = [_row("objects", ("traffic light",))]
    reason = not_looked_for({"traffic_light"}, lights, VEHICLE.cue_labels())
    assert set(reason) == {*CUES, "crossing"} - {"traffic_light"}
    assert {reason[cue] for cue in SIGNS | {"stop_sign", "parked_left", "crossing"}} == {NO_LABEL}
    assert reason["road_left"] == NO_ROAD
    assert reason["lanes_past"] == NO_MOBILEYE

    only_road = not_looked_for((), [_row("road", ())], VEHICLE.cue_labels())
    assert {only_road[cue] for cue in CONTROLS | SIGNS} == {NO_OBJECTS}
    assert only_road["road_left"] == NEVER

    assert not_looked_for((), [_row("objects", None)], VEHICLE.cue_labels())["parked_left"] == NEVER


@pytest.mark.parametrize(
    ("found", "is_without"),
    [
        ([{"boxes_only": ("car", "truck")}], True),
        ([{"boxes_only": ("truck",), "with_mask": ("car",)}], False),
        ([{"boxes_only": ("car",)}, {"with_mask": ("car",)}], False),
        ([{"boxes_only": ("car",)}, {"with_mask": ("person",)}], True),
        ([{"boxes_only": ("stop sign",)}], False),
        ([{}], False),
    ],
)
def test_parked_cars_are_not_evaluated_without_masks_of_cars(
    found: list[dict[str, tuple[str, ...]]], is_without: bool
) -> None:
    rows = [_row("objects", ("car",)).model_copy(update=labels) for labels in found]
    without = needing_masks(rows, VEHICLE.cars.labels)

    assert without == (PARKED if is_without else frozenset())
    reason = not_looked_for((), rows, VEHICLE.cue_labels(), without=without)
    assert {reason[cue] for cue in PARKED} == {NO_MASKS if is_without else NEVER}
