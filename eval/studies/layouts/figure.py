"""Figure of the study of layouts: full detection against false features."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from crosscue.eval.studies.intersections.figures import save_figure

from .score import LayoutScore


def draw_trade_off(kinds: Mapping[str, LayoutScore], path: Path) -> None:
    """Draw full detection of each belief at the same rates of false features, with intervals.

    Raises:
        OutputError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    for number, (kind, score) in enumerate(kinds.items()):
        wanted = [one.wanted + 0.002 * number for one in score.trade]
        values = [one.full.value for one in score.trade]
        below = [max(one.full.value - one.full.low, 0.0) for one in score.trade]
        above = [max(one.full.high - one.full.value, 0.0) for one in score.trade]
        axes.errorbar(
            wanted,
            values,
            yerr=[below, above],
            label=kind,
            lw=1.0,
            elinewidth=0.4,
            marker="o",
            ms=3,
        )
    axes.set_xlabel("false features a drive, at most (simulated)", fontsize=8)
    axes.set_ylabel("fraction fully detected", fontsize=8)
    axes.set_ylim(-0.02, 1.02)
    axes.tick_params(labelsize=7)
    axes.legend(fontsize=7)
    save_figure(figure, path)
