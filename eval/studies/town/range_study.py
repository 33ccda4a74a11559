"""Results and figures of the range study: major axis over distance, and distance at loss.

Each drive goes from goal to goal until its 2-sigma ellipse is longer than 100 m, or it is given up.
The published figure shows one goal per drive. Here, its point is where the drive reached its first
goal, or was lost before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.eval.scoring.consistency import mean_band
from crosscue.eval.studies.intervals import (
    ValueInterval,
    fraction_of,
    mean_of,
    measured,
    weights_of,
)
from crosscue.eval.studies.pictures import COLOURS, figure, save_figure
from crosscue.localization.town.drive import DriveOutcome, DriveResult, drive_many
from crosscue.localization.town.random_stream import key_of
from crosscue.localization.town.settings import TownDrive
from crosscue.replay.columns import Floats

from .settings import UNTIL_LOST, RangeStudy, changed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Mean distance at loss by compass 2-sigma in degrees; infinite if never lost.
PUBLISHED_M: Final = {10.0: math.inf, 20.0: 20_800.0, 30.0: 9_300.0, None: 300.0}
CALIBRATED_DEG: Final = 30.0
# Factors of the study's slip.
SLIPS: Final = (0.5, 1.0, 2.0, 3.0)
# Factors of the study's compass interval.
INTERVALS: Final = (0.6, 0.8, 0.95, 1.0, 1.25, 1.6)
# Compasses whose published range was not used for calibration and is finite.
PREDICTED: Final = (20.0, None)
# Number of the study's drives per drive of each choice.
FRACTION: Final = 10
# Block of seeds that no case of the study uses.
BLOCK: Final = 1000
CALIBRATION_SEED: Final = 424_242
CALIBRATION_DRIVES: Final = 2_000
KM: Final = 1e-3
FIRST_GOAL_KM: Final = 25.0
NAME: Final = "range"
CHOICES: Final = "range_choices"


@dataclass(frozen=True, slots=True)
class Growth:
    """Growth of the ellipse: ``axis^2 = start + linear D + square D^2``.

    Attributes:
        start_m2: Value at distance zero.
        linear_m: Coefficient of a random walk, from compass errors.
        square: Coefficient of a constant heading error.
        crossing_m: Distance at which the curve reaches the limit.
    """

    start_m2: float
    linear_m: float
    square: float
    crossing_m: ValueInterval

    def axis_m(self, distance_m: Floats) -> Floats:
        """Return the major axis at given distances."""
        axis: Floats = np.sqrt(
            self.start_m2 + self.linear_m * distance_m + self.square * distance_m**2
        )
        return axis


@dataclass(frozen=True, slots=True)
class CompassResult:
    """Results with one compass.

    Attributes:
        compass_2sigma_deg: 2-sigma error of the compass; None without a compass.
        drives: Number of drives.
        lost: Number of lost drives.
        given_up: Number of drives not lost within the longest distance.
        reached_first_goal: Number of drives that reached at least one goal before.
        lost_after_m: Mean distance at loss, of the lost drives.
        shortest_m: Shortest distance at loss; NaN without losses.
        longest_m: Longest distance at loss; NaN without losses.
        fraction_lost: Fraction of drives that were lost.
        law_m: Distance at loss when driving straight: 25^2 / (r ds); NaN without a compass.
        growth: Curve through the points of the published figure.
        nees_mean: Mean NEES of x, y, heading at the end; 3 for a consistent filter.
        nees_band: 95 % interval of such means.
        published_m: Published distance; infinite if never lost, NaN if not published.
        is_calibrated: True for the published number that a parameter was calibrated to.
    """

    compass_2sigma_deg: float | None
    drives: int
    lost: int
    given_up: int
    reached_first_goal: int
    lost_after_m: ValueInterval
    shortest_m: float
    longest_m: float
    fraction_lost: ValueInterval
    law_m: float
    growth: Growth
    nees_mean: float
    nees_band: tuple[float, float]
    published_m: float
    is_calibrated: bool


def summarise_ranges(study: RangeStudy, rows: Sequence[dict[str, Floats]]) -> list[CompassResult]:
    """Return the results by compass, in the order of the study's cases."""
    cases = zip(study.cases(), rows, strict=True)
    return [_of_case(case.settings, part) for case, part in cases]


def loss_points(rows: dict[str, Floats]) -> tuple[Floats, Floats]:
    """Return distance and major axis of each drive at its first goal, or at an earlier loss."""
    reached = ~np.isnan(rows["first_goal_m"])
    distance = np.where(reached, rows["first_goal_m"], rows["travelled_m"])
    axis = np.where(reached, rows["first_goal_axis_m"], rows["major_axis_m"])
    is_point = reached | (rows["outcome"] == DriveOutcome.LOST)
    return distance[is_point], axis[is_point]


def law_m(settings: TownDrive) -> float:
    """Return the distance at loss when driving straight, by r ds D; NaN without a compass."""
    compass = settings.sensors.compass_2sigma_deg
    if compass is None:
        return math.nan
    variance = math.radians(compass / 2.0) ** 2
    half_m = settings.navigation.lost_above_m / 4.0
    return half_m**2 / (variance * settings.sensors.compass_interval_m)


