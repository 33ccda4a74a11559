"""Cues for a road straight ahead: a Mobileye's lane lines and vehicles past the intersection.

Both cues require the position of the intersection's end; without a range there is no count, which
is neutral. The dissertation counts its device's parked cars as outgoing ones (Fig. 26), so a
vehicle counts whether or not it moves. A vehicle far to the side is in a parking lot or driveway
and does not count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.mobileye.geometry import evaluate
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS, Samples
from crosscue.replay.vehicle.cue_spec import CueSpec
from crosscue.replay.vehicle.mobileye_cues import Past

from .rules import counts_of

_LANE: Final = {name: i for i, name in enumerate(LANE_COLUMNS)}
_OBSTACLE: Final = {name: i for i, name in enumerate(OBSTACLE_COLUMNS)}
_CUBIC: Final = [_LANE[name] for name in ("c0_m", "c1", "c2_per_m", "c3_per_m2")]


@dataclass(frozen=True, slots=True, eq=False)
class MobileyeState:
    """Last complete burst of obstacles, and last lane line of each side.

    Attributes:
        obstacles: Shape (N, 8), ``OBSTACLE_COLUMNS``; no rows if the device sees no obstacle, None
            without a recent message.
        lanes: Shape (M, 8), ``LANE_COLUMNS``; None without a recent message.
    """

    obstacles: NDArray[np.float64] | None
    lanes: NDArray[np.float64] | None


def state_at(
    obstacles: Samples | None, lanes: Samples | None, t_ns: int, past: Past
) -> MobileyeState:
    """Return the device's state at ``t_ns``, from bursts that are complete and recent.

    Args:
        obstacles: Rows of ``Signal.MOBILEYE_OBSTACLES``, in order of time.
        lanes: Rows of ``Signal.MOBILEYE_LANES``, in order of time.
        t_ns: Log time.
        past: Duration of a burst and its maximum age.
    """
    newest = t_ns - round(past.settles_s * 1e9)
    oldest = t_ns - round(past.max_age_s * 1e9)
    return MobileyeState(
        _last_burst(_between(obstacles, oldest, newest), past),
        _last_lanes(_between(lanes, oldest, newest)),
    )


def _between(samples: Samples | None, oldest_ns: int, newest_ns: int) -> Samples | None:
    if samples is None:
        return None
    low = int(np.searchsorted(samples.t_ns, oldest_ns, side="left"))
    high = int(np.searchsorted(samples.t_ns, newest_ns, side="right"))
    if low >= high:
        return None
    return Samples(samples.signal, samples.t_ns[low:high], samples.values[low:high])


def _last_burst(samples: Samples | None, past: Past) -> NDArray[np.float64] | None:
    if samples is None:
        return None
    values = samples.values
    last = values[:, _OBSTACLE["burst"]] == values[-1, _OBSTACLE["burst"]]
    if values[-1, _OBSTACLE["burst"]] < 0:
        # Without a status message, the messages of one image are close in time.
        last = samples.t_ns > samples.t_ns[-1] - round(past.settles_s * 1e9)
    found: NDArray[np.float64] = values[last & np.isfinite(values[:, _OBSTACLE["x_m"]])]
    return found


def _last_lanes(samples: Samples | None) -> NDArray[np.float64] | None:
    if samples is None:
        return None
    sides = samples.values[:, _LANE["side"]]
    rows = [int(np.flatnonzero(sides == side)[-1]) for side in np.unique(sides)]
    found: NDArray[np.float64] = samples.values[rows]
    return found


def end_of(range_m: float, *, is_end: bool, past: Past) -> float:
    """Distance from the rear axle to the intersection's end, from a range to its end or start."""
    return range_m if is_end else range_m + past.intersection_length_m


class Ahead(NamedTuple):
    """Input of the rules of Mobileye cues.

    Attributes:
        state: Last state of the device.
        end_m: Distance from the rear axle to the intersection's end.
    """

    state: MobileyeState
    end_m: float


def past_counts(state: MobileyeState, end_m: float | None, past: Past) -> dict[str, int]:
    """Count lane lines (0 or 1) and vehicles past the intersection.

    Args:
        state: Last state of the device.
        end_m: Distance from the rear axle to the intersection's end; None where unknown.
        past: Conditions for being past the intersection.

    Returns:
        Counts by cue. A cue is missing if its count is unknown: without a range, after the
        intersection, or without a recent message of the device.
    """
    if end_m is None or end_m <= 0.0:
        return {}
    found = counts_of("mobileye", Ahead(state, end_m), past)
    return {cue: one.number for cue, one in found.items() if one.number is not None}


def count_lanes_past(ahead: Ahead, past: Past, cue: CueSpec) -> int | None:
    """Return 1 if a lane line continues past the intersection, else 0."""
    lanes = ahead.state.lanes
    return None if lanes is None else int(lanes_past(lanes, ahead.end_m, past).any())


def count_vehicles_past(ahead: Ahead, past: Past, cue: CueSpec) -> int | None:
    """Count vehicles past the intersection."""
    obstacles = ahead.state.obstacles
    return None if obstacles is None else int(vehicles_past(obstacles, ahead.end_m, past).sum())


def lanes_past(
    lanes: NDArray[np.float64], end_m: float, past: Past
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Mark the usable lane lines that continue past the intersection's end, shape (M,)."""
    reach = end_m + past.lane_reach_m
    aside = evaluate(lanes[:, _CUBIC].T, np.full(len(lanes), reach))
    # Sides without a marking are NaN, so every comparison with them is false.
    with np.errstate(invalid="ignore"):
        is_far: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
            (lanes[:, _LANE["x_end_m"]] >= reach)
            & (np.abs(aside) <= past.lane_within_y_m)
            & (lanes[:, _LANE["quality"]] >= past.lane_quality)
            & np.isin(lanes[:, _LANE["lane_type"]], past.lane_types)
        )
    return is_far


def vehicles_past(
    obstacles: NDArray[np.float64], end_m: float, past: Past
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Mark the obstacles that are vehicles past the end, on the road straight ahead, shape (N,)."""
    is_past: np.ndarray[tuple[int], np.dtype[np.bool_]] = (
        (obstacles[:, _OBSTACLE["x_m"]] >= end_m + past.vehicle_beyond_m)
        & (np.abs(obstacles[:, _OBSTACLE["y_m"]]) <= past.vehicle_within_y_m)
        & np.isin(obstacles[:, _OBSTACLE["type"]], past.vehicle_types)
        & (obstacles[:, _OBSTACLE["valid"]] > 0)
        & (obstacles[:, _OBSTACLE["age_frames"]] >= past.vehicle_age_frames)
    )
    return is_past
