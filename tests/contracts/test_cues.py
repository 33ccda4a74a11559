"""Every cue and every built-in detector fulfils its contract."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow.compute as pc
import pytest

import crosscue
from crosscue.datasets.scenes.scene_truth import SIMULATED
from crosscue.detectors.base import Detections, DetectorChoice, Found, Frame
from crosscue.detectors.cues.rules import rule_of
from crosscue.detectors.registry import BUILTIN, make
from crosscue.replay.vehicle.cue_spec import CueSpec
from crosscue.replay.vehicle.cue_table import CUES, groups
from crosscue.replay.vehicle.fusion import Fusion
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.testing import check_cue, check_detector
from support.detecting import BrightBlob, BrightSettings, build, too_few, yolox_card
from support.gap_drive import Clock, GreyNumber, write_drive
from support.recordings import cells

DUMMY = CueSpec(
    name="zebra",
    group="zebra",
    title="zebra crossing",
    observed_by="objects",
    rule=f"{__name__}:count_zebras",
    precision=0.61,
    precision_is_lower_bound=True,
    supports=("straight",),
    scored_as="feature",
    label="zebra",
    colour=(1, 2, 3),
)


# The contract and the plug-in below name these functions as text, ``{__name__}:function``.


def count_zebras(boxes: Sequence[Detections], vehicle: Vehicle, cue: CueSpec) -> int:
    """Return twice the number of zebra crossings: the only function of the dummy cue."""
    assert vehicle.version == 1
    return 2 * sum(found.labels.count(cue.label or "") for found in boxes)


def always(boxes: Sequence[Detections], vehicle: Vehicle, cue: CueSpec) -> int:
    """Return 1 for an empty picture, which violates the contract."""
    return 1


def a_fraction(boxes: Sequence[Detections], vehicle: Vehicle, cue: CueSpec) -> float:
    """Return a count that is not an integer, which violates the contract."""
    return 0.5


class ZebraDetector(GreyNumber):
    """A detector that adds a zebra crossing next to the drive's stop sign."""

    def _one(self, frame: Frame) -> Found:
        found = super()._one(frame)
        assert isinstance(found, Detections)
        if not len(found):
            return found
        return replace(
            found,
            boxes_px=np.concatenate([found.boxes_px, [[10.0, 60.0, 90.0, 80.0]]]),
            scores=np.ones(2),
            labels=(*found.labels, "zebra"),
            masks=(b"", b""),
        )


@pytest.mark.parametrize("cue", CUES.values(), ids=lambda cue: str(cue.name))
def test_every_cue_has_rule_simulator_and_claim(cue: CueSpec) -> None:
    assert CUES[cue.name] is cue
    assert callable(rule_of(cue.rule))
    assert callable(SIMULATED[cue.name])
    assert cue.claim[0] in Fusion().features
    assert 0.5 < cue.precision < 1.0


