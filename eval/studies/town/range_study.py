"""How far without landmarks: the major axis against distance, and the distance at loss.

Each drive goes from goal to goal until its 2-sigma ellipse is longer than 100 m, or it is given up.
The published figure shows one goal a drive; its point here is where the same drive reached its
first goal, or was lost before.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from itertools import product
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.consistency import mean_band
from crosscue.eval.studies.intervals import Measured, fraction_of, mean_of, measured, weights_of
from crosscue.localization.town.drive import Outcome, Result, drive_many
from crosscue.localization.town.random_stream import key_of
from crosscue.localization.town.settings import Drive

from .cases import split
from .settings import UNTIL_LOST, RangeStudy, changed

if TYPE_CHECKING:
    import pyarrow as pa

PUBLISHED_M: Final = {10.0: math.inf, 20.0: 20_800.0, 30.0: 9_300.0, None: 300.0}
"""Mean distance at loss by compass 2-sigma in degrees; infinite: never lost."""
CALIBRATED_DEG: Final = 30.0
SLIPS: Final = (0.5, 1.0, 2.0, 3.0)
"""Times the study's own."""
INTERVALS: Final = (0.6, 0.8, 0.95, 1.0, 1.25, 1.6)
"""Times the study's own."""
PREDICTED: Final = (20.0, None)
"""Compasses whose published figure was not calibrated to; infinite ones need no curve."""
FRACTION: Final = 10
"""Of the study's drives, one in so many for each choice."""
BLOCK: Final = 1000
"""Of seeds, which no case of the study uses."""
CALIBRATION_SEED: Final = 424_242
CALIBRATION_DRIVES: Final = 2_000


