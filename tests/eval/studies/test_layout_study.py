"""Studies of layouts and their report; the effect of leaving out a cue."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from crosscue.datasets.scenes.layout import KINDS, layout_named, mixed_kind
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.eval.scoring.columns import RunTables
from crosscue.eval.scoring.drives import as_metrics, pool_scores, score_drive
from crosscue.eval.scoring.intervals import Mean
from crosscue.eval.scoring.truth import FEATURES
from crosscue.eval.studies import simulated_drives
from crosscue.eval.studies.attribution import (
    AttributedDrive,
    attribute,
    attribution_lines,
    attribution_tree,
)
from crosscue.eval.studies.layouts import run as layout_run
from crosscue.eval.studies.layouts.run import (
    REAL_ROADS,
    LayoutDrive,
    study_tables,
    verdict,
    write_layout_study,
)
from crosscue.eval.studies.layouts.score import (
    DriveBelief,
    LayoutScores,
    score_difference,
    score_layouts,
)
from crosscue.eval.studies.layouts.settings import LayoutStudy
from crosscue.eval.studies.simulated_drives import MADE_BY, Work
from crosscue.replay.errors import UsageError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.vehicle.vehicle import SIMULATED_CAR, Vehicle, parse
from support.scoring import BELIEF, CUES, belief_table, good_truth, range_table, tables

STUDY = LayoutStudy()
TRUTH = {"intersection": True, "left": True, "right": False, "straight": True}


def test_layouts_from_draws_layouts_never_seen_before_in_whole_folds() -> None:
    fresh = LayoutStudy(layouts_from=2600)

    assert not {*fresh.layouts} & {*STUDY.layouts}
    assert {layout_named(name).seed for name in fresh.layouts}.isdisjoint(
        layout_named(name).seed for name in STUDY.layouts
    )
    assert {scene.layout for scene in fresh.scenes()} == {*fresh.layouts}
    # Another seed draws other drives of the same layouts.
    assert LayoutStudy(seed=1).layouts == STUDY.layouts
    kinds = [
        {mixed_kind(int(name[1:])) for name in fresh.layouts if fresh.fold_of(name) == fold}
        for fold in range(fresh.folds)
    ]
    assert kinds == [set(KINDS)] * fresh.folds


@pytest.mark.parametrize(
    "changes",
    [
        {"folds": 1},
        {"folds": 10},
        {"runs": 0},
        {"perception": "none"},
        {"width_px": 100},
        {"seed": -1},
        {"layouts_from": -1},
    ],
)
def test_invalid_layout_study_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="expected"):
        LayoutStudy(**changes)


def test_incomplete_or_outdated_drive_is_simulated_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []

    def write_scene(folder: Path, *_: object, **__: object) -> None:
        folder.mkdir(exist_ok=True)
        made.append(folder.name)

    monkeypatch.setattr(simulated_drives, "write_scene", write_scene)
    scene = SceneSettings(layout="M12")

    def simulate(key: str) -> None:
        by_name = {"M12-01": scene}
        Work(tmp_path, by_name, None, "signs", tmp_path, {"M12-01": key}).simulated("M12-01")

    for key in ("a", "a", "b"):
        simulate(key)
    assert made == ["M12-01", "M12-01"]

    (tmp_path / "M12-01" / MADE_BY).unlink()  # an interrupted simulation
    simulate("b")
    assert len(made) == 3

    (tmp_path / "M12-01" / "drive.mcap").touch()  # a drive of unknown origin
    with pytest.raises(UsageError, match="M12-01"):
        simulate("c")
    assert (tmp_path / "M12-01" / MADE_BY).read_text(encoding="utf-8") == "b"


def belief(
    p: Mapping[str, float],
    features: Mapping[str, bool] = TRUTH,
    layout: str = "M0",
    silent: int = 0,
) -> DriveBelief:
    n = 10
    probabilities = np.tile([p.get(name, 0.5) for name in FEATURES], (n, 1))
    is_silent = np.arange(n) < silent
    start_m = np.linspace(60.0, 6.0, n) if features["intersection"] else np.full(n, np.nan)
    return DriveBelief(
        layout, layout, features, start_m, probabilities, probabilities[:, 0] > 0.9, is_silent
    )


CONFIDENT = {"intersection": 0.99, "left": 0.99, "right": 0.01, "straight": 0.99}


def test_rules_for_real_roads_are_those_of_a_real_car() -> None:
    run = MagicMock()
    run.drive_manifest.return_value.settings = Vehicle(version=1, name=SIMULATED_CAR)
    drive = LayoutDrive("M0-01", "M0", 0, TRUTH, run, MagicMock(), (), ())

    changed = drive.settings({name: {"kind": kind} for name, kind in REAL_ROADS.items()})

    real = parse("version = 1", "car.toml")
    assert {name: getattr(real, name).kind for name in REAL_ROADS} == REAL_ROADS
    assert changed.fusion.cues == real.fusion.cues
    assert changed.regions == real.regions


def test_road_established_before_intersection_is_counted() -> None:
    first = {"intersection": 0.5, "left": 0.95}

    assert score_layouts([belief(first)]).full_before_detected.value == 1.0
    assert score_layouts([belief(CONFIDENT)]).full_before_detected.value == 0.0


def test_difference_is_zero_for_equal_beliefs_and_antisymmetric() -> None:
    some = [belief({}, layout=f"M{i}") for i in range(6)]
    confident = [belief(CONFIDENT, layout=f"M{i}") for i in range(6)]

    assert score_difference(some, some).brier.value == 0.0
    assert score_difference(some, confident).brier.value == pytest.approx(
        -score_difference(confident, some).brier.value
    )
    assert score_difference(some, confident).brier.value < 0.0
    with pytest.raises(ValueError, match="the same drives"):
        score_difference(some, confident[1:])


def test_study_has_100_layouts_with_two_drives_each() -> None:
    scenes = STUDY.scenes()

    assert len(set(STUDY.layouts)) >= 100
    assert len(scenes) == 2 * len(STUDY.layouts)
    assert len({scene.name for scene in scenes}) == len(scenes)


def beliefs(p: float) -> list[DriveBelief]:
    one = dict.fromkeys(FEATURES, p)
    there = [dict.fromkeys(FEATURES, i % 2 == 0) for i in range(6)]
    return [belief(one, features, f"M{i}") for i, features in enumerate(there)]


def scores() -> LayoutScores:
    first, second = beliefs(0.5), beliefs(0.95)
    less = score_difference(first, second)
    return LayoutScores(
        {"source": score_layouts(first), "temporal": score_layouts(second)},
        {"temporal less source": less},
        {"stop_sign": less},
        {"": score_layouts(first), "persistence": score_layouts(second)},
        {"persistence": less},
        6,
        6,
        {0: (0.5, 0.02)},
    )


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-0.2, -0.1, "better"),
        (0.1, 0.2, "worse"),
        (-0.1, 0.2, "undecided"),
        (math.nan, math.nan, "undecided"),
    ],
)
def test_verdict_requires_interval_without_zero(low: float, high: float, expected: str) -> None:
    assert verdict(Mean((low + high) / 2.0, low, high, 10, 5)) == expected


def test_every_table_row_has_one_entry_per_column() -> None:
    for table in study_tables(scores()):
        assert {len(row) for row in table.rows} == {len(table.head)}
        assert table.as_text().startswith(table.heading)


def test_files_state_that_study_is_simulated_and_command_to_repeat_it(tmp_path: Path) -> None:
    write_layout_study(tmp_path, LayoutStudy(), scores(), {"M3-01": "disk full"})

    tree = json.loads((tmp_path / "study.json").read_text(encoding="utf-8"))
    assert tree["is_simulated"]
    assert tree["command"].startswith("crosscue study layouts --perception pixels --blocks 8")
    assert tree["failures"] == {"M3-01": "disk full"}
    assert tree["kinds"]["source"]["brier"]["value"] == 0.25
    assert tree["perception"] == "pixels"
    page = (tmp_path / "study.html").read_text(encoding="utf-8")
    assert "networks saw rendered photographs" in page
    assert "failed M3-01: disk full" in page

    write_layout_study(tmp_path, LayoutStudy("faults"), scores(), {})
    assert "No network saw a picture" in (tmp_path / "study.html").read_text(encoding="utf-8")


def test_a_cue_is_left_out_of_every_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    lacking: dict[frozenset[str], list[str]] = {}

    def everywhere(drive: Any, learned: object, without: frozenset[str]) -> str:
        lacking.setdefault(without, []).append(drive.layout)
        return ""

    drives: list[Any] = [MagicMock(layout=f"M{i}", fold=i % 2) for i in range(4)]
    monkeypatch.setattr(layout_run, "fit_beliefs", MagicMock())
    monkeypatch.setattr(layout_run, "_in_approaches", MagicMock())
    monkeypatch.setattr(layout_run, "score_layouts", MagicMock())
    monkeypatch.setattr(layout_run, "score_difference", MagicMock())
    monkeypatch.setattr(layout_run, "_everywhere", everywhere)

    layout_run.score_layout_study(drives)

    whole = [one.layout for one in drives]
    assert len(lacking) > 5
    assert all(of_drives == whole for of_drives in lacking.values())


Beliefs = Mapping[str, Mapping[int, float]]
LATE: Beliefs = {**BELIEF, "right": {33: 0.92}}
NEVER: Beliefs = {"intersection": {}, "left": {}, "right": {}, "straight": {}}


def _tables(belief: Beliefs) -> RunTables:
    return tables(CUES, belief_table(belief), range_table(8, 45, 0.5), frames=50)


def _drive(name: str, by_cue: Mapping[str, Beliefs]) -> AttributedDrive:
    """A drive whose belief changes if one of the given cues is left out."""
    truth = good_truth(name)

    def estimate(cues: frozenset[str], /) -> RunTables:
        changed = [belief for cue, belief in by_cue.items() if cue in cues]
        return _tables(changed[0] if changed else BELIEF)

    return AttributedDrive(score_drive(_tables(BELIEF), truth), truth, estimate)


GROUPS = {
    "parked": ("parked_left", "parked_right"),
    "stop_sign": ("stop_sign",),
    "road": ("road_left",),
}


def test_cue_effect_is_distance_lost_without_it() -> None:
    drives = [_drive(f"d{i}", {"parked_right": LATE, "stop_sign": NEVER}) for i in range(6)]
    found = attribute(drives, GROUPS)

    # The right road is established in frame 25 (15 m) with parked cars, in frame 33 (7 m) without.
    assert found["parked"].full_m.value == pytest.approx(8.0)
    assert found["parked"].full_m.low == pytest.approx(8.0)
    assert found["parked"].measures["approaches.full_m"].without == pytest.approx(7.0)
    assert found["parked"].measures["approaches.full_from_8_m"].without == 0.0
    assert found["parked"].belief["right"].verdict == "first"
    assert found["stop_sign"].detected_only_with == found["stop_sign"].full_only_with == 6
    assert math.isnan(found["stop_sign"].full_m.value)


def test_attribution_is_serialised_and_summary_fits_80_columns() -> None:
    drive = _drive("d", {"stop_sign": NEVER})
    found = attribute([drive], GROUPS)
    metrics = as_metrics(pool_scores([drive.judged])) | {"attribution": attribution_tree(found)}

    assert '"detected_only_with": 1' in strict_json(metrics)
    lines = attribution_lines(found)
    assert max(map(len, lines)) <= 80
    assert len(lines) == len(GROUPS) + 2
