"""Draw one simulated drive: streets, paths, ellipses, landmarks, goals."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.eval.studies.pictures import figure, save_figure
from crosscue.localization.ellipse import ellipses, position_cov
from crosscue.localization.town.drive import (
    GOAL_SET,
    LANDMARK_MISSED,
    LANDMARK_REFUSED,
    LANDMARK_SET,
    LANDMARK_TAKEN,
    DriveOutcome,
    Traced,
    streets_of,
)
from crosscue.localization.town.settings import TownDrive
from crosscue.localization.town.streets import Streets, has_way, node_position, step_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ELLIPSES: Final = 14
MARGIN_M: Final = 250.0
TRUTH: Final = "#2ca02c"
ESTIMATE: Final = "#1f77b4"
ELLIPSE: Final = "#ff7f0e"
ENDS: Final = {
    DriveOutcome.REACHED: "reached its goal",
    DriveOutcome.LOST: "lost",
    DriveOutcome.GIVEN_UP: "given up",
}


def draw_drive(settings: TownDrive, traced: Traced, seed: int, folder: Path) -> Path:
    """Write ``drive_plan.png`` and ``drive_plan.svg``; return the path of the PNG.

    Raises:
        OutputError: A file cannot be written.
    """
    made, (axes,) = figure(1, 9.0, 8.2)
    axes.grid(visible=False)
    _draw_streets(axes, streets_of(settings, seed))
    x, y = traced.steps[:, 0], traced.steps[:, 1]
    axes.plot(x, y, color=TRUTH, lw=3.0, alpha=0.6, label="truth")
    axes.plot(traced.steps[:, 7], traced.steps[:, 8], color=ESTIMATE, lw=1.2, label="estimate")
    rows = traced.steps[np.unique(np.linspace(0, len(x) - 1, ELLIPSES).astype(int))]
    cov_m2 = position_cov(rows[:, 10], rows[:, 11], rows[:, 13])
    for i, ring in enumerate(ellipses(rows[:, 7:9], cov_m2, 61)):
        axes.plot(*ring.T, color=ELLIPSE, lw=1.0, label="2-sigma ellipse" if i == 0 else None)
    _places(axes, traced, GOAL_SET, "*", "#d62728", 13, "goal")
    _places(axes, traced, LANDMARK_SET, "s", "0.45", 4, "landmark")
    _places(axes, traced, LANDMARK_TAKEN, "s", "k", 7, "landmark used")
    _places(axes, traced, LANDMARK_REFUSED, "X", "#9467bd", 8, "landmark rejected by the gate")
    _places(axes, traced, LANDMARK_MISSED, "s", "w", 7, "landmark passed unnoticed")
    axes.plot(x[0], y[0], "o", color="k", ms=7, mfc="w", label="start")
    axes.set_aspect("equal", adjustable="box")
    shown = np.vstack([traced.steps[:, :2], traced.of_kind(GOAL_SET)[:, 2:4]])
    middle, half_m = 0.5 * (shown.min(0) + shown.max(0)), 0.5 * np.ptp(shown, axis=0).max()
    for limits, centre in ((axes.set_xlim, middle[0]), (axes.set_ylim, middle[1])):
        limits(centre - half_m - MARGIN_M, centre + half_m + MARGIN_M)
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("y, north (m)")
    result = traced.result
    compass = settings.sensors.compass_2sigma_deg
    axes.set_title(
        f"Simulated drive, seed {seed}: {settings.navigation.strategy}, "
        f"{'no compass' if compass is None else f'compass ±{compass:g}°'}\n"
        f"{ENDS[DriveOutcome(result.outcome)]} after {result.travelled_m / 1e3:.1f} km, "
        f"error {result.error_m:.0f} m, major axis {result.major_axis_m:.0f} m",
        fontsize=9,
        loc="left",
        color="0.3",
    )
    axes.legend(frameon=True, framealpha=0.9, fontsize=8, loc="best")
    return save_figure(made, folder, "drive_plan")


def _places(
    axes: Axes, traced: Traced, kind: int, marker: str, colour: str, size: float, label: str
) -> None:
    found = traced.of_kind(kind)
    if len(found):
        axes.plot(
            found[:, 2], found[:, 3], marker, color=colour, ms=size, mec="k", mew=0.7, label=label
        )


def _draw_streets(axes: Axes, streets: Streets) -> None:
    """Draw two-way streets in grey, and one-way streets lighter."""
    from matplotlib.collections import LineCollection

    both: list[list[tuple[float, float]]] = []
    single: list[list[tuple[float, float]]] = []
    for node in range(len(streets.ways)):
        for way in range(4):
            if not has_way(streets.ways, node, way):
                continue
            there = node + step_of(way, len(streets.xs_m))
            is_both = has_way(streets.ways, there, (way + 2) % 4)
            if is_both and there < node:
                continue
            (both if is_both else single).append(
                [node_position(streets, node), node_position(streets, there)]
            )
    axes.add_collection(LineCollection(both, colors="0.78", linewidths=1.2, zorder=0))
    axes.add_collection(
        LineCollection(single, colors="0.78", linewidths=1.0, linestyles=":", zorder=0)
    )
