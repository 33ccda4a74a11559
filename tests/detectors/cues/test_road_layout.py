"""Roads by the shape of the road mask alone, for cameras that nobody calibrated."""

import math
from pathlib import Path

import numpy as np
import pytest

from crosscue.detectors import rle
from crosscue.detectors.base import RoadMask
from crosscue.detectors.cues import road_layout
from crosscue.detectors.cues.road_layout import LogOdds, RoadLayout
from crosscue.replay.errors import VehicleError
from support.road_masks import LEFT, RIGHT, ROAD, SIZE_PX, Area, mask_of, seen_from

NO_BOXES = np.zeros((0, 4))


def after(
    areas: list[Area], frames: int = 10, camera: tuple[float, float, float] = (0.8, 1.4, 0.45)
) -> tuple[bool, bool]:
    """Whether a road to the left and one to the right are seen after frames at 10 Hz."""
    layout = RoadLayout()
    found = [layout(n * 100_000_000, seen_from(areas, *camera), NO_BOXES) for n in range(frames)]
    assert all(math.isnan(one) or one == 1.0 for legs in found for one in legs)
    return found[-1].left == 1.0, found[-1].right == 1.0


@pytest.mark.parametrize("camera", [(0.8, 1.4, 0.45), (0.6, 1.3, 0.5), (0.7, 1.2, 0.55)])
def test_a_side_street_is_seen_on_its_side_whatever_the_camera(
    camera: tuple[float, float, float],
) -> None:
    assert after([ROAD], camera=camera) == (False, False)
    assert after([ROAD, RIGHT], camera=camera) == (False, True)
    assert after([ROAD, LEFT], camera=camera) == (True, False)
    assert after([ROAD, LEFT, RIGHT], camera=camera) == (True, True)


def test_ground_far_away_that_is_taken_for_road_is_no_road_to_a_side_of_a_motorway() -> None:
    motorway = [(3.0 * x, z) for x, z in ROAD]
    for first_m, last_m in ((55.0, 90.0), (60.0, 110.0)):
        far = [(0.0, first_m), (400.0, first_m), (400.0, last_m), (0.0, last_m)]
        assert after([motorway, far]) == (False, False)
        assert after([motorway, [(-x, z) for x, z in far]]) == (False, False)


def test_the_road_ahead_is_seen_only_behind_an_intersection() -> None:
    crossing, straight = RoadLayout(), RoadLayout()
    for t_ns in range(0, 10**9, 10**8):
        ahead = crossing(t_ns, seen_from([ROAD, LEFT, RIGHT], 0.8, 1.4, 0.45), NO_BOXES).straight
        alone = straight(t_ns, seen_from([ROAD], 0.8, 1.4, 0.45), NO_BOXES).straight
    assert ahead == 1.0
    assert math.isnan(alone)


@pytest.mark.parametrize(
    ("straight", "intersection", "is_believed", "is_seen"),
    [
        (3.0, 1.5, False, True),
        (3.0, 0.0, False, False),
        (3.0, 0.0, True, True),
        # The road ends at the intersection, whoever shows that.
        (2.0, 3.0, True, False),
        # The intersection that is believed is too far away.
        (3.0, -1.0, True, False),
    ],
)
def test_straight_on_is_seen_behind_an_intersection_that_other_evidence_shows(
    straight: float,
    intersection: float,
    is_believed: bool,
    is_seen: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    odds = LogOdds(-2.0, -2.0, straight, intersection)
    monkeypatch.setattr(road_layout, "log_odds", lambda *_: odds)
    layout = RoadLayout(is_believed=is_believed)
    for n in range(10):
        legs = layout(n * 100_000_000, seen_from([ROAD], 0.8, 1.4, 0.45), NO_BOXES)
    assert (legs.straight == 1.0) is is_seen
    assert math.isnan(legs.left)
    layout.restart()
    assert not layout.is_believed


def test_a_side_street_of_one_frame_is_none() -> None:
    layout = RoadLayout()
    for n in range(10):
        areas = [ROAD, RIGHT] if n == 7 else [ROAD]
        legs = layout(n * 100_000_000, seen_from(areas, 0.8, 1.4, 0.45), NO_BOXES)
        assert math.isnan(legs.right), n
    assert after([ROAD, RIGHT], frames=3) == (False, False)


def test_nothing_is_remembered_after_a_restart() -> None:
    layout = RoadLayout()
    for n in range(10):
        layout(n * 100_000_000, seen_from([ROAD, RIGHT], 0.8, 1.4, 0.45), NO_BOXES)
    layout.restart()
    legs = layout(1_100_000_000, seen_from([ROAD, RIGHT], 0.8, 1.4, 0.45), NO_BOXES)
    assert all(map(math.isnan, legs))


def test_a_picture_without_road_shows_nothing() -> None:
    layout = RoadLayout()
    for n in range(10):
        legs = layout(n * 100_000_000, mask_of(np.zeros(SIZE_PX[::-1], np.bool_)), NO_BOXES)
        assert all(map(math.isnan, legs))


def test_bars_beside_the_picture_change_nothing() -> None:
    """A picture of another shape in the middle shows the same roads as without its bars."""
    for areas in ([ROAD], [ROAD, RIGHT], [ROAD, LEFT, RIGHT]):
        whole, within = RoadLayout(), RoadLayout()
        # Another recording before, without bars.
        within(-(10**9), mask_of(np.ones(SIZE_PX[::-1], np.bool_)), NO_BOXES)
        within.restart()
        for n in range(10):
            mask = seen_from(areas, 0.8, 1.4, 0.45)
            # A column more or less is the compression's.
            wide = np.pad(mask.pixels(), ((0, 0), (90, 90 + n % 2)))
            size = (SIZE_PX[0] + 180 + n % 2, SIZE_PX[1])
            barred = RoadMask(
                0, (SIZE_PX[0] + 180, SIZE_PX[1]), rle.encode_mask(wide, (0, 0), size), size
            )
            box = np.array([[300.0, 170.0, 340.0, 220.0]])
            whole(n * 100_000_000, mask, box)
            within(n * 100_000_000, barred, box + np.array([90.0, 0.0, 90.0, 0.0]))
        assert whole.mean is not None
        assert within.mean == pytest.approx(whole.mean, abs=0.3)


def test_a_damaged_network_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = bytearray(road_layout.WEIGHTS.read_bytes())
    content[len(content) // 2] ^= 1
    (tmp_path / "road_layout.onnx").write_bytes(content)
    monkeypatch.setattr(road_layout, "WEIGHTS", tmp_path / "road_layout.onnx")
    road_layout.network.cache_clear()
    with pytest.raises(VehicleError, match=r"road_layout\.onnx: damaged; install crosscue again$"):
        after([ROAD], frames=1)