def implied_m(published_deg: float, compass_deg: float) -> float:
    """Return the mean distance at loss that a published one implies for another compass."""
    return PUBLISHED_M[published_deg] * (published_deg / compass_deg) ** 2


def calibrate(drive: TownDrive, workers: int, tolerance: float = 2e-3) -> float:
    """Find the compass interval for which the mean range at 30 degrees is the published one.

    Uses separate seeds, which no study reports, and the same seeds at each step for convergence.

    Args:
        drive: Settings of the drives; the compass is replaced.
        workers: Number of threads.
        tolerance: Relative tolerance of the mean distance.
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
            lost = rows[:, 0] == DriveOutcome.LOST
            mean_m = float(rows[lost, DriveResult._fields.index("travelled_m")].mean())
            if abs(mean_m / wanted_m - 1.0) < tolerance:
                return interval_m
            interval_m *= mean_m / wanted_m


def _of_case(settings: TownDrive, rows: dict[str, Floats]) -> CompassResult:
    sensors = settings.sensors
    n = len(rows["outcome"])
    is_lost = rows["outcome"] == DriveOutcome.LOST
    lost_m = rows["travelled_m"][is_lost]
    compass = sensors.compass_2sigma_deg
    return CompassResult(
        compass_2sigma_deg=compass,
        drives=n,
        lost=int(is_lost.sum()),
        given_up=int((rows["outcome"] == DriveOutcome.GIVEN_UP).sum()),
        reached_first_goal=int((~np.isnan(rows["first_goal_m"])).sum()),
        lost_after_m=mean_of(lost_m),
        shortest_m=float(lost_m.min()) if len(lost_m) else math.nan,
        longest_m=float(lost_m.max()) if len(lost_m) else math.nan,
        fraction_lost=fraction_of(int(is_lost.sum()), n),
        law_m=law_m(settings),
        growth=fit_growth(
            *loss_points(rows), 4.0 * sensors.start_position_sd_m, settings.navigation.lost_above_m
        ),
        nees_mean=float(rows["nees"].mean()),
        nees_band=mean_band(3, n),
        published_m=PUBLISHED_M.get(compass, math.nan),
        is_calibrated=compass == CALIBRATED_DEG,
    )


def fit_growth(distance_m: Floats, axis_m: Floats, start_m: float, limit_m: float) -> Growth:
    """Fit the growth by least squares of relative errors of axis^2, with coefficients >= 0.

    Args:
        distance_m: Shape (N,).
        axis_m: Shape (N,).
        start_m: Known axis at distance zero.
        limit_m: Limit of the axis, for the crossing.
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
    """Return the distance x at which start + linear x + square x^2 is the squared limit."""
    short = limit_m**2 - start
    if short <= 0.0:
        return 0.0
    if square > 0.0:
        return (math.sqrt(linear**2 + 4.0 * square * short) - linear) / (2.0 * square)
    return short / linear if linear > 0.0 else math.inf


@dataclass(frozen=True, slots=True)
class CompassCase:
    """Distance at loss with one slip and one compass interval.

    Attributes:
        slip_per_sqrt_m: S.d. of a wheel's path after one metre.
        compass_interval_m: Distance between readings with independent errors.
        is_studied: True for the choice of the study.
        drives: Number of drives with each compass.
        lost_after_m: Mean distance by compass 2-sigma in degrees; None is without a compass.
    """

    slip_per_sqrt_m: float
    compass_interval_m: float
    is_studied: bool
    drives: int
    lost_after_m: dict[float | None, ValueInterval]


def drive_choices(study: RangeStudy, workers: int = 2) -> tuple[CompassCase, ...]:
    """Simulate every pair of slip and interval, which takes seconds for a full study."""
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


def _choice(study: RangeStudy, pair: tuple[float, float], count: int) -> CompassCase:
    slip, interval_m = pair
    own = study.drive.sensors
    sensors = own.model_copy(update={"slip_per_sqrt_m": slip, "compass_interval_m": interval_m})
    drive = study.drive.model_copy(update={"sensors": sensors})
    seeds = np.array([key_of(study.seed, BLOCK, i) for i in range(count)], np.uint64)
    return CompassCase(
        slip_per_sqrt_m=slip,
        compass_interval_m=interval_m,
        is_studied=(slip, interval_m) == (own.slip_per_sqrt_m, own.compass_interval_m),
        drives=count,
        lost_after_m={
            compass: _lost_after(drive, compass, seeds) for compass in (CALIBRATED_DEG, *PREDICTED)
        },
    )


def _lost_after(
    drive: TownDrive, compass: float | None, seeds: np.typing.NDArray[np.uint64]
) -> ValueInterval:
    rows = drive_many(changed(drive, compass_2sigma_deg=compass, goals=UNTIL_LOST), seeds)
    lost = rows[:, DriveResult._fields.index("outcome")] == DriveOutcome.LOST
    return mean_of(rows[lost, DriveResult._fields.index("travelled_m")])


