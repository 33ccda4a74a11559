"""Figures of the landmark study: range by rate and density, and success over distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.studies.intervals import fraction_of, logistic
from crosscue.eval.studies.pictures import COLOURS, figure, save_figure
from crosscue.localization.town.drive import DriveOutcome

from .landmark_study import PUBLISHED_POINT, Cell, LandmarkResult
from .settings import LandmarkStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KM: Final = 1e-3
BINS: Final = 7
SHOWN_RATE: Final = 0.6


def draw_landmark_study(
    study: LandmarkStudy,
    result: LandmarkResult,
    rows: Sequence[dict[str, NDArray[np.float64]]],
    folder: Path,
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
    rows: Sequence[dict[str, NDArray[np.float64]]],
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


def _success(axes: Axes, part: dict[str, NDArray[np.float64]], colour: str, label: str) -> None:
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
