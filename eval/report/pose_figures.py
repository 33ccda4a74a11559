"""Charts of a pose track: on a map, and over the distance travelled."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from markupsafe import Markup

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.log_time import ClockGap, broken_at
from crosscue.eval.scoring.consistency import mean_band
from crosscue.eval.scoring.pose.score import ScoredPoses
from crosscue.localization.ellipse import ellipses, position_cov
from crosscue.replay.columns import Floats, Int64s

from .scene_figures import WIDTH, shade_gaps
from .svg_plot import Panel, SvgChart, equal_scales, thinned

ELLIPSES: Final = 12
HEIGHT: Final = 150.0
MAX_MAP: Final = 420.0


class Figure(NamedTuple):
    """A chart with its caption."""

    svg: Markup
    caption: str


class Track(NamedTuple):
    """An estimated track, and the true one where it is known.

    Attributes:
        t_ns: Shape (N,).
        estimate_m: Shape (N, 2): east and north.
        truth_m: Shape (N, 2), or None.
        cov_m2: Shape (N, 2, 2): covariance of the position.
        gaps: Gaps of the drive.
    """

    t_ns: Int64s
    estimate_m: Floats
    truth_m: Floats | None
    cov_m2: Floats
    gaps: Sequence[ClockGap]


def pose_figures(poses: ScoredPoses) -> tuple[Figure, ...]:
    """Draw a scored pose: the map, errors over the distance, and NEES where it is defined."""
    track = Track(poses.t_ns, poses.estimate_m, poses.truth_m, poses.cov[:, :2, :2], poses.gaps)
    error_m = np.linalg.norm(poses.estimate_m - poses.truth_m, axis=1)
    sd_m = np.sqrt(np.maximum(np.linalg.eigvalsh(track.cov_m2)[:, 1], 0.0))
    heading_sd = np.sqrt(np.maximum(poses.cov[:, 2, 2], 0.0))
    found = [
        Figure(draw_map(track), "True and estimated track, with twelve 2-sigma ellipses."),
        Figure(
            _over_distance(poses, "Position error (m)", error_m, (0.0 * sd_m, 2.0 * sd_m)),
            "Distance from the truth, and the filter's 2-sigma band.",
        ),
        Figure(
            _over_distance(
                poses,
                "Heading error (deg)",
                np.rad2deg(poses.heading_error_rad),
                (np.rad2deg(-2.0 * heading_sd), np.rad2deg(2.0 * heading_sd)),
            ),
            "Heading error, and the filter's 2-sigma band.",
        ),
        Figure(
            draw_ellipse(
                poses.t_ns,
                poses.travelled_m,
                poses.major_axis_m,
                poses.gaps,
                poses.lost_above_m,
            ),
            "Length of the 2-sigma ellipse; above the dashed line the pose counts as lost.",
        ),
    ]
    if np.isfinite(poses.nees).any():
        low, high = mean_band(3, 1)
        ones = np.ones(len(poses.t_ns))
        band = np.log10(low * ones), np.log10(high * ones)
        nees = np.log10(np.maximum(poses.nees, 1e-3))
        found.append(
            Figure(
                _over_distance(poses, "NEES of x, y, heading (log10)", nees, band),
                "Squared error in units of the filter's covariance; the band contains 95 % of it "
                "if the filter is consistent.",
            )
        )
    return tuple(found)


def track_figures(run: RunFolder, gaps: Sequence[ClockGap]) -> tuple[Figure, ...]:
    """Draw the pose of a run without a truth; empty without a pose.

    Raises:
        RunError: The table is damaged.
    """
    names = ["x_m", "y_m", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "travelled_m", "major_axis_m"]
    table = run.filled("pose", ["t_ns", *names])
    if table is None:
        return ()
    t_ns = table["t_ns"].to_numpy()
    x, y, xx, xy, yy, travelled_m, axis_m = (table[name].to_numpy() for name in names)
    track = Track(t_ns, np.stack([x, y], axis=1), None, position_cov(xx, xy, yy), gaps)
    return (
        Figure(draw_map(track), "Estimated track, with twelve 2-sigma ellipses."),
        Figure(draw_ellipse(t_ns, travelled_m, axis_m, gaps), "Length of the 2-sigma ellipse."),
    )


def draw_map(track: Track) -> Markup:
    """Draw the track on a map with equal scales, the truth below the estimate."""
    both = [track.estimate_m] if track.truth_m is None else [track.estimate_m, track.truth_m]
    known = np.concatenate(both)
    known = known[np.isfinite(known).all(axis=1)]
    low, high = known.min(axis=0), known.max(axis=0)
    margin = 0.06 * max(float(np.ptp(known, axis=0).max()), 10.0)
    x_range, y_range = zip((low - margin).tolist(), (high + margin).tolist(), strict=True)
    panel = equal_scales(Panel(56, 34, WIDTH - 70.0, MAX_MAP, x_range, y_range))
    named = [] if track.truth_m is None else [("line truth thick", "truth")]
    drawing = SvgChart(
        WIDTH,
        panel.bottom + 38,
        "Map",
        "Estimated track" + (" and true track" if named else "") + ", east and north in metres.",
    )
    drawing.axes(panel, "x, east (m)", "y, north (m)")
    rows = thinned(len(track.t_ns))
    breaks = broken_at(track.gaps, track.t_ns[rows])
    for points, style in ((track.truth_m, "line truth thick"), (track.estimate_m, "line found")):
        if points is not None:
            x, y = (np.insert(points[rows, i], breaks, np.nan) for i in (0, 1))
            drawing.curve(panel, x, y, style)
    rows = np.unique(np.linspace(0, len(track.t_ns) - 1, ELLIPSES).astype(int))
    for ring in ellipses(track.estimate_m[rows], track.cov_m2[rows]):
        drawing.curve(panel, ring[:, 0], ring[:, 1], "line sigma")
    drawing.legend(8, 14, [*named, ("line found", "estimate"), ("line sigma", "2 sigma")])
    return drawing.svg()


def draw_ellipse(
    t_ns: Int64s,
    travelled_m: Floats,
    major_axis_m: Floats,
    gaps: Sequence[ClockGap],
    lost_above_m: float = math.nan,
) -> Markup:
    """Draw the length of the 2-sigma ellipse over the distance travelled."""
    highest = max(float(np.nanmax(major_axis_m)), 0.1)
    if lost_above_m < 4.0 * highest:
        highest = max(highest, lost_above_m)
    label = "2-sigma ellipse, full major axis (m)"
    drawing, panel = _chart(label, (0.0, 1.05 * highest), gaps, t_ns, travelled_m)
    rows = thinned(len(t_ns))
    breaks = broken_at(gaps, t_ns[rows])
    x, y = (np.insert(one[rows], breaks, np.nan) for one in (travelled_m, major_axis_m))
    drawing.curve(panel, x, y, "line sigma")
    if lost_above_m <= highest:
        lost = panel.y(lost_above_m)
        drawing.rule(panel.left, lost, panel.right, lost, "line dash")
    return drawing.svg()


def _over_distance(
    poses: ScoredPoses, label: str, values: Floats, band: tuple[Floats, Floats]
) -> Markup:
    """Draw an error over the distance travelled, with what the filter claims."""
    low, high = (float(np.nanquantile(one, q)) for one, q in zip(band, (0.05, 0.95), strict=True))
    low, high = min(low, float(np.nanmin(values))), max(high, float(np.nanmax(values)))
    margin = 0.05 * (high - low) or 1.0
    ends = (low if low == 0.0 else low - margin, high + margin)
    drawing, panel = _chart(label, ends, poses.gaps, poses.t_ns, poses.travelled_m)
    rows = thinned(len(values))
    x_m = poses.travelled_m[rows]
    for part in np.split(np.arange(len(rows)), broken_at(poses.gaps, poses.t_ns[rows])):
        inside = [np.clip(one[rows][part], *ends) for one in band]
        drawing.band(panel, x_m[part], inside[0], inside[1], "band sigma")
        drawing.curve(panel, x_m[part], values[rows][part], "line found")
    return drawing.svg()


def _chart(
    label: str,
    ends: tuple[float, float],
    gaps: Sequence[ClockGap],
    t_ns: Int64s,
    travelled_m: Floats,
) -> tuple[SvgChart, Panel]:
    """Begin a chart over the distance travelled, with the gaps of the drive."""
    way_m = max(float(np.nanmax(travelled_m)), 1.0)
    panel = Panel(44, 34, WIDTH - 58, HEIGHT, (0.0, way_m), ends)
    drawing = SvgChart(
        WIDTH, panel.bottom + 38, label, f"{label} over the distance travelled, in metres."
    )
    drawing.axes(panel, "distance travelled (m)", label)
    shade_gaps(drawing, panel, gaps, t_ns, travelled_m)
    return drawing, panel
