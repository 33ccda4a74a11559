"""Results and figures of the landmark study: success over distance, range, extra distance.

Strategies with the same density and rate have the same cities, starts, goals and sensor errors, so
that differences are due to the strategies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from crosscue.eval.studies.intervals import (
    ValueInterval,
    fraction_of,
    km,
    logistic,
    mean_of,
    percent,
    range_at,
    ratio_of,
    ratio_of_means,
)
from crosscue.eval.studies.pictures import COLOURS, figure, save_figure
from crosscue.eval.studies.study import PageTable
from crosscue.localization.town.drive import DriveOutcome
from crosscue.localization.town.settings import TownDrive
from crosscue.replay.columns import Floats
from crosscue.replay.safe_text import counted

from .settings import LandmarkStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUCCESS: Final = 0.8
STRAIGHT: Final = "straight to goal"
PUBLISHED_EXTRA: Final = {"landmark to landmark": 0.31, "hybrid": 0.15}
# Landmarks per km2, detection rate, and the distance that 8 of 10 field tests reached.
PUBLISHED_POINT: Final = (0.55, 0.6, 6900.0)
CITY_BORDERS_KM2: Final = (0.0, 25.0, 50.0, 75.0, 401.0)
# Density from which on the dissertation makes no claim about strategies.
DENSE_PER_KM2: Final = 10.0
KM: Final = 1e-3
BINS: Final = 7
SHOWN_RATE: Final = 0.6
NOTES: Final = (
    "Range: the straight distance from start to goal at which a logistic curve through all drives "
    "of a cell falls to 80 % success; 'beyond': not within the farthest goal in cities of at most "
    "100 km2. Intervals: 95 %, bootstrap over drives.",
    "Extra distance: ratio of the mean distances of all drives that reached the goal, as the "
    "dissertation compares averages over all drives of a strategy. It includes the effect that a "
    "strategy reaches farther goals. The column below 10 landmarks per km2 has the cells of the "
    "dissertation's statement on range; this subset was chosen after the results were known. Two "
    "columns are added: 'paired', the same seeds if both reached the goal, and 'all drives', with "
    "lost drives up to their loss.",
    "The extra distance depends on the size of cities: the dissertation has 1 to 100 km2 and does "
    "not state their distribution (here: uniform).",
    "Gains are reported only for cells where both ranges are within the "
    "farthest goal, which leaves out those in which landmarks help most.",
    "The dissertation specifies neither the landmarks' uncertainty, nor their places in a city "
    "(here: at intersections, 5 m s.d.), nor when a landmark is abandoned as a target.",
)


@dataclass(frozen=True, slots=True)
class Cell:
    """Results of one strategy, density and rate.

    Attributes:
        strategy: Name of the strategy.
        landmarks_per_km2: Density of landmarks.
        detection_rate: Detection rate of passed landmarks.
        drives: Number of drives.
        lost: Number of lost drives.
        given_up: Number of drives that neither were lost nor arrived within the longest distance.
        success: Fraction that reached the goal.
        range_m: Range at 80 % success; infinite beyond the farthest goal.
        travelled_m: Mean distance travelled.
        updates: Mean number of landmark updates.
    """

    strategy: str
    landmarks_per_km2: float
    detection_rate: float
    drives: int
    lost: int
    given_up: int
    success: ValueInterval
    range_m: ValueInterval
    travelled_m: ValueInterval
    updates: float


class CityExtra(NamedTuple):
    """Extra distance of a strategy in cities from ``min_km2`` to below ``max_km2``."""

    min_km2: float
    max_km2: float
    extra: ValueInterval


@dataclass(frozen=True, slots=True)
class StrategyComparison:
    """Comparison of a strategy with driving straight to the goal.

    Attributes:
        strategy: Name of the strategy.
        pairs: Number of pairs of drives with the same seed in which both reached the goal.
        extra_reached: Extra distance driven; 0.31 is 31 %. It is the ratio of means over all drives
            that reached the goal, and this strategy also reaches farther goals.
        extra_sparse: Extra distance over cells below 10 per km2.
        by_city: Extra distance by size of city.
        extra: Extra distance over pairs only.
        extra_all: Extra distance over all drives, with lost drives up to their loss.
        published_extra: Published extra distance; NaN if not published.
        gains_m: Range minus that of straight to goal, for cells below 10 per km2 where both are
            known.
        gain_m: Mean gain.
        beyond: Number of cells below 10 per km2 with a range beyond the farthest goal.
        more_success: Difference in the fraction that reached the goal, over all pairs of drives.
    """

    strategy: str
    pairs: int
    extra_reached: ValueInterval
    extra_sparse: ValueInterval
    by_city: tuple[CityExtra, ...]
    extra: ValueInterval
    extra_all: ValueInterval
    published_extra: float
    gains_m: tuple[float, ...]
    gain_m: float
    beyond: int
    more_success: ValueInterval


@dataclass(frozen=True, slots=True)
class LandmarkResult:
    """Results of the study.

    Attributes:
        cells: Results in the order of the study's cases.
        comparisons: Comparisons of the strategies other than straight to goal.
    """

    cells: tuple[Cell, ...]
    comparisons: tuple[StrategyComparison, ...]


def summarise_landmarks(study: LandmarkStudy, rows: Sequence[dict[str, Floats]]) -> LandmarkResult:
    """Return the results from the drives of each case; strategies are compared on the grid."""
    cases = study.cases()
    cells = tuple(_cell(case.settings, part) for case, part in zip(cases, rows, strict=True))
    grid = len(cases) - len(study.points)
    return LandmarkResult(cells, tuple(_comparisons(cells[:grid], rows[:grid])))


def _cell(settings: TownDrive, rows: dict[str, Floats]) -> Cell:
    outcome = rows["outcome"]
    reached = outcome == DriveOutcome.REACHED
    return Cell(
        strategy=settings.navigation.strategy,
        landmarks_per_km2=settings.landmarks_per_km2,
        detection_rate=settings.sensors.detection_rate,
        drives=len(outcome),
        lost=int((outcome == DriveOutcome.LOST).sum()),
        given_up=int((outcome == DriveOutcome.GIVEN_UP).sum()),
        success=fraction_of(int(reached.sum()), len(outcome)),
        range_m=range_at(rows["straight_m"], reached.astype(np.float64), SUCCESS),
        travelled_m=mean_of(rows["travelled_m"]),
        updates=float(rows["detected"].mean()),
    )


def _comparisons(
    cells: Sequence[Cell], rows: Sequence[dict[str, Floats]]
) -> list[StrategyComparison]:
    places = {(c.strategy, c.landmarks_per_km2, c.detection_rate): i for i, c in enumerate(cells)}
    strategies = [s for s in dict.fromkeys(c.strategy for c in cells) if s != STRAIGHT]
    if not any(c.strategy == STRAIGHT for c in cells):
        return []
    return [
        _comparison(
            strategy,
            [
                (i, places[(STRAIGHT, c.landmarks_per_km2, c.detection_rate)])
                for i, c in enumerate(cells)
                if c.strategy == strategy
            ],
            cells,
            rows,
        )
        for strategy in strategies
    ]


def _comparison(
    strategy: str,
    pairs: Sequence[tuple[int, int]],
    cells: Sequence[Cell],
    rows: Sequence[dict[str, Floats]],
) -> StrategyComparison:
    ours, theirs, better = [], [], []
    ways, reached = [], []
    for i, j in pairs:
        mine, straight = (rows[k]["outcome"] == DriveOutcome.REACHED for k in (i, j))
        ours.append(rows[i]["travelled_m"][mine & straight])
        theirs.append(rows[j]["travelled_m"][mine & straight])
        better.append(mine.astype(np.float64) - straight)
        ways.append(np.stack([rows[i]["travelled_m"], rows[j]["travelled_m"]]))
        reached.append(np.stack([mine, straight]).astype(np.float64))
    sparse = [(cells[i], cells[j]) for i, j in pairs if cells[i].landmarks_per_km2 < DENSE_PER_KM2]
    gains = tuple(
        mine.range_m.value - straight.range_m.value
        for mine, straight in sparse
        if math.isfinite(mine.range_m.value) and math.isfinite(straight.range_m.value)
    )
    way = np.concatenate(ours), np.concatenate(theirs)
    driven, there = np.concatenate(ways, axis=1), np.concatenate(reached, axis=1)
    per_km2 = np.repeat([cells[i].landmarks_per_km2 for i, _ in pairs], [len(w[0]) for w in ways])
    area_km2 = np.concatenate([rows[i]["area_km2"] for i, _ in pairs])
    return StrategyComparison(
        strategy=strategy,
        pairs=len(way[0]),
        extra_reached=_extra(driven, there),
        extra_sparse=_extra(driven, there * (per_km2 < DENSE_PER_KM2)),
        by_city=tuple(
            CityExtra(low, high, _extra(driven, there * ((area_km2 >= low) & (area_km2 < high))))
            for low, high in pairwise(CITY_BORDERS_KM2)
        ),
        extra=_less_one(ratio_of(*way)),
        extra_all=_less_one(ratio_of(*driven)),
        published_extra=PUBLISHED_EXTRA.get(strategy, math.nan),
        gains_m=gains,
        gain_m=float(np.mean(gains)) if gains else math.nan,
        beyond=sum(math.isinf(mine.range_m.value) for mine, _ in sparse),
        more_success=mean_of(np.concatenate(better)),
    )


def _extra(driven: Floats, there: Floats) -> ValueInterval:
    """Return the extra distance; arrays have shape (2, N): this strategy, straight to goal."""
    return _less_one(ratio_of_means(driven[0], there[0], driven[1], there[1]))


def _less_one(ratio: ValueInterval) -> ValueInterval:
    return ValueInterval(*(value - 1.0 for value in ratio))


def _published_extra(one: StrategyComparison) -> str:
    return "" if math.isnan(one.published_extra) else f"{100 * one.published_extra:.0f} %"


def tables(study: LandmarkStudy, result: LandmarkResult) -> tuple[PageTable, ...]:
    """Return the results as tables, with the published ones."""
    grid = _grid(study, result)
    by_strategy = [
        PageTable(
            f"Range at 80 % success, km: {strategy}",
            ("landmarks per km2", *(f"rate {100 * rate:.0f} %" for rate in study.detection_rates)),
            tuple(
                (
                    f"{density:g}",
                    *(
                        km(c.range_m, 1)
                        for c in grid
                        if c.strategy == strategy and c.landmarks_per_km2 == density
                    ),
                )
                for density in study.densities_per_km2
            ),
        )
        for strategy in study.strategies
    ]
    published = ("published", _published_extra)
    compared = PageTable.of(
        "Against straight to goal",
        result.comparisons,
        ("strategy", lambda c: c.strategy),
        ("drives farther by", lambda c: percent(c.extra_reached)),
        (f"below {DENSE_PER_KM2:g} per km2", lambda c: percent(c.extra_sparse)),
        published,
        ("paired", lambda c: percent(c.extra)),
        ("pairs", lambda c: str(c.pairs)),
        ("all drives", lambda c: percent(c.extra_all)),
        (
            "range gained, km",
            lambda c: (
                ""
                if math.isnan(c.gain_m)
                else f"{c.gain_m / 1e3:.1f} ({counted(len(c.gains_m), 'cell')}; {c.beyond} beyond)"
            ),
        ),
        ("published", lambda _: "1 to 2"),
        ("more drives succeed", lambda c: percent(c.more_success)),
    )
    cities = PageTable(
        "Drives farther than straight to goal, by size of city",
        (
            "strategy",
            *(f"{low:g} to {high:g} km2" for low, high in pairwise(CITY_BORDERS_KM2[:-1])),
            f"from {CITY_BORDERS_KM2[-2]:g} km2",
            "all",
            "published",
        ),
        tuple(
            (
                c.strategy,
                *("" if math.isnan(one.extra.value) else percent(one.extra) for one in c.by_city),
                percent(c.extra_reached),
                _published_extra(c),
            )
            for c in result.comparisons
        ),
    )
    points = PageTable.of(
        "Landmark to landmark, single points",
        result.cells[len(grid) :],
        ("landmarks per km2", lambda c: f"{c.landmarks_per_km2:g}"),
        ("rate", lambda c: f"{100 * c.detection_rate:.0f} %"),
        ("drives", lambda c: str(c.drives)),
        ("reached", lambda c: percent(c.success)),
        ("range at 80 %, km", lambda c: km(c.range_m, 1)),
        (
            "field test, km",
            lambda c: (
                "at least 6.9 (8 of 10)"
                if (c.landmarks_per_km2, c.detection_rate) == PUBLISHED_POINT[:2]
                else ""
            ),
        ),
    )
    return (
        *by_strategy,
        *((compared, cities) if result.comparisons else ()),
        *((points,) if points.rows else ()),
    )


def draw_landmark_study(
    study: LandmarkStudy, result: LandmarkResult, rows: Sequence[dict[str, Floats]], folder: Path
) -> list[Path]:
    """Write ``landmarks_range`` and ``landmarks_success`` as PNG and SVG; return the PNGs."""
    farthest_m = max(float(part["straight_m"].max()) for part in rows)
    rates = sorted(study.detection_rates, key=lambda rate: abs(rate - SHOWN_RATE))
    return [
        _ranges(study, result, farthest_m, folder),
        _successes(study, result, rows, rates[0], folder),
    ]


def _ranges(study: LandmarkStudy, result: LandmarkResult, farthest_m: float, folder: Path) -> Path:
    n = len(study.strategies)
    made, panels = figure(n, 4.2 * n, 4.6)
    top = farthest_m * KM
    for axes, strategy in zip(panels, study.strategies, strict=True):
        for i, density in enumerate(study.densities_per_km2):
            cells = [
                c
                for c in _grid(study, result)
                if c.strategy == strategy and c.landmarks_per_km2 == density
            ]
            _range_line(axes, cells, COLOURS[i % len(COLOURS)], top, shift=1.2 * (i - 2))
        axes.axhline(top, color="0.4", ls=":", lw=1.0)
        axes.set_title(strategy, fontsize=10)
        axes.set_xlabel("detection rate (%)")
        axes.set_ylim(0.0, 1.08 * top)
        axes.set_xlim(10.0, 110.0)
        if strategy == "landmark to landmark":
            axes.plot(
                100 * PUBLISHED_POINT[1],
                PUBLISHED_POINT[2] * KM,
                "k*",
                ms=10,
                label="field test: 0.55 per km², 60 %, 6.9 km",
            )
            for cell in result.cells[len(_grid(study, result)) :]:
                axes.plot(
                    100 * cell.detection_rate,
                    min(cell.range_m.value * KM, top),
                    "ko",
                    ms=5,
                    mfc="none",
                    label=f"simulated at {cell.landmarks_per_km2:g} per km²",
                )
            axes.legend(frameon=False, fontsize=8, loc="lower right")
    panels[0].set_ylabel("start to goal at 80 % success (km)")
    panels[0].legend(
        frameon=False, fontsize=8, title="landmarks per km²", title_fontsize=8, loc="lower right"
    )
    made.suptitle(
        "Range at 80 % success, simulated; triangles at the dotted line: beyond the farthest goal",
        fontsize=10,
    )
    return save_figure(made, folder, "landmarks_range")


def _range_line(axes: Axes, cells: Sequence[Cell], colour: str, top: float, shift: float) -> None:
    x = np.array([100 * c.detection_rate for c in cells]) + shift
    value, low, high = (
        np.minimum(np.array([getattr(c.range_m, name) for c in cells]) * KM, top)
        for name in ("value", "low", "high")
    )
    axes.errorbar(
        x,
        value,
        yerr=[np.maximum(value - low, 0.0), np.maximum(high - value, 0.0)],
        fmt="o-",
        ms=3.5,
        lw=1.3,
        capsize=2,
        elinewidth=0.8,
        color=colour,
        label=f"{cells[0].landmarks_per_km2:g}",
    )
    beyond = np.array([math.isinf(c.range_m.value) for c in cells])
    axes.plot(x[beyond], value[beyond], "^", ms=7, color=colour)


def _successes(
    study: LandmarkStudy,
    result: LandmarkResult,
    rows: Sequence[dict[str, Floats]],
    rate: float,
    folder: Path,
) -> Path:
    n = len(study.strategies)
    made, panels = figure(n, 4.2 * n, 4.2)
    for axes, strategy in zip(panels, study.strategies, strict=True):
        for i, density in enumerate(study.densities_per_km2):
            for cell, part in zip(_grid(study, result), rows, strict=False):
                if (cell.strategy, cell.landmarks_per_km2, cell.detection_rate) == (
                    strategy,
                    density,
                    rate,
                ):
                    _success(axes, part, COLOURS[i % len(COLOURS)], f"{density:g}")
        axes.axhline(0.8, color="0.3", ls="--", lw=1.0)
        axes.set_title(strategy, fontsize=10)
        axes.set_ylim(0.0, 1.03)
        axes.set_xlabel("straight distance from start to goal (km)")
    panels[0].set_ylabel("fraction of drives that reach the goal")
    panels[0].legend(frameon=False, fontsize=8, title="landmarks per km²", title_fontsize=8)
    made.suptitle(
        f"Success against distance at a detection rate of {100 * rate:.0f} %, simulated; "
        "dots: bins with 95 % intervals, lines: logistic curves",
        fontsize=10,
    )
    return save_figure(made, folder, "landmarks_success")


def _success(axes: Axes, part: dict[str, Floats], colour: str, label: str) -> None:
    distance_m = part["straight_m"]
    reached = (part["outcome"] == DriveOutcome.REACHED).astype(np.float64)
    a, b = logistic(distance_m, reached, np.ones((1, len(reached))))
    line_m = np.linspace(0.0, float(distance_m.max()), 200)
    axes.plot(
        line_m * KM,
        1.0 / (1.0 + np.exp(-(a[0] + b[0] * line_m))),
        color=colour,
        lw=1.4,
        label=label,
    )
    edges = np.linspace(0.0, float(distance_m.max()), BINS + 1)
    bins = np.clip(np.searchsorted(edges, distance_m, side="right") - 1, 0, BINS - 1)
    for k in range(BINS):
        inside = bins == k
        if not inside.any():
            continue
        fraction = fraction_of(int(reached[inside].sum()), int(inside.sum()))
        axes.errorbar(
            float(distance_m[inside].mean()) * KM,
            fraction.value,
            yerr=[
                [max(fraction.value - fraction.low, 0.0)],
                [max(fraction.high - fraction.value, 0.0)],
            ],
            fmt="o",
            ms=3,
            color=colour,
            elinewidth=0.7,
            alpha=0.8,
        )


def _grid(study: LandmarkStudy, result: LandmarkResult) -> tuple[Cell, ...]:
    return result.cells[: len(result.cells) - len(study.points)]
