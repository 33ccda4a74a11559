"""The study of layouts: contents of folds, and scores of generated beliefs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crosscue.datasets.scenes.drive import FROM_M, SPACING_M, SPACING_S, sparse_pictures
from crosscue.datasets.scenes.layout import layout_named
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width, world_of
from crosscue.eval.scoring.truth import FEATURES
from crosscue.eval.studies import simulated_drives
from crosscue.eval.studies.layouts.score import DriveBelief, difference, score_layouts
from crosscue.eval.studies.layouts.settings import LayoutStudy
from crosscue.eval.studies.simulated_drives import MADE_BY, Work
from crosscue.replay.errors import UsageError

STUDY = LayoutStudy()
TRUTH = {"intersection": True, "left": True, "right": False, "straight": True}
NOTHING = {"intersection": False, "left": False, "right": False}


@pytest.mark.parametrize("feature", FEATURES)
@pytest.mark.parametrize("fold", range(STUDY.folds))
def test_every_fold_has_layouts_with_each_feature_and_without(fold: int, feature: str) -> None:
    known = [
        layout_named(name).features.get(feature)
        for name in STUDY.layouts
        if STUDY.fold_of(name) == fold
    ]

    assert {True, False} <= set(known)


def test_there_are_a_hundred_layouts_with_two_drives_each_under_different_conditions() -> None:
    scenes = STUDY.scenes()

    assert len(set(STUDY.layouts)) >= 100
    assert len(scenes) == 2 * len(STUDY.layouts)
    assert len({scene.name for scene in scenes}) == len(scenes)


def test_drives_of_one_layout_are_in_one_fold_and_folds_are_about_equal() -> None:
    sizes = np.bincount([STUDY.fold_of(name) for name in STUDY.layouts])

    assert len(sizes) == STUDY.folds
    assert sizes.max() - sizes.min() <= 13


@pytest.mark.parametrize(
    "changes",
    [
        {"folds": 1},
        {"folds": 10},
        {"runs": 0},
        {"perception": "none"},
        {"width_px": 100},
        {"seed": -1},
    ],
)
def test_a_study_that_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="expected"):
        LayoutStudy(**changes)


def test_a_drive_is_made_again_when_it_is_not_whole_or_what_made_it_has_changed(
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

    (tmp_path / "M12-01" / MADE_BY).unlink()  # as if it had been interrupted
    simulate("b")
    assert len(made) == 3

    (tmp_path / "M12-01" / "drive.mcap").touch()  # a drive that nothing says is this one
    with pytest.raises(UsageError, match="M12-01"):
        simulate("c")
    assert (tmp_path / "M12-01" / MADE_BY).read_text(encoding="utf-8") == "b"


def test_comments_and_docstrings_make_no_drive_stale_and_another_number_does() -> None:
    plain = "def height(x):\n    return 2 * x\n"
    said = '"""Heights."""\n\n\ndef height(x):\n    """Twice as high."""\n    return 2 * x  # m\n'

    assert simulated_drives.meaning_of(said) == simulated_drives.meaning_of(plain)
    assert simulated_drives.meaning_of(plain.replace("2", "3")) != simulated_drives.meaning_of(
        plain
    )


def test_pictures_are_few_and_end_where_the_intersection_begins() -> None:
    scene = SceneSettings(layout="M0", camera=camera_of_width(64))
    _, _, world = world_of(scene, is_painted=False)
    motion = world.approach.motion

    times = [t_ns for t_ns, _ in sparse_pictures(world, scene)]

    x_m = np.interp(times, motion.t_ns, motion.x_m)
    assert -FROM_M <= x_m[0] < -FROM_M + SPACING_M
    assert ((np.diff(x_m) >= SPACING_M) | (np.diff(times) >= SPACING_S * 1e9)).all()
    assert x_m[-1] < 5.0


def belief(
    p: Mapping[str, float],
    features: Mapping[str, bool] = TRUTH,
    layout: str = "M0",
    silent: int = 0,
) -> DriveBelief:
    n = 10
    said = np.tile([p.get(name, 0.5) for name in FEATURES], (n, 1))
    is_silent = np.arange(n) < silent
    start_m = np.linspace(60.0, 6.0, n) if features["intersection"] else np.full(n, np.nan)
    return DriveBelief(layout, layout, features, start_m, said, said[:, 0] > 0.9, is_silent)


SURE = {"intersection": 0.99, "left": 0.99, "right": 0.01, "straight": 0.99}


def test_a_sure_and_right_belief_is_full_from_the_first_picture_and_has_no_false_feature() -> None:
    scored = score_layouts([belief(SURE, layout=f"M{i}") for i in range(5)])

    assert scored.brier.value == pytest.approx(1e-4)
    assert scored.full.value == 1.0
    assert scored.full_m.value == pytest.approx(60.0)
    assert scored.false_features.value == 0.0


def test_one_half_scores_a_quarter_whatever_is_so() -> None:
    scored = score_layouts([belief({}), belief({}, NOTHING, "M8")])

    assert scored.brier.value == pytest.approx(0.25)
    assert scored.log_score.value == pytest.approx(np.log(2.0))


def test_false_features_are_counted_once_a_drive_and_not_where_nothing_was_said() -> None:
    wrong = {"intersection": 0.95, "left": 0.2, "right": 0.95}

    assert score_layouts([belief(wrong, NOTHING)]).false_features.value == 2.0
    assert score_layouts([belief(wrong, NOTHING, silent=10)]).false_features.value == 0.0


def test_a_way_before_the_intersection_is_counted() -> None:
    first = {"intersection": 0.5, "left": 0.95}

    assert score_layouts([belief(first)]).full_before_detected.value == 1.0
    assert score_layouts([belief(SURE)]).full_before_detected.value == 0.0


def test_what_nobody_knows_is_not_scored() -> None:
    one = belief({"intersection": 0.0, "left": 0.0, "straight": 1.0}, NOTHING)

    assert np.isnan(score_layouts([one]).brier_by_feature["straight"].value)


def test_a_difference_is_zero_against_itself_and_turns_round_with_the_order() -> None:
    some = [belief({}, layout=f"M{i}") for i in range(6)]
    sure = [belief(SURE, layout=f"M{i}") for i in range(6)]

    assert difference(some, some).brier.value == 0.0
    assert difference(some, sure).brier.value == pytest.approx(-difference(sure, some).brier.value)
    assert difference(some, sure).brier.value < 0.0
    with pytest.raises(ValueError, match="the same drives"):
        difference(some, sure[1:])
