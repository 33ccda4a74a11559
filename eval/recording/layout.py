"""Layout of a recording in the viewer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.blueprint.components import AbsoluteTimeRange

from crosscue.replay.errors import UsageError

from .columns import TIMELINE
from .part import VIEWS, RecordingSpan
from .series import BELIEF, CUES, POSE, RANGE

FAR_M: Final = 110.0
BEHIND_M: Final = 12.0
ASIDE_M: Final = 24.0
# Time marked on either side of a moment on the time line.
MARKED_NS: Final = 100_000_000


@dataclass(frozen=True, slots=True, eq=False)
class ViewData:
    """Data available to the views.

    Attributes:
        camera: Topic of the camera, or None.
        pose: Columns of the pose, or None.
        has_scene: True if there are ranges, beliefs or cues.
        longest_m: The largest range, including its band.
        part: The time span and the views recorded.
    """

    camera: str | None
    pose: Mapping[str, NDArray[np.float64]] | None
    has_scene: bool
    longest_m: float
    part: RecordingSpan


def blueprint(shown: ViewData) -> rrb.Blueprint:
    """Return the layout: for a scene, for a pose alone, or of the requested views.

    Raises:
        UsageError: The run has no data for any of the requested views.
    """
    whole = _scene(shown) if shown.has_scene else _pose_alone(shown)
    return rrb.Blueprint(
        _only(shown) if shown.part.only else whole,
        _time_panel(shown.part.moment_ns),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _time_panel(moment_ns: int | None) -> rrb.TimePanel:
    """Return the time panel; playback starts at the beginning, as Rerun 0.41 has no start time."""
    marked = None
    if moment_ns is not None:
        marked = AbsoluteTimeRange(min=moment_ns - MARKED_NS, max=moment_ns + MARKED_NS)
    return rrb.TimePanel(
        timeline=TIMELINE,
        state="collapsed",
        play_state="playing",
        loop_mode="all",
        time_selection=marked,
    )


def _only(shown: ViewData) -> rrb.Container:
    """Return the requested views for which the run has data, side by side."""
    there: dict[str, rrb.View | rrb.Container] = {"notes": _notes()}
    if shown.camera is not None:
        there["cameras"] = _camera(shown.camera)
    if shown.has_scene:
        there |= {
            "ahead": _ahead(),
            "belief": _belief(),
            "ranges": _ranges(shown.longest_m),
            "cues": _cues(),
        }
    if shown.pose is not None:
        there |= {"map": _plan(shown, shown.pose), "pose": rrb.Vertical(*_pose_series())}
    views = [there[name] for name in VIEWS if name in there and shown.part.shows(name)]
    if not views:
        raise UsageError(
            f"--only {','.join(sorted(shown.part.only))}: the run has no data for these views; "
            f"it has {','.join(name for name in VIEWS if name in there)}"
        )
    return rrb.Grid(*views)


def _cues() -> rrb.View:
    return rrb.StateTimelineView(
        origin="/".join(CUES),
        name="Cues: filled while found",
        time_view=rrb.TimeAxis(view_range=_whole()),
    )


def _ahead() -> rrb.View:
    return rrb.Spatial2DView(
        origin="ahead",
        name="Ahead (m)",
        visual_bounds=rrb.VisualBounds2D(x_range=[-ASIDE_M, ASIDE_M], y_range=[-FAR_M, BEHIND_M]),
    )


def _belief() -> rrb.View:
    return rrb.TimeSeriesView(
        origin="/".join(BELIEF),
        name="Probability of each feature",
        axis_x=rrb.TimeAxis(view_range=_whole()),
        axis_y=rrb.ScalarAxis(range=(-0.03, 1.03)),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightBottom),
    )


def _ranges(longest_m: float) -> rrb.View:
    return rrb.TimeSeriesView(
        origin="/".join(RANGE),
        name="Range (m)",
        axis_x=rrb.TimeAxis(view_range=_whole()),
        # From below 0, whose label would cover that of the time; a legend would cover the curves.
        axis_y=rrb.ScalarAxis(range=(-0.05 * longest_m, longest_m)),
        plot_legend=rrb.PlotLegend(visible=False),
    )


def _scene(shown: ViewData) -> rrb.Container:
    left: list[rrb.View] = [_cues()]
    if shown.camera is not None:
        left.insert(0, _camera(shown.camera))
    tabs: list[rrb.View] = [_notes()]
    if shown.pose is not None:
        tabs = [_plan(shown, shown.pose), *_pose_series(), *tabs]
    return rrb.Horizontal(
        rrb.Vertical(*left, row_shares=[5, 4][-len(left) :]),
        _ahead(),
        rrb.Vertical(_belief(), _ranges(shown.longest_m), rrb.Tabs(*tabs), row_shares=[2, 2, 2]),
        column_shares=[10, 4, 7],
    )


def _pose_alone(shown: ViewData) -> rrb.Container:
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
    """Return the range of the complete drive; by default the viewer shows only a minute."""
    return rrb.TimeRange(rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())


def _plan(shown: ViewData, pose: Mapping[str, NDArray[np.float64]]) -> rrb.View:
    return rrb.Spatial3DView(
        origin="plan",
        name="Map",
        line_grid=rrb.LineGrid3D(visible=True),
        eye_controls=_from_above(pose),
    )


def _from_above(pose: Mapping[str, NDArray[np.float64]]) -> rrb.EyeControls3D:
    """Return a camera above the map, north up, with the complete track in view."""
    x, y = pose["x_m"], pose["y_m"]
    middle = (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2)
    height_m = 1.15 * max(float(np.ptp(x)), float(np.ptp(y)), 20.0)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=(*middle, height_m),
        look_target=(*middle, 0.0),
        eye_up=(0.0, 1.0, 0.0),
    )
