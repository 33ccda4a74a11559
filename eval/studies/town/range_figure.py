"""Figures of the range study: growth of the ellipse, and fraction of drives not lost yet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.studies.pictures import COLOURS, figure, save_figure
from crosscue.localization.town.drive import DriveOutcome

from .range_study import (
    CALIBRATED_DEG,
    PREDICTED,
    PUBLISHED_M,
    CompassCase,
    CompassResult,
    loss_points,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

KM: Final = 1e-3
FIRST_GOAL_KM: Final = 25.0
NAME: Final = "range"
CHOICES: Final = "range_choices"


def draw_range_study(
    results: Sequence[CompassResult],
    rows: Sequence[dict[str, NDArray[np.float64]]],
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
    growth.set_xlim(0.0, FIRST_GOAL_KM)
    growth.set_ylim(0.0, 1.4 * limit_m)
    growth.set_xlabel("distance driven along streets (km)")
    growth.set_ylabel("2-sigma ellipse, full major axis (m)")
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


def _growth(
    axes: Axes, result: CompassResult, columns: dict[str, NDArray[np.float64]], colour: str
) -> None:
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


def _survival(
    axes: Axes, result: CompassResult, columns: dict[str, NDArray[np.float64]], colour: str
) -> None:
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
