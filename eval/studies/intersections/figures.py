"""Figures of the intersections study: distances as in Fig. 29, beliefs as in Fig. 31."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.eval.report.scene_figures import PUBLISHED_DETECTED_M, PUBLISHED_FULL_M
from crosscue.eval.scoring.scene.approaches import ApproachResult, Curve
from crosscue.eval.scoring.scene.belief import BeliefScore
from crosscue.eval.studies.pictures import save_png

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS: Final[Mapping[str, str]] = {
    "intersection": "#444444", "left": "#1f77b4", "right": "#d62728", "straight": "#2ca02c",
}  # fmt: skip
SPREAD: Final = 0.28
FAR_M: Final = 120.0


def draw_study_distances(results: Sequence[ApproachResult], path: Path) -> None:
    """Draw distances at detection and at full detection, one point per approach.

    Approaches that were never detected are at the bottom.
    """
    names = sorted({one.intersection for one in results})

    def draw(axes: Axes) -> None:
        for kind, (colour, label, shift) in {
            "detected_m": ("#444444", "intersection", -0.12),
            "full_m": ("#1f77b4", "full intersection", 0.12),
        }.items():
            x, y, failed = [], [], []
            for number, name in enumerate(names):
                mine = [one for one in results if one.intersection == name]
                places = np.linspace(-SPREAD / 2, SPREAD / 2, len(mine)) * 0.7
                for place, one in zip(places, mine, strict=True):
                    value = getattr(one, kind)
                    at = number + shift + place * 0.6
                    if value is None:
                        failed.append(at)
                    else:
                        x.append(at)
                        y.append(value)
                found = [getattr(one, kind) for one in mine if getattr(one, kind) is not None]
                if found:
                    mean = float(np.mean(found))
                    axes.hlines(mean, number + shift - 0.14, number + shift + 0.14, colour, lw=2)
            axes.plot(x, y, "o", color=colour, ms=3.5, alpha=0.7, label=label)
            axes.plot(failed, [-3.0] * len(failed), "x", color=colour, ms=5)
        for value, colour, text in (
            (PUBLISHED_DETECTED_M, "#444444", "published mean 34.4 m"),
            (PUBLISHED_FULL_M, "#1f77b4", "published mean 16.2 m"),
        ):
            axes.axhline(value, color=colour, lw=0.8, ls=":", label=text)
        axes.set_xticks(range(len(names)), names)
        axes.set_xlabel("intersection (simulated)")
        axes.set_ylabel("distance of the rear axle, m (x: never)")
        axes.set_ylim(-7.0, None)
        axes.grid(axis="y", alpha=0.3)
        axes.legend(fontsize=7, ncols=2, loc="upper right")

    _write(path, (7.5, 4.0), draw)


def draw_beliefs(curves: Sequence[Curve], path: Path) -> None:
    """Draw probabilities over distance, with a panel per intersection and a line per drive."""
    from matplotlib.figure import Figure

    names = sorted({one.intersection for one in curves})
    columns = 4 if len(names) > 3 else max(len(names), 1)
    rows = max(-(-len(names) // columns), 1)
    figure = Figure(figsize=(2.6 * columns, 2.2 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes, name in zip(grid.ravel(), names, strict=False):
        for curve in curves:
            if curve.intersection == name:
                for feature, colour in COLOURS.items():
                    values = curve.features.get(feature)
                    if values is not None:
                        axes.plot(curve.distance_m, values, color=colour, lw=0.9, alpha=0.6)
        axes.axhline(0.9, color="#999999", lw=0.7, ls="--")
        axes.set_title(name, fontsize=9)
        axes.set_xlim(FAR_M, 0.0)
        axes.set_ylim(-0.02, 1.02)
        axes.tick_params(labelsize=7)
    for axes in grid.ravel()[len(names) :]:
        axes.axis("off")
    for feature, colour in COLOURS.items():
        grid[0, 0].plot([], [], color=colour, label=feature)
    figure.legend(loc="outside upper center", ncols=len(COLOURS), fontsize=8)
    figure.supxlabel("true distance to the intersection, m (simulated)", fontsize=8)
    figure.supylabel("probability", fontsize=8)
    save_png(figure, path)


def draw_study_reliability(
    source: Mapping[str, BeliefScore], calibrated: Mapping[str, BeliefScore] | None, path: Path
) -> None:
    """Draw the frequency of features over their probability, for one or both fusions."""
    from matplotlib.figure import Figure

    names = [name for name in COLOURS if name in source]
    figure = Figure(figsize=(2.4 * max(len(names), 1), 2.7), layout="constrained")
    grid = figure.subplots(1, max(len(names), 1), sharey=True, squeeze=False)
    for axes, name in zip(grid[0], names, strict=False):
        axes.plot([0, 1], [0, 1], color="#999999", lw=0.7, ls="--")
        for scores, colour, label in (
            (source, "#d62728", "source"),
            (calibrated, "#1f77b4", "calibrated"),
        ):
            if scores is None or name not in scores:
                continue
            some = [one for one in scores[name].reliability if one.steps]
            x = [one.mean_probability for one in some]
            y = [one.there.value for one in some]
            sizes = [12.0 + 60.0 * one.steps / max(scores[name].scored, 1) for one in some]
            axes.plot(x, y, color=colour, lw=0.8, label=label)
            axes.scatter(x, y, s=sizes, color=colour, alpha=0.6)
        axes.set_title(name, fontsize=9)
        axes.set_xlabel("held probable", fontsize=8)
        axes.tick_params(labelsize=7)
    grid[0, 0].set_ylabel("observed fraction", fontsize=8)
    grid[0, 0].legend(fontsize=7)
    save_png(figure, path)


def _write(path: Path, size: tuple[float, float], draw: object) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    assert callable(draw)
    draw(figure.subplots())
    save_png(figure, path)
