"""Draw the curve of a training."""

from __future__ import annotations

from pathlib import Path

from crosscue.detectors.training.job import read_curve
from crosscue.replay.files.whole_file import write_whole


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