def choice_tree(choice: CompassCase) -> dict[str, object]:
    """Return a choice as in ``summary.json``, with the compass in degrees, or ``none``."""
    return {
        **asdict(choice),
        "lost_after_m": {
            "none" if compass is None else f"{compass:g}": mean
            for compass, mean in choice.lost_after_m.items()
        },
    }


def draw_range_study(
    results: Sequence[CompassResult],
    rows: Sequence[dict[str, Floats]],
    limit_m: float,
    folder: Path,
) -> Path:
    """Write ``range.png`` and ``range.svg``."""
    made, (growth, survival) = figure(2, 12.0, 4.8)
    for i, (result, columns) in enumerate(zip(results, rows, strict=True)):
        colour = COLOURS[i % len(COLOURS)]
        _growth(growth, result, columns, colour)
        _survival(survival, result, columns, colour)
    growth.axhline(limit_m, color="0.2", ls="--", lw=1.0)
    growth.set(
        xlim=(0.0, FIRST_GOAL_KM),
        ylim=(0.0, 1.4 * limit_m),
        xlabel="distance driven along streets (km)",
        ylabel="2-sigma ellipse, full major axis (m)",
    )
    growth.set_title(
        "One point per drive: at its first goal, or where it was lost before", fontsize=9
    )
    growth.legend(frameon=False, fontsize=8, loc="upper right", markerscale=4)
    survival.set_xlim(0.0, 60.0)
    survival.set_ylim(0.0, 1.02)
    survival.set_xlabel("distance driven along streets, goal after goal (km)")
    survival.set_ylabel("fraction of drives not lost yet")
    survival.set_title("Crosses: mean distance at loss; dotted: published", fontsize=9)
    made.suptitle("Range without landmarks, simulated", fontsize=11)
    return save_figure(made, folder, NAME)


def compass_name(result: CompassResult) -> str:
    """Return the compass as text."""
    degrees = result.compass_2sigma_deg
    return "no compass" if degrees is None else f"compass ±{degrees:g}° (2 sigma)"


def _growth(axes: Axes, result: CompassResult, columns: dict[str, Floats], colour: str) -> None:
    distance_m, axis_m = loss_points(columns)
    axes.plot(distance_m * KM, axis_m, ".", ms=1.5, alpha=0.35, color=colour, rasterized=True)
    curve_m = np.linspace(0.0, FIRST_GOAL_KM / KM, 400)
    axes.plot(
        curve_m * KM,
        result.growth.axis_m(curve_m),
        color=colour,
        lw=1.6,
        label=compass_name(result),
    )


def _survival(axes: Axes, result: CompassResult, columns: dict[str, Floats], colour: str) -> None:
    lost_m = np.sort(columns["travelled_m"][columns["outcome"] == DriveOutcome.LOST])
    left = 1.0 - np.arange(len(lost_m) + 1) / result.drives
    end_m = max(60_000.0, float(lost_m[-1]) if len(lost_m) else 0.0)
    axes.step(
        np.concatenate([[0.0], lost_m, [end_m]]) * KM,
        np.concatenate([left, left[-1:]]),
        where="post",
        color=colour,
        lw=1.6,
    )
    if result.lost:
        mean = result.lost_after_m
        axes.errorbar(
            mean.value * KM,
            0.5,
            xerr=[[(mean.value - mean.low) * KM], [(mean.high - mean.value) * KM]],
            fmt="x",
            color=colour,
            capsize=3,
        )
    if math.isfinite(result.published_m):
        axes.axvline(result.published_m * KM, color=colour, ls=":", lw=1.4)


def draw_choices(choices: Sequence[CompassCase], folder: Path) -> Path:
    """Write ``range_choices.png`` and ``range_choices.svg``."""
    made, axes = figure(2, 12.0, 4.6)
    for panel, compass in zip(axes, (CALIBRATED_DEG, PREDICTED[0]), strict=True):
        for i, slip in enumerate(dict.fromkeys(one.slip_per_sqrt_m for one in choices)):
            mine = [one for one in choices if one.slip_per_sqrt_m == slip]
            found = np.array([one.lost_after_m[compass] for one in mine]) / 1e3
            panel.errorbar(
                [one.compass_interval_m for one in mine],
                found[:, 0],
                np.nan_to_num(np.abs(found[:, 1:] - found[:, :1]).T),
                color=COLOURS[i % len(COLOURS)],
                marker="o",
                ms=3,
                lw=1.2,
                label=f"slip {slip:g} m per root m",
            )
        for one in choices:
            if one.is_studied:
                panel.axvline(one.compass_interval_m, color="0.6", lw=0.9)
        panel.axhline(PUBLISHED_M[compass] / 1e3, color="0.2", ls="--", lw=1.0)
        panel.set_ylim(bottom=0.0)
        panel.set_xlabel("distance between independent compass readings (m)")
        panel.set_ylabel("mean distance at loss (km)")
        role = "calibrated here" if compass == CALIBRATED_DEG else "predicted"
        panel.set_title(f"compass ±{compass:g}°: {role}; dashed: published", fontsize=9)
    axes[0].legend(frameon=False, fontsize=8)
    made.suptitle("Other choices of slip and compass interval, simulated", fontsize=11)
    return save_figure(made, folder, CHOICES)