@pytest.mark.parametrize("cue", CUES.values(), ids=lambda cue: str(cue.name))
def test_every_cue_fulfils_contract(cue: CueSpec) -> None:
    check_cue(cue)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"name": "Zebra"}, "expected a_lower_name"),
        ({"precision": 1.0}, "precision"),
        ({"supports": ()}, "supports and excludes nothing"),
        ({"excludes": ("straight",)}, "supports and excludes"),
        ({"rule": "crosscue.detectors.cues.labelled:nothing"}, "rule"),
        ({"rule": f"{__name__}:always"}, "counts 1 where nothing is"),
        ({"rule": f"{__name__}:a_fraction"}, "expected a count"),
    ],
)
def test_contract_check_reports_invalid_cue(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(AssertionError, match=match):
        check_cue(replace(DUMMY, **changes))


def test_cue_without_label_counts_any_label(monkeypatch: pytest.MonkeyPatch) -> None:
    """With such a cue, no detector is reported as unused."""
    assert not Vehicle(version=1).counts_any_label
    monkeypatch.setitem(CUES, DUMMY.name, replace(DUMMY, label=None))
    assert Vehicle(version=1).counts_any_label


def test_cues_of_group_have_same_row_of_table_5() -> None:
    for group in groups().values():
        assert len({(cue.title, cue.precision, cue.scored_as) for cue in group}) == 1


def test_simulator_has_functions_of_existing_cues_only() -> None:
    assert [*SIMULATED] == [*CUES]


def test_dummy_cue_appears_in_tables_scores_report_and_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(CUES, DUMMY.name, DUMMY)
    log = write_drive(tmp_path, Clock(), seconds=6)
    with (tmp_path / "car.toml").open("a") as vehicle:
        vehicle.write('[fusion]\nkind = "source"\n')
    stated = (tmp_path / "truth.json").read_text()
    (tmp_path / "truth.json").write_text(stated.replace('"cue": "stop_sign"', '"cue": "zebra"'))

    run = crosscue.replay_drive(
        log, tmp_path / "run", tmp_path / "car.toml", [f"{__name__}:ZebraDetector"]
    )
    scored = crosscue.score_run(run, tmp_path / "truth.json", has_figures=False)
    recording = crosscue.save_recording(run, tmp_path / "zebra.rrd")

    rows = run["cues"].filter(pc.equal(run["cues"]["cue"], "zebra")).to_pylist()
    counts = [row["count"] for row in rows if row["count"]]
    assert counts == [2] * 34  # the last of them is after the end of the truth
    assert run.belief["straight"].to_pylist()[-1] > 0.6
    (score,) = [row for row in scored.cues.to_pylist() if row["cue"] == "zebra"]
    assert (score["precision"], score["precision_of"]) == (1.0, 33)
    assert "<td>zebra</td>" in scored.report.read_text()
    (colour,) = cells(recording, "/cues/zebra", "colors", is_static=True)
    assert colour[1] == [int.from_bytes((1, 2, 3, 255))]


NEEDS_A_CARD: Final = {"model"}


@pytest.mark.parametrize("name", sorted(BUILTIN.keys() - NEEDS_A_CARD))
def test_every_detector_fulfils_contract(name: str) -> None:
    check_detector(lambda: make(DetectorChoice(name, name)))


def test_detector_of_model_card_fulfils_contract(tmp_path: Path) -> None:
    card = str(yolox_card(tmp_path))

    check_detector(lambda: make(DetectorChoice("yolox", "model", {"card": card})))


class _WrongTime(BrightBlob):
    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        return [replace(self._one(frame), t_ns=frame.t_ns + 1) for frame in frames]


class _BoxOutsidePicture(BrightBlob):
    def _one(self, frame: Frame) -> Detections:
        found = super()._one(frame)
        return replace(found, boxes_px=found.boxes_px + 1.0)


class _ScoreAboveOne(BrightBlob):
    def _one(self, frame: Frame) -> Detections:
        found = super()._one(frame)
        return replace(found, scores=found.scores * 1.01)


class _ChangesPixels(BrightBlob):
    def _one(self, frame: Frame) -> Detections:
        found = super()._one(frame)
        np.asarray(frame.pixels)[0] = 0
        return found


class _UndeclaredLabel(BrightBlob):
    labels = ("zebra",)


class _RepeatsFirstFrame(BrightBlob):
    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        return [self._one(frames[0]) for _ in frames]


@pytest.mark.parametrize(
    ("kind", "match"),
    [
        (_WrongTime, "time and size of the result"),
        (_BoxOutsidePicture, "not inside the picture"),
        (_ScoreAboveOne, "expected 0 to 1"),
        (_ChangesPixels, "changed a frame's pixels"),
        (_UndeclaredLabel, "label not declared; expected one of zebra"),
        (_RepeatsFirstFrame, "frame 17: time and size"),
    ],
)
def test_contract_check_reports_invalid_detector(kind: type[BrightBlob], match: str) -> None:
    with pytest.raises(AssertionError, match=match):
        check_detector(lambda: kind(BrightSettings()))


def test_contract_check_reports_missing_results() -> None:
    check_detector(build)
    with pytest.raises(AssertionError, match="3 frames, 0 results"):
        check_detector(too_few)
