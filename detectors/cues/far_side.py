"""Lane lines and vehicles past the intersection, as a Mobileye reports them: straight is a road.

Both need to know where the intersection ends; without a range there is no count, which is neutral.
The source takes its device's parked cars for outgoing ones (Fig. 26), so a vehicle counts whether
it moves or stands; what stands far to the side is in a parking lot or driveway and does not.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats
from crosscue.replay.mobileye.geometry import evaluate
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS
from crosscue.replay.vehicle.cue_spec import CueSpec
from crosscue.replay.vehicle.mobileye_cues import Past

from .mobileye_state import MobileyeState
from .rules import counts_of

_LANE: Final = {name: i for i, name in enumerate(LANE_COLUMNS)}
_OBSTACLE: Final = {name: i for i, name in enumerate(OBSTACLE_COLUMNS)}
_CUBIC: Final = [_LANE[name] for name in ("c0_m", "c1", "c2_per_m", "c3_per_m2")]


def end_of(range_m: float, *, is_end: bool, past: Past) -> float:
    """From the rear axle to the intersection's end, by the range to its end or to its start."""
    return range_m if is_end else range_m + past.intersection_length_m


class Ahead(NamedTuple):
    """What rules of Mobileye cues take.

    Attributes:
        state: What the device said last.
        end_m: From the rear axle to the intersection's end.
    """

    state: MobileyeState
    end_m: float


def past_counts(state: MobileyeState, end_m: float | None, past: Past) -> dict[str, int]:
    """How many lane lines (0 or 1) and vehicles there are past the intersection.

    Args:
        state: What the device said last.
        end_m: From the rear axle to the intersection's end; None where no range is known.
        past: When something is past it.

    Returns:
        No entry for what is unknown: no range, the end already passed, or a device that has
        not spoken lately.
    """
    if end_m is None or end_m <= 0.0:
        return {}
    return counts_of("mobileye", Ahead(state, end_m), past)


def count_lanes_past(ahead: Ahead, past: Past, cue: CueSpec) -> int | None:
    """1 where a lane line runs on past the intersection, else 0."""
    lanes = ahead.state.lanes
    return None if lanes is None else int(lanes_past(lanes, ahead.end_m, past).any())


def count_vehicles_past(ahead: Ahead, past: Past, cue: CueSpec) -> int | None:
    """Vehicles past the intersection."""
    obstacles = ahead.state.obstacles
    return None if obstacles is None else int(vehicles_past(obstacles, ahead.end_m, past).sum())


def lanes_past(
    lanes: Floats, end_m: float, past: Past
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which of M lines reach past the end, shape (M,): usable ones that run on ahead."""
    reach = end_m + past.lane_reach_m
    aside = evaluate(lanes[:, _CUBIC].T, np.full(len(lanes), reach))
    # Sides without a marking are NaN, which is on no side of anything.
    with np.errstate(invalid="ignore"):
        is_far: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
            (lanes[:, _LANE["x_end_m"]] >= reach)
            & (np.abs(aside) <= past.lane_within_y_m)
            & (lanes[:, _LANE["quality"]] >= past.lane_quality)
            & np.isin(lanes[:, _LANE["lane_type"]], past.lane_types)
        )
    return is_far


def vehicles_past(
    obstacles: Floats, end_m: float, past: Past
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which of N obstacles are vehicles past the end and on the road straight ahead, shape (N,)."""
    is_past: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
        (obstacles[:, _OBSTACLE["x_m"]] >= end_m + past.vehicle_beyond_m)
        & (np.abs(obstacles[:, _OBSTACLE["y_m"]]) <= past.vehicle_within_y_m)
        & np.isin(obstacles[:, _OBSTACLE["type"]], past.vehicle_types)
        & (obstacles[:, _OBSTACLE["valid"]] > 0)
        & (obstacles[:, _OBSTACLE["age_frames"]] >= past.vehicle_age_frames)
    )
    return is_past
