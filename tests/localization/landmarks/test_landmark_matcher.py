"""Tests of landmark matchers on simulated walls and on some real pictures."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.localization.landmarks.features import CameraGeometry, make_matcher
from crosscue.localization.landmarks.images import grey_of, read_encoded
from crosscue.localization.landmarks.matcher import OrbMatcher, OrbSettings
from crosscue.replay.errors import UsageError
from support.data import shared
from support.landmark_files import seen_from, some_features, wall

CAMERA = CameraGeometry(500.0)
ORB = OrbMatcher(OrbSettings())
NAMES = ("orb", "orb-essential")


@pytest.mark.parametrize("name", NAMES)
def test_wall_matches_itself_and_no_other_wall(name: str) -> None:
    matcher = make_matcher(name, CAMERA)
    here = matcher.describe(wall(1))
    again = matcher.describe(seen_from(wall(1), turn_deg=8.0, scale=1.15, noise=4.0, seed=3))
    others = [matcher.describe(wall(seed)) for seed in (2, 3, 4)]

    same = matcher.match(again, here)
    assert same.score > 60
    assert same.agreeing <= same.pairs
    assert all(matcher.match(other, here).score < 20 for other in others)


@pytest.mark.parametrize("name", NAMES)
def test_matching_is_deterministic(name: str) -> None:
    first, second = make_matcher(name, CAMERA), make_matcher(name, CAMERA)
    near, far = seen_from(wall(1), 20.0, 0.7, 8.0, 3), wall(1)

    matches = [m.match(m.describe(near), m.describe(far)) for m in (first, second, first)]
    assert matches[0] == matches[1] == matches[2]


@given(st.integers(0, 1000), st.integers(0, 60), st.integers(0, 60))
@settings(max_examples=30)
def test_random_features_of_any_count_can_be_matched(seed: int, one: int, other: int) -> None:
    match = ORB.match(some_features(seed, one), some_features(seed + 1, other))

    assert 0 <= match.agreeing <= match.pairs <= min(one, other)


def test_custom_matcher_is_named_by_module_and_factory() -> None:
    made = make_matcher("crosscue.localization.landmarks.matcher:orb_essential", CAMERA)

    assert made.kind == "orb"
    with pytest.raises(UsageError, match="there are: orb, orb-essential, or module:factory"):
        make_matcher("sift")
    with pytest.raises(UsageError, match="No module named 'no_such_module'"):
        make_matcher("no_such_module:factory")
    with pytest.raises(UsageError, match="no attribute 'nothing'"):
        make_matcher("crosscue.localization.landmarks.matcher:nothing")
    with pytest.raises(UsageError, match=r"needs camera\.focal_px"):
        make_matcher("orb-essential")
    with pytest.raises(UsageError, match="a factory accepts a CameraGeometry"):
        make_matcher("os:getcwd")
    with pytest.raises(UsageError, match="has no kind"):
        make_matcher("builtins:repr")


def test_real_street_pictures_match_only_their_neighbours() -> None:
    """KITTI, frames at intervals of about 1 m, in a turn of 98 degrees."""
    folder = shared("sequences", "kitti_seq2_right_turn_98deg", "image_l")
    seen = [ORB.describe(grey_of(read_encoded(folder / f"{i:06d}.png"))) for i in (0, 3, 47, 50)]

    assert ORB.match(seen[0], seen[1]).score > 100
    assert ORB.match(seen[2], seen[3]).score > 100
    assert max(ORB.match(seen[i], seen[j]).score for i in (0, 1) for j in (2, 3)) < 12


@pytest.mark.parametrize("size", [(31, 31), (1, 1), (3000, 40), (40, 3000)])
def test_features_of_any_picture_size_are_in_its_pixels(size: tuple[int, int]) -> None:
    width, height = size
    features = ORB.describe(wall(5, width, height))

    assert (features.width_px, features.height_px) == size
    if len(features):
        assert (features.points_px <= [width, height]).all()
        assert features.points_px.max() > 0.5 * max(size)
