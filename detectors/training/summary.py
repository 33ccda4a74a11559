"""Summaries of a training and of its results: as text, for JSON, and as a curve."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.replay.files.whole_file import write_whole

if TYPE_CHECKING:
    from .measure import NetworkResults
    from .operating_point import DetectionCounts


# Suffix of a kind's name, and heading of its column.
COLUMNS: Final = (
    ("", "AP"),
    ("50", "AP50"),
    (" small", "small"),
    (" medium", "medium"),
    (" large", "large"),
)


def measured_text(network: str, pictures: int, proposals: int, reached: NetworkResults) -> str:
    """Format a table of average precision and one of precision and recall."""
    heads = " ".join(f"{head:>6}" for _, head in COLUMNS)
    lines = [
        f"{network} on {pictures} pictures, {proposals} proposals: {reached.cpu_s:.3f} CPU s each",
        f"{'COCO AP, %':14} box {heads}   mask {heads}",
    ]
    for name in ("", *reached.rates):
        box, mask = (_row(reached.ap, kind, name) for kind in ("box", "mask"))
        lines.append(f"{name or 'all':14}     {box}        {mask}")
    for name, rates in reached.rates.items():
        lines += [_rates_line(name, aim, at) for aim, at in rates.items()]
    return "\n".join(lines)


def _row(ap: Mapping[str, float | None], kind: str, name: str) -> str:
    values = [ap.get(_key(kind, name, column)) for column, _ in COLUMNS]
    return " ".join(f"{'none' if value is None else f'{value:.1f}':>6}" for value in values)


def _key(kind: str, name: str, column: str) -> str:
    """Name of a result in ``average_precisions``: ``box50 car``, ``box car small``."""
    if column == "50":
        return f"{kind}50 {name}".rstrip()
    return f"{kind} {name}".rstrip() + column


def _rates_line(name: str, score: float, at: DetectionCounts) -> str:
    precision, recall = _fraction(at.right, at.found), _fraction(at.right, at.signs)
    return f"{name:14} score from {score:<4}  precision {precision}  recall {recall}"


def _fraction(right: int, of: int) -> str:
    return f"{100.0 * right / of:5.1f} % ({right} of {of})" if of else "none (0 of 0)"


def measured_tree(proposals: int, reached: NetworkResults) -> dict[str, object]:
    """Return the same results as a tree for JSON."""
    rates: Sequence[dict[str, object]] = [
        {"label": name, "score": score, "found": at.found, "right": at.right, "objects": at.signs}
        for name, by_score in reached.rates.items()
        for score, at in by_score.items()
    ]
    return {
        "proposals": proposals,
        "cpu_s": reached.cpu_s,
        "ap": dict(reached.ap),
        "rates": rates,
    }


def draw_curve(curve: Path, picture: Path) -> None:
    """Draw losses and average precisions over training steps.

    Args:
        curve: Curve file of the training, JSON.
        picture: PNG file to write.

    Raises:
        OutputError: The picture cannot be written.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    from .job import read_curve

    points = read_curve(curve)
    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(7, 6))
    steps = [point.step for point in points]
    above.plot(steps, [point.loss for point in points], marker=".")
    above.set_ylabel("loss")
    for name in ("box", "mask", "box50", "mask50"):
        below.plot(steps, [point.ap.get(name) for point in points], marker=".", label=name)
    below.set(xlabel="step", ylabel="average precision, %", ylim=(0, 100))
    below.legend()
    figure.tight_layout()
    write_whole(picture, lambda path: figure.savefig(path, format="png", dpi=100))
    plt.close(figure)