@dataclass(frozen=True, slots=True)
class Growth:
    """``axis^2 = start + linear D + square D^2``: the start's, the compass's, the heading's share.

    Attributes:
        start_m2: At distance zero.
        linear_m: Growth as of a random walk.
        square: Growth as of a constant heading error.
        crossing_m: Where the curve reaches the limit.
    """

    start_m2: float
    linear_m: float
    square: float
    crossing_m: Measured

    def axis_m(self, distance_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """The curve."""
        axis: NDArray[np.float64] = np.sqrt(
            self.start_m2 + self.linear_m * distance_m + self.square * distance_m**2
        )
        return axis


@dataclass(frozen=True, slots=True)
class CompassResult:
    """One compass.

    Attributes:
        compass_2sigma_deg: None: without.
        drives: How many.
        lost: Of them.
        given_up: Not lost within the longest distance.
        reached_first_goal: Reached at least one goal before.
        lost_after_m: Mean distance at loss of those lost.
        shortest_m: The soonest loss; NaN without.
        longest_m: The latest.
        fraction_lost: Of all drives.
        law_m: Straight driving: 25^2 / (r ds); NaN without compass.
        growth: Curve through the points of the published kind of figure.
        nees_mean: Of x, y, heading at the end; 3 where the filter is honest.
        nees_band: Where 95 % of such means lie.
        published_m: Infinite: never lost; NaN: not published.
        is_calibrated: The one figure that a parameter was calibrated to.
    """

    compass_2sigma_deg: float | None
    drives: int
    lost: int
    given_up: int
    reached_first_goal: int
    lost_after_m: Measured
    shortest_m: float
    longest_m: float
    fraction_lost: Measured
    law_m: float
    growth: Growth
    nees_mean: float
    nees_band: tuple[float, float]
    published_m: float
    is_calibrated: bool


def summarise(study: RangeStudy, table: pa.Table) -> list[CompassResult]:
    """Results by compass, in the order of the study's cases."""
    return [
        _of_case(case.settings, rows)
        for case, rows in zip(study.cases(), split(table), strict=True)
    ]


def points(rows: dict[str, NDArray[np.float64]]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance and major axis of each drive at its first goal, or where it was lost before."""
    reached = ~np.isnan(rows["first_goal_m"])
    distance = np.where(reached, rows["first_goal_m"], rows["travelled_m"])
    axis = np.where(reached, rows["first_goal_axis_m"], rows["major_axis_m"])
    is_point = reached | (rows["outcome"] == Outcome.LOST)
    return distance[is_point], axis[is_point]


def law_m(settings: Drive) -> float:
    """Where a car that drives straight is lost, by the law r ds D; NaN without a compass."""
    compass = settings.sensors.compass_2sigma_deg
    if compass is None:
        return math.nan
    variance = math.radians(compass / 2.0) ** 2
    half_m = settings.navigation.lost_above_m / 4.0
    return half_m**2 / (variance * settings.sensors.compass_interval_m)


def implied_m(published_deg: float, compass_deg: float) -> float:
    """The mean distance at loss that a published one implies for another compass, by r ds D."""
    return PUBLISHED_M[published_deg] * (published_deg / compass_deg) ** 2


def calibrate(drive: Drive, workers: int, tolerance: float = 2e-3) -> float:
    """The compass interval with which cars at 30 degrees are lost after the published mean.

    On seeds of its own, which no study reports. The same seeds at each step, so that it converges.

    Args:
        drive: Everything else; its compass is replaced.
        workers: Threads.
        tolerance: Relative, of the mean distance.
    """
    from concurrent.futures import ThreadPoolExecutor

    seeds = np.array(
        [key_of(CALIBRATION_SEED, i) for i in range(CALIBRATION_DRIVES)], dtype=np.uint64
    )
    parts = np.array_split(seeds, 8 * workers)
    wanted_m, interval_m = PUBLISHED_M[CALIBRATED_DEG], drive.sensors.compass_interval_m
    with ThreadPoolExecutor(workers) as pool:
        while True:
            sensors = drive.sensors.model_copy(update={"compass_interval_m": interval_m})
            settings = changed(
                drive.model_copy(update={"sensors": sensors}),
                compass_2sigma_deg=CALIBRATED_DEG,
                goals=UNTIL_LOST,
            )
            rows = np.concatenate(list(pool.map(lambda p: drive_many(settings, p), parts)))  # noqa: B023
            lost = rows[:, 0] == Outcome.LOST
            mean_m = float(rows[lost, Result._fields.index("travelled_m")].mean())
            if abs(mean_m / wanted_m - 1.0) < tolerance:
                return interval_m
            interval_m *= mean_m / wanted_m


def _of_case(settings: Drive, rows: dict[str, NDArray[np.float64]]) -> CompassResult:
    sensors = settings.sensors
    n = len(rows["outcome"])
    is_lost = rows["outcome"] == Outcome.LOST
    lost_m = rows["travelled_m"][is_lost]
    compass = sensors.compass_2sigma_deg
    return CompassResult(
        compass_2sigma_deg=compass,
        drives=n,
        lost=int(is_lost.sum()),
        given_up=int((rows["outcome"] == Outcome.GIVEN_UP).sum()),
        reached_first_goal=int((~np.isnan(rows["first_goal_m"])).sum()),
        lost_after_m=mean_of(lost_m),
        shortest_m=float(lost_m.min()) if len(lost_m) else math.nan,
        longest_m=float(lost_m.max()) if len(lost_m) else math.nan,
        fraction_lost=fraction_of(int(is_lost.sum()), n),
        law_m=law_m(settings),
        growth=fit_growth(
            *points(rows), 4.0 * sensors.start_position_sd_m, settings.navigation.lost_above_m
        ),
        nees_mean=float(rows["nees"].mean()),
        nees_band=mean_band(3, n),
        published_m=PUBLISHED_M.get(compass, math.nan),
        is_calibrated=compass == CALIBRATED_DEG,
    )


def fit_growth(
    distance_m: NDArray[np.float64], axis_m: NDArray[np.float64], start_m: float, limit_m: float
) -> Growth:
    """Least squares on relative errors of axis^2, coefficients not negative.

    Args:
        distance_m: Shape (N,).
        axis_m: Shape (N,).
        start_m: The axis at distance zero, which is known.
        limit_m: Of the axis, for the crossing.
    """
    from scipy.optimize import nnls

    scale, start_m2 = float(distance_m.max()), start_m**2
    u = distance_m / scale
    terms, wanted = np.column_stack([u, u * u]) / (axis_m**2)[:, None], 1.0 - start_m2 / axis_m**2
    weights = np.sqrt(weights_of(len(u), replicates=200))
    found = np.array([nnls(w[:, None] * terms, w * wanted)[0] for w in weights])
    crossings = np.array([_crossing(start_m2, a, b, limit_m) for a, b in found]) * scale
    linear, square = found[0]
    return Growth(
        start_m2, float(linear / scale), float(square / scale**2), measured(crossings, len(u))
    )


def _crossing(start: float, linear: float, square: float, limit_m: float) -> float:
    """Where start + linear x + square x^2 is the limit squared."""
    short = limit_m**2 - start
    if short <= 0.0:
        return 0.0
    if square > 0.0:
        return (math.sqrt(linear**2 + 4.0 * square * short) - linear) / (2.0 * square)
    return short / linear if linear > 0.0 else math.inf


@dataclass(frozen=True, slots=True)
class Choice:
    """The distance at loss with one slip and one compass interval.

    Attributes:
        slip_per_sqrt_m: S.d. of a wheel's path after one metre.
        compass_interval_m: Distance between readings with errors of their own.
        is_studied: The choice of the study itself.
        drives: With each compass.
        lost_after_m: Mean by compass 2-sigma in degrees; None without a compass.
    """

    slip_per_sqrt_m: float
    compass_interval_m: float
    is_studied: bool
    drives: int
    lost_after_m: dict[float | None, Measured]


def drive_choices(study: RangeStudy, workers: int = 2) -> tuple[Choice, ...]:
    """Drive every pair of slip and interval; seconds for a full study."""
    from concurrent.futures import ThreadPoolExecutor

    sensors, count = study.drive.sensors, max(study.drives // FRACTION, 1)
    with ThreadPoolExecutor(workers) as pool:
        return tuple(
            pool.map(
                lambda pair: _choice(study, pair, count),
                [
                    (slip * sensors.slip_per_sqrt_m, max(times * sensors.compass_interval_m, 1.0))
                    for slip, times in product(SLIPS, INTERVALS)
                ],
            )
        )


def _choice(study: RangeStudy, pair: tuple[float, float], count: int) -> Choice:
    slip, interval_m = pair
    own = study.drive.sensors
    sensors = own.model_copy(update={"slip_per_sqrt_m": slip, "compass_interval_m": interval_m})
    drive = study.drive.model_copy(update={"sensors": sensors})
    seeds = np.array([key_of(study.seed, BLOCK, i) for i in range(count)], np.uint64)
    return Choice(
        slip_per_sqrt_m=slip,
        compass_interval_m=interval_m,
        is_studied=(slip, interval_m) == (own.slip_per_sqrt_m, own.compass_interval_m),
        drives=count,
        lost_after_m={
            compass: _lost_after(drive, compass, seeds) for compass in (CALIBRATED_DEG, *PREDICTED)
        },
    )


def _lost_after(
    drive: Drive, compass: float | None, seeds: np.typing.NDArray[np.uint64]
) -> Measured:
    rows = drive_many(changed(drive, compass_2sigma_deg=compass, goals=UNTIL_LOST), seeds)
    lost = rows[:, Result._fields.index("outcome")] == Outcome.LOST
    return mean_of(rows[lost, Result._fields.index("travelled_m")])


def choice_tree(choice: Choice) -> dict[str, object]:
    """As in ``summary.json``; the compass is named in degrees, or ``none``."""
    return {
        **asdict(choice),
        "lost_after_m": {
            "none" if compass is None else f"{compass:g}": mean
            for compass, mean in choice.lost_after_m.items()
        },
    }
