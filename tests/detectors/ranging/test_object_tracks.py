"""Tests of object tracks over frames: each track has only the heights of its object."""

from collections.abc import Sequence

import numpy as np
import pytest

from crosscue.detectors.ranging.object_tracks import CarStep, Facing, ObjectTrack, ObjectTracks
from crosscue.detectors.ranging.standard_sizes import light_size
from crosscue.replay.columns import Floats

FOCAL_PX = 1500.0
CENTER_PX = (960.0, 540.0)
AHEAD = CarStep(1.0, 0.0, 0.0, 0.1)
# Range at the start, metres to the right and up, height.
Light = tuple[float, float, float, float]
NEAR: Light = (57.0, -5.0, 5.0, 1.3)
FAR: Light = (84.0, 0.0, 5.0, 1.0)
NEXT_TO_FAR: Light = (84.0, 4.0, 5.0, 1.5)


def tracks() -> ObjectTracks:
    return ObjectTracks("traffic_light", FOCAL_PX, CENTER_PX)


def box_of(light: Light, gone_m: float, turned_rad: float = 0.0) -> Floats:
    start_m, right_m, up_m, height_m = light
    scale = FOCAL_PX / (start_m - gone_m)
    x = CENTER_PX[0] + right_m * scale + FOCAL_PX * turned_rad
    y = CENTER_PX[1] - up_m * scale
    half = 0.5 * height_m * scale
    return np.array([x - 0.4 * half, y - half, x + 0.4 * half, y + half])


def take(
    followed: ObjectTracks, lights: Sequence[Light], gone_m: float, motion: CarStep = AHEAD
) -> Sequence[ObjectTrack]:
    boxes = np.array([box_of(one, gone_m) for one in lights]).reshape(-1, 4)
    return followed(motion, boxes, boxes[:, 3] - boxes[:, 1])


def test_several_lights_have_separate_tracks_and_ranges() -> None:
    followed = tracks()
    rng = np.random.default_rng(4)
    for gone_m in range(40):
        order = rng.permutation(3)
        now = take(followed, [(NEAR, FAR, NEXT_TO_FAR)[i] for i in order], float(gone_m))

    assert [one.seen for one in now] == [40, 40, 40]
    assert sorted(one.range_m for one in now) == pytest.approx([18.0, 45.0, 45.0], rel=0.06)
    heights = sorted(one.estimate.height_m for one in now)
    assert heights == pytest.approx([1.0, 1.3, 1.5], rel=0.06)


def test_near_light_narrows_the_size_of_a_far_one_of_the_same_make() -> None:
    near: Light = (45.0, -5.0, 5.0, 1.5)
    far: Light = (140.0, 2.0, 5.0, 1.5)
    alone, together = tracks(), tracks()
    for gone_m in range(25):
        (one,) = take(alone, [far], float(gone_m))
        both = take(together, [near, far], float(gone_m))

    true_m = 140.0 - 24.0
    shared = max(both, key=lambda track: track.range_m)
    assert abs(shared.range_m - true_m) < 0.5 * abs(one.range_m - true_m)
    assert shared.var_m2 < 0.6 * one.var_m2
    assert shared.alone == one.alone


def test_two_boxes_of_one_object_make_one_track() -> None:
    followed = tracks()
    box = box_of(FAR, 0.0)
    boxes = np.array([box, box + 1.0])

    now = followed(AHEAD, boxes, boxes[:, 3] - boxes[:, 1])

    assert len(now) == 1
    assert followed.counts["boxes of an object already found"] == 1


@pytest.mark.parametrize(
    ("lenses", "facing"),
    [
        (["red"], Facing.UNKNOWN),
        (["red", "dark", "green"], Facing.EGO),
        (["dark"] * 9, Facing.UNKNOWN),
        (["dark"] * 10, Facing.AWAY),
        (["unknown"] * 30, Facing.UNKNOWN),
        ([""] * 30, Facing.UNKNOWN),
        (["dark"] * 28 + ["red"], Facing.AWAY),
        (["dark"] * 18 + ["red"] * 2, Facing.UNKNOWN),
        (["dark"] * 8 + ["green"] * 2, Facing.EGO),
        (["yellow"] * 30, Facing.UNKNOWN),
        (["dark"] * 10 + ["yellow"] * 5, Facing.UNKNOWN),
        (["dark"] * 19 + ["yellow"], Facing.AWAY),
    ],
)
def test_facing_requires_enough_consistent_frames(lenses: list[str], facing: Facing) -> None:
    followed = tracks()
    for gone_m, lens in enumerate(lenses):
        box = box_of(FAR, float(gone_m))[None, :]
        (track,) = followed(AHEAD, box, box[:, 3] - box[:, 1], [lens])

    assert track.facing is facing


def test_range_without_odometry_relies_on_the_size_prior() -> None:
    followed = tracks()
    for gone_m in range(20):
        (track,) = take(followed, [FAR], float(gone_m), CarStep(None, 0.0, 0.0, 0.1))

    height_px = FOCAL_PX * FAR[3] / (84.0 - 19.0)
    size = light_size(2.5)
    alone_m = FOCAL_PX * size.mean_m / height_px
    assert track.seen == 20
    assert track.range_m == pytest.approx(alone_m, rel=0.1)
    assert np.sqrt(track.var_m2) == pytest.approx(size.spread * track.range_m, rel=0.2)
