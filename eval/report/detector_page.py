"""Report of a detector's score: one HTML file without network access or scripts."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from crosscue.eval.scoring.boxes.reliability import Reliability

from .html import write_page

TEMPLATE: Final = "detector.html.j2"


def write_detector_page(
    path: Path,
    content: Mapping[str, object],
    calibration: Sequence[Reliability],
    *,
    has_figures: bool = True,
) -> None:
    """Write the report.

    Args:
        path: The output file.
        content: Values by their names in the template.
        calibration: Reliability of each class, for the diagram.
        has_figures: Draw the diagram, for which matplotlib is imported.

    Raises:
        OutputError: The file cannot be written.
    """
    figure = reliability_png(calibration) if has_figures else None
    values = {**content, "figure": figure, "calibration": calibration}
    write_page(path, TEMPLATE, values, {"number": _number, "ends": _ends})


def reliability_png(calibration: Sequence[Reliability]) -> str | None:
    """Return the reliability diagram as PNG in base64; None without any detection."""
    some = [one for one in calibration if one.detections]
    if not some:
        return None
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 6.4), dpi=110, layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=(3, 1), sharex=True)
    above.plot([0, 1], [0, 1], color="0.6", linestyle="--", linewidth=1)
    for k, one in enumerate(some):
        bins = [each for each in one.bins if each.detections]
        x, y = [each.mean_score for each in bins], [each.fraction for each in bins]
        ends = [
            [each.fraction - each.interval.low for each in bins],
            [each.interval.high - each.fraction for each in bins],
        ]
        name = f"{one.label}: error {one.error:.3f}, {one.detections:,} detections"
        above.errorbar(x, y, yerr=ends, marker="o", capsize=2, linewidth=1.2, label=name)
        width = 0.08 / len(some)
        middles = [each.low + 0.01 + (k + 0.5) * width for each in one.bins]
        below.bar(middles, [each.detections for each in one.bins], width)
    above.set(ylabel="fraction right", xlim=(0, 1), ylim=(-0.02, 1.02))
    above.legend(loc="upper left", fontsize=8)
    below.set(xlabel="score", ylabel="detections")
    for axes in (above, below):
        axes.grid(alpha=0.3)
    text = io.BytesIO()
    figure.savefig(text, format="png", metadata={"Software": ""})
    return base64.b64encode(text.getvalue()).decode()


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}f}"


def _ends(low: float, high: float) -> str:
    return "" if math.isnan(low) or math.isnan(high) else f"{low:.2f} to {high:.2f}"
