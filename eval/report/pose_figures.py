"""Figures of a pose track compared with its truth."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.eval.runs.tables.log_time import broken_at
from crosscue.eval.scoring.consistency import mean_band
from crosscue.eval.scoring.pose.score import ScoredPoses
from crosscue.replay.columns import Floats
from crosscue.replay.files.whole_file import write_whole

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ESTIMATE: Final = "#1f77b4"
TRUTH: Final = "#2ca02c"
BAND: Final = "#ff7f0e"
ELLIPSES: Final = 12


def draw_all(poses: ScoredPoses, folder: Path) -> list[Path]:
    """Write the figures as PNG files and return their paths; NEES only if it is defined."""
    jobs: dict[str, tuple[Callable[[Axes, ScoredPoses], None], tuple[float, float]]] = {
        "pose_plan.png": (_plan, (7.0, 6.0)),
        "pose_error.png": (_error, (7.0, 3.4)),
        "pose_heading.png": (_heading, (7.0, 3.4)),
        "pose_nees.png": (_nees, (7.0, 3.4)),
        "pose_major_axis.png": (_major_axis, (7.0, 3.4)),
    }
    if not np.isfinite(poses.nees).any():
        del jobs["pose_nees.png"]
        (folder / "pose_nees.png").unlink(missing_ok=True)
    return [_draw(folder / name, paint, poses, size) for name, (paint, size) in jobs.items()]


def _draw(
    path: Path,
    paint: Callable[[Axes, ScoredPoses], None],
    poses: ScoredPoses,
    size: tuple[float, float],
) -> Path:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    paint(axes, poses)
    axes.set_title(poses.title, fontsize=9, loc="left", color="0.35", parse_math=False)
    axes.grid(alpha=0.3)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)

    def save(partial: Path) -> None:
        # The library's own stamp would change the bytes with its version.
        figure.savefig(partial, dpi=130, format="png", metadata={"Software": ""})

    with warnings.catch_warnings():
        # The title may have characters that the font lacks.
        warnings.filterwarnings("ignore", "Glyph")
        write_whole(path, save)
    return path


def _broken(poses: ScoredPoses, *columns: Floats) -> tuple[Floats, ...]:
    """Return columns with NaN between two rows that a gap of the drive separates."""
    rows = broken_at(poses.gaps, poses.t_ns)
    return tuple(np.insert(np.asarray(one, np.float64), rows, np.nan) for one in columns)


def _time_axis(axes: Axes, poses: ScoredPoses) -> None:
    """Label the axis in seconds; shade each gap of the drive and label it with its length."""
    first_ns, last_ns = int(poses.t_ns[0]), int(poses.t_ns[-1])
    axes.set_xlim(0.0, float(poses.seconds[-1]))
    shown = [one for one in poses.gaps if first_ns <= one.middle_ns <= last_ns]
    is_shortened = False
    for one in shown:
        ends_s = poses.shown_s(np.array([one.start_ns, one.end_ns], np.int64))
        is_shortened |= float(np.ptp(ends_s)) < (one.end_ns - one.start_ns) * 0.999e-9
        axes.axvspan(*ends_s.tolist(), color="0.5", alpha=0.18, lw=0)
        axes.text(
            float(ends_s.mean()),
            0.5,
            one.text,
            transform=axes.get_xaxis_transform(),
            rotation=90,
            ha="center",
            va="center",
            fontsize=8,
            color="0.3",
        )
    axes.set_xlabel("time (s), long gaps shortened" if is_shortened else "time (s)")


def _plan(axes: Axes, poses: ScoredPoses) -> None:
    axes.plot(*_broken(poses, *poses.truth_m.T), color=TRUTH, lw=3, alpha=0.6, label="truth")
    axes.plot(*_broken(poses, *poses.estimate_m.T), color=ESTIMATE, lw=1.2, label="estimate")
    rows = np.unique(np.linspace(0, len(poses.t_ns) - 1, ELLIPSES).astype(int))
    for i, row in enumerate(rows):
        ring = _ellipse(poses.estimate_m[row], poses.cov[row, :2, :2])
        axes.plot(*ring, color=BAND, lw=0.8, label="2-sigma ellipse" if i == 0 else None)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, east (m)")
    axes.set_ylabel("y, north (m)")
    axes.legend(frameon=False)


def _ellipse(centre: Floats, cov: Floats) -> Floats:
    angle = np.linspace(0.0, 2.0 * np.pi, 61)
    values, vectors = np.linalg.eigh(cov)
    axes = vectors * (2.0 * np.sqrt(np.maximum(values, 0.0)))
    ring: Floats = axes @ np.stack([np.cos(angle), np.sin(angle)]) + centre[:, None]
    return ring


def _error(axes: Axes, poses: ScoredPoses) -> None:
    error = np.linalg.norm(poses.estimate_m - poses.truth_m, axis=1)
    claimed = 2.0 * np.sqrt(np.linalg.eigvalsh(poses.cov[:, :2, :2])[:, 1])
    seconds, claimed, error = _broken(poses, poses.seconds, claimed, error)
    axes.fill_between(seconds, 0.0, claimed, color=BAND, alpha=0.25, lw=0, label="2 sigma")
    axes.plot(seconds, error, color=ESTIMATE, lw=1.2, label="position error")
    axes.set_ylim(bottom=0.0)
    _time_axis(axes, poses)
    axes.set_ylabel("metres")
    axes.legend(frameon=False)


def _heading(axes: Axes, poses: ScoredPoses) -> None:
    claimed = np.rad2deg(2.0 * np.sqrt(poses.cov[:, 2, 2]))
    error = np.rad2deg(poses.heading_error_rad)
    seconds, claimed, error = _broken(poses, poses.seconds, claimed, error)
    axes.fill_between(seconds, -claimed, claimed, color=BAND, alpha=0.25, lw=0, label="2 sigma")
    axes.plot(seconds, error, color=ESTIMATE, lw=1.2, label="heading error")
    _time_axis(axes, poses)
    axes.set_ylabel("degrees")
    axes.legend(frameon=False)


def _nees(axes: Axes, poses: ScoredPoses) -> None:
    low, high = mean_band(3, 1)
    axes.axhspan(low, high, color=BAND, alpha=0.2, lw=0, label="95 % band of chi-square(3)")
    axes.plot(
        *_broken(poses, poses.seconds, poses.nees),
        color=ESTIMATE,
        lw=1.0,
        label="NEES of x, y, heading",
    )
    axes.set_yscale("log")
    _time_axis(axes, poses)
    axes.legend(frameon=False)


def _major_axis(axes: Axes, poses: ScoredPoses) -> None:
    columns = _broken(poses, poses.travelled_m, poses.major_axis_m)
    axes.plot(*columns, color=ESTIMATE, lw=1.4)
    axes.axhline(poses.lost_above_m, color="0.3", ls="--", lw=1.0)
    axes.annotate(
        "lost above this",
        (0.0, poses.lost_above_m),
        xytext=(4, 3),
        textcoords="offset points",
        fontsize=8,
        color="0.3",
    )
    axes.set_ylim(bottom=0.0)
    axes.set_xlim(left=0.0)
    axes.set_xlabel("distance travelled (m)")
    axes.set_ylabel("2-sigma ellipse, full major axis (m)")
