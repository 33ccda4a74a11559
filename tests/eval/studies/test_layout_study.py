"""The study of layouts: its folds, its drives, and scores of given beliefs."""

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
from crosscue.eval.studies.layouts.score import DriveBelief, score_difference, score_layouts
from crosscue.eval.studies.layouts.settings import LayoutStudy
from crosscue.eval.studies.simulated_drives import MADE_BY, Work
from crosscue.replay.errors import UsageError

STUDY = LayoutStudy()
TRUTH = {"intersection": True, "left": True, "right": False, "straight": True}
NOTHING = {"intersection": False, "left": False, "right": False}


@pytest.mark.parametrize("feature", FEATURES)
@pytest.mark.parametrize("fold", range(STUDY.folds))
def test_every_fold_has_layouts_with_and_without_each_feature(fold: int, feature: str) -> None:
    known = [
        layout_named(name).features.get(feature)
        for name in STUDY.layouts
        if STUDY.fold_of(name) == fold
    ]

    assert {True, False} <= set(known)


def test_study_has_100_layouts_with_two_drives_each() -> None:
    scenes = STUDY.scenes()

    assert len(set(STUDY.layouts)) >= 100
    assert len(scenes) == 2 * len(STUDY.layouts)
    assert len({scene.name for scene in scenes}) == len(scenes)


def test_folds_have_about_equal_numbers_of_layouts() -> None:
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


def test_drives_become_outdated_by_code_changes_but_not_by_comments() -> None:
    plain = "def height(x):\n    return 2 * x\n"
    documented = (
        '"""Heights."""\n\n\ndef height(x):\n    """Twice as high."""\n    return 2 * x  # m\n'
    )

    assert simulated_drives.code_meaning(documented) == simulated_drives.code_meaning(plain)
    assert simulated_drives.code_meaning(plain.replace("2", "3")) != simulated_drives.code_meaning(
        plain
    )


def test_pictures_are_sparse_and_end_at_intersection() -> None:
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
    probabilities = np.tile([p.get(name, 0.5) for name in FEATURES], (n, 1))
    is_silent = np.arange(n) < silent
    start_m = np.linspace(60.0, 6.0, n) if features["intersection"] else np.full(n, np.nan)
    return DriveBelief(
        layout, layout, features, start_m, probabilities, probabilities[:, 0] > 0.9, is_silent
    )


CONFIDENT = {"intersection": 0.99, "left": 0.99, "right": 0.01, "straight": 0.99}


def test_confident_right_belief_is_full_from_first_picture() -> None:
    scored = score_layouts([belief(CONFIDENT, layout=f"M{i}") for i in range(5)])

    assert scored.brier.value == pytest.approx(1e-4)
    assert scored.full.value == 1.0
    assert scored.full_m.value == pytest.approx(60.0)
    assert scored.false_features.value == 0.0


def test_probability_one_half_has_brier_score_one_quarter() -> None:
    scored = score_layouts([belief({}), belief({}, NOTHING, "M8")])

    assert scored.brier.value == pytest.approx(0.25)
    assert scored.log_score.value == pytest.approx(np.log(2.0))


def test_false_features_are_counted_once_per_drive_except_in_silent_frames() -> None:
    wrong = {"intersection": 0.95, "left": 0.2, "right": 0.95}

    assert score_layouts([belief(wrong, NOTHING)]).false_features.value == 2.0
    assert score_layouts([belief(wrong, NOTHING, silent=10)]).false_features.value == 0.0


def test_road_established_before_intersection_is_counted() -> None:
    first = {"intersection": 0.5, "left": 0.95}

    assert score_layouts([belief(first)]).full_before_detected.value == 1.0
    assert score_layouts([belief(CONFIDENT)]).full_before_detected.value == 0.0


def test_feature_with_unknown_truth_is_not_scored() -> None:
    one = belief({"intersection": 0.0, "left": 0.0, "straight": 1.0}, NOTHING)

    assert np.isnan(score_layouts([one]).brier_by_feature["straight"].value)


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
