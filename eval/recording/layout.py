"""How the viewer lays a recording out, without a click."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray

from .columns import TIMELINE
from .series import BELIEF, CUES, POSE, RANGE

FAR_M: Final = 110.0
BEHIND_M: Final = 12.0
ASIDE_M: Final = 24.0


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """What there is to show.

    Attributes:
        camera: Its topic, or None.
        pose: Columns of the pose, or None.
        has_truth: The true track is drawn.
        has_scene: There are ranges, beliefs or cues.
        longest_m: The largest range, with its band.
    """

    camera: str | None
    pose: Mapping[str, NDArray[np.float64]] | None
    has_truth: bool
    has_scene: bool
    longest_m: float = FAR_M


def blueprint(shown: Shown) -> rrb.Blueprint:
    """The layout: a scene's, or a pose's alone."""
    return rrb.Blueprint(
        _scene(shown) if shown.has_scene else _pose_alone(shown),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state="playing", loop_mode="all"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _scene(shown: Shown) -> rrb.Container:
    cues = rrb.StateTimelineView(
        origin="/".join(CUES),
        name="Cues: filled while found",
        time_view=rrb.TimeAxis(view_range=_whole()),
    )
    left: list[rrb.View] = [cues]
    if shown.camera is not None:
        left.insert(0, _camera(shown.camera))
    ahead = rrb.Spatial2DView(
        origin="ahead",
        name="Ahead of the car (m)",
        visual_bounds=rrb.VisualBounds2D(x_range=[-ASIDE_M, ASIDE_M], y_range=[-FAR_M, BEHIND_M]),
    )
    belief = rrb.TimeSeriesView(
        origin="/".join(BELIEF),
        name="Probability: is it there?",
        axis_x=rrb.TimeAxis(view_range=_whole()),
        axis_y=rrb.ScalarAxis(range=(-0.03, 1.03)),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightBottom),
    )
    ranges = rrb.TimeSeriesView(
        origin="/".join(RANGE),
        name="Range (m): start red, end yellow, 2-sigma bands thin, truth green",
        axis_x=rrb.TimeAxis(view_range=_whole()),
        # A legend of eight lines would cover them.
        axis_y=rrb.ScalarAxis(range=(0.0, shown.longest_m)),
        plot_legend=rrb.PlotLegend(visible=False),
    )
    tabs: list[rrb.View] = [_notes()]
    if shown.pose is not None:
        tabs = [_plan(shown, shown.pose), *_pose_series(), *tabs]
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=[5, 4][-len(left) :]),
        ahead,
        rrb.Vertical(belief, ranges, rrb.Tabs(*tabs), row_shares=[2, 2, 2]),
        column_shares=[10, 4, 7],
    )


def _pose_alone(shown: Shown) -> rrb.Container:
    left: list[rrb.View] = [_notes()]
    if shown.pose is not None:
        left.insert(0, _plan(shown, shown.pose))
    if shown.camera is not None:
        left.insert(0, _camera(shown.camera))
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=[3, 5, 1][-len(left) :]),
        rrb.Vertical(*_pose_series()),
        column_shares=[3, 2],
    )


def _camera(topic: str) -> rrb.View:
    return rrb.Spatial2DView(origin="camera", name=f"Camera {topic}")


def _notes() -> rrb.View:
    return rrb.TextDocumentView(origin="notes", name="Notes")


def _pose_series() -> Sequence[rrb.View]:
    return [
        rrb.TimeSeriesView(
            origin=f"plots/{key}", name=name, axis_x=rrb.TimeAxis(view_range=_whole())
        )
        for key, name in POSE.items()
    ]


def _whole() -> rrb.TimeRange:
    """Without it the viewer shows a minute around the cursor, not the drive."""
    return rrb.TimeRange(rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())


def _plan(shown: Shown, pose: Mapping[str, NDArray[np.float64]]) -> rrb.View:
    return rrb.Spatial3DView(
        origin="plan",
        name="Map, truth in green" if shown.has_truth else "Map",
        line_grid=rrb.LineGrid3D(visible=True),
        eye_controls=_from_above(pose),
    )


def _from_above(pose: Mapping[str, NDArray[np.float64]]) -> rrb.EyeControls3D:
    """North up, the whole track in sight."""
    x, y = pose["x_m"], pose["y_m"]
    middle = (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2)
    height_m = 1.15 * max(float(np.ptp(x)), float(np.ptp(y)), 20.0)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(*middle, height_m),
        look_target=(*middle, 0.0),
        eye_up=(0.0, 1.0, 0.0),
    )
