"""Figure of heights against ranges with the fitted curves, and residuals by distance (Fig. 22)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from crosscue.detectors.ranging.height_to_range import RangeFit, range_of
from crosscue.eval.fit.ranges.pairs import RangePairs
from crosscue.replay.files.whole_file import write_whole

COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c")


def draw_range_fits(
    path: Path, cue: str, pairs: RangePairs, fits: list[RangeFit], tested: RangeFit | None
) -> None:
    """Write the figure as PNG.

    Args:
        path: Path of the figure.
        cue: The cue that was measured.
        pairs: Pairs that the curves were fitted to.
        fits: One fit for each family.
        tested: The best curve with its residuals on other pairs.

    Raises:
        OutputError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    what = cue.replace("_", " ")
    left.plot(pairs.height_px, pairs.range_m, ".", ms=2, color="#999999", label="pairs")
    height = np.linspace(pairs.height_px.min(), pairs.height_px.max(), 400)
    for fit, colour in zip(fits, COLOURS, strict=False):
        label = f"{fit.curve.family}, s.d. {fit.curve.residual_sd_m:.2f} m"
        left.plot(height, range_of(height, fit.curve), color=colour, lw=1.5, label=label)
    left.set(xlabel=f"height of the {what} [px]", ylabel="range to the rear axle [m]")
    left.set_ylim(0.0, 1.1 * float(pairs.range_m.max()))
    left.legend(fontsize=8)
    best = min(fits, key=lambda fit: fit.curve.residual_sd_m)
    for of, label, colour in ((best, "fitted to", COLOURS[0]), (tested, "others", COLOURS[1])):
        if of is not None:
            middle = [(b.from_m + b.to_m) / 2 for b in of.bins]
            right.plot(middle, [b.sd_m for b in of.bins], "o-", color=colour, label=label)
    right.set(xlabel="range [m]", ylabel="r.m.s. residual [m]", title=best.curve.family)
    right.set_ylim(bottom=0.0)
    right.legend(fontsize=8)
    write_whole(path, lambda place: figure.savefig(place, dpi=130, format="png"))
