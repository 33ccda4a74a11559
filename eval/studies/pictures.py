"""Draw and save a study's figures; the same rows yield the same bytes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.files.whole_file import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI: Final = 130
COLOURS: Final = ("#2ca02c", "#1f77b4", "#d62728", "#7f7f7f", "#9467bd", "#8c564b", "#e377c2")


def bare_figure(size: tuple[float, float], *grid: int, **shared: Any) -> tuple[Figure, Any]:
    """Return a figure and its axes; ``grid`` and ``shared`` are those of ``Figure.subplots``."""
    from matplotlib.figure import Figure

    made = Figure(figsize=size, layout="constrained")
    axes: Any = made.subplots(*grid, **shared)
    return made, axes


def figure(columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with a grid in axes side by side."""
    made, rows = bare_figure((width, height), 1, columns, squeeze=False)
    axes = rows[0]
    for one in axes:
        one.grid(alpha=0.3)
        for side in ("top", "right"):
            one.spines[side].set_visible(False)
    return made, list(axes)


def save_figure(made: Figure, folder: Path, name: str) -> Path:
    """Write ``NAME.png`` and ``NAME.svg``; return the path of the PNG.

    Raises:
        OutputError: A file cannot be written.
    """
    from matplotlib import rc_context

    formats: dict[str, dict[str, Any]] = {
        # The library's time stamps would make the bytes differ.
        "png": {"dpi": DPI, "metadata": {"Software": ""}},
        "svg": {"metadata": {"Date": None, "Creator": None}},
    }
    with rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        for kind, options in formats.items():
            write_whole(
                folder / f"{name}.{kind}",
                lambda p, k=kind, o=options: made.savefig(p, format=k, **o),  # type: ignore[misc]
            )
    return folder / f"{name}.png"


def save_png(made: Figure, path: Path) -> None:
    """Write a figure as PNG alone.

    Raises:
        OutputError: The file cannot be written.
    """
    # Without time and version in the file, the same study yields the same bytes.
    write_whole(
        path,
        lambda partial: made.savefig(partial, format="png", dpi=DPI, metadata={"Software": None}),
    )
