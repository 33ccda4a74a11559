"""Time series of a recording: beliefs, ranges, cues and pose."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import rerun as rr
from numpy.typing import NDArray

from crosscue.eval.runs.tables.columns import LOG_TIME
from crosscue.eval.scoring.truth import TrueRanges
from crosscue.replay.colours import END, QUIET, START, TRUTH, Colour, of_feature
from crosscue.replay.vehicle import cue_table
from crosscue.replay.vehicle.fusion import NOT_FEATURES
from crosscue.replay.vehicle.vehicle import Vehicle

from .columns import DriveTime
from .scene_rows import SceneRows

BELIEF: Final = ("plots", "belief")
RANGE: Final = ("plots", "range")
CUES: Final = ("cues",)
FOUND: Final = "found"
# Displayed duration of the only frame of a run.
ONE_FRAME_NS: Final = 100_000_000
# Plots of the pose and their titles.
POSE: Final[Mapping[str, str]] = {
    "speed": "Speed m/s",
    "heading": "Heading deg",
    "heading_sd": "s.d. deg",
    "ellipse": "Ellipse m",
}
NOT_IN_BELIEF: Final = (*NOT_FEATURES, *LOG_TIME)


def log_pose_series(
    recording: rr.RecordingStream, time: DriveTime, pose: Mapping[str, NDArray[np.float64]]
) -> None:
    """Log one plot for each entry of ``POSE``."""
    series = {
        "speed/speed_mps": pose["speed_mps"],
        "heading/heading_deg": np.rad2deg(np.unwrap(pose["heading_rad"])),
        "heading_sd/heading_sd_deg": np.rad2deg(np.sqrt(pose["cov_hh_rad2"])),
        "ellipse/major_axis_m": pose["major_axis_m"],
    }
    for name, values in series.items():
        _send(recording, time, ["plots", *name.split("/")], pose["t_ns"], values, pose["segment"])


def log_belief(
    recording: rr.RecordingStream, time: DriveTime, scene: SceneRows, vehicle: Vehicle
) -> None:
    """Log the probability of every feature, and the threshold above which it is established."""
    if scene.belief is None:
        return
    t_ns, pieces = scene.belief["t_ns"].to_numpy(), _pieces(scene.belief)
    features = [name for name in scene.belief.column_names if name not in NOT_IN_BELIEF]
    for number, name in enumerate(features):
        _line([*BELIEF, name], name, of_feature(name, number), recording, width=2.0)
        _send(recording, time, [*BELIEF, name], t_ns, scene.belief[name].to_numpy(), *pieces)
    ends = np.array([min(scene.frames_ns[0], t_ns[0]), max(scene.frames_ns[-1], t_ns[-1])])
    entity = [*BELIEF, "established_above"]
    _line(entity, f"{vehicle.fusion.established:g}", QUIET, recording)
    _send(recording, time, entity, ends, np.full(2, vehicle.fusion.established))


def log_ranges(
    recording: rr.RecordingStream, time: DriveTime, scene: SceneRows, truth: TrueRanges | None
) -> None:
    """Log the range to start and end with the 2-sigma band, the measurements, and the truth."""
    for reference, colour in (("start", START), ("end", END)):
        if scene.ranges is None:
            break
        rows = scene.ranges.filter(pc.equal(scene.ranges["reference"], reference))
        if not rows.num_rows:
            continue
        t_ns, pieces = rows["t_ns"].to_numpy(), _pieces(rows)
        mean_m = rows["range_m"].to_numpy()
        two_sd_m = 2.0 * np.sqrt(rows["var_m2"].to_numpy())
        for name, values, width in (
            (reference, mean_m, 2.0),
            (f"{reference} plus 2 sd", mean_m + two_sd_m, 0.7),
            (f"{reference} less 2 sd", mean_m - two_sd_m, 0.7),
        ):
            entity = [*RANGE, _path_part(name)]
            _line(entity, name, colour, recording, width)
            _send(recording, time, entity, t_ns, values, *pieces)
        _log_measured(recording, time, rows, reference, colour)
    if truth is not None:
        for reference, values in (("start", truth.start_m), ("end", truth.end_m)):
            if np.isfinite(values).any():
                name = f"true {reference}"
                entity = [*RANGE, _path_part(name)]
                _line(entity, name, TRUTH, recording, width=1.5)
                _send(recording, time, entity, truth.t_ns, values, truth.approach)


def _log_measured(
    recording: rr.RecordingStream, time: DriveTime, rows: pa.Table, reference: str, colour: Colour
) -> None:
    measured = rows.filter(pc.is_valid(rows["measured_m"]))
    if measured.num_rows:
        name = f"{reference} measured"
        entity = [*RANGE, _path_part(name)]
        style = rr.SeriesPoints(colors=[colour], names=[name], marker_sizes=[2.0])
        recording.log(rr.new_entity_path([*entity]), style, static=True)
        _send(
            recording, time, entity, measured["t_ns"].to_numpy(), measured["measured_m"].to_numpy()
        )


def log_cues(recording: rr.RecordingStream, time: DriveTime, scene: SceneRows) -> None:
    """Log a lane for every cue that was ever found, filled while it is found."""
    if scene.cues is None:
        return
    found = scene.cues.filter(pc.greater(scene.cues["count"], 0))
    for cue in pc.unique(found["cue"]).sort().to_pylist():
        rows = scene.cues.filter(pc.equal(scene.cues["cue"], cue))
        t_ns, first = np.unique(rows["t_ns"].to_numpy(), return_index=True)
        counts = rows["count"].to_numpy()[first]
        at, is_found = _changes(t_ns, counts > 0, scene.frames_ns, scene.gaps_ns)
        entity = [*CUES, cue]
        # No text: the viewer cuts it off in a short bar, and the view's title says it.
        style = rr.StateConfiguration(values=[FOUND], labels=[" "], colors=[of_cue(cue)])
        recording.log(rr.new_entity_path([*entity]), style, static=True)
        recording.send_columns(
            rr.new_entity_path([*entity]),
            indexes=time.column(at),
            columns=rr.StateChange.columns(state=[FOUND] * int(is_found.sum())).partition(is_found),
        )


def of_cue(cue: str) -> Colour:
    """Return the colour of a cue: from the table of cues, or by the side in a user-defined name."""
    if cue in cue_table.CUES:
        return cue_table.CUES[cue].colour
    for number, side in enumerate(("left", "right", "straight")):
        if cue.endswith(side):
            return of_feature(side, number)
    return of_feature("intersection", 0)


def _changes(
    t_ns: NDArray[np.int64],
    is_found: NDArray[np.bool_],
    frames_ns: NDArray[np.int64],
    gaps_ns: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the times at which a cue appears or disappears, and 1 or 0 from then on.

    It counts as 0 where it was not evaluated, in gaps of the drive, and after the last frame has
    lasted for the usual interval between frames.
    """
    frames_ns = np.unique(frames_ns)
    period_ns = int(np.median(np.diff(frames_ns))) if len(frames_ns) > 1 else ONE_FRAME_NS
    times = np.union1d(np.append(frames_ns, frames_ns[-1:] + period_ns), gaps_ns)
    everywhere = np.isin(times, t_ns[is_found]).astype(np.int64)
    turns = np.flatnonzero(np.diff(everywhere, prepend=-1))
    return times[turns], everywhere[turns]


def _pieces(table: pa.Table) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the columns at whose changes lines are interrupted: approaches and segments."""
    return table["approach"].to_numpy(), table["segment"].to_numpy()


def _path_part(name: str) -> str:
    return name.replace(" ", "_")


def _line(
    entity: list[str], name: str, colour: Colour, recording: rr.RecordingStream, width: float = 1.0
) -> None:
    style = rr.SeriesLines(colors=[colour], names=[name], widths=[width])
    recording.log(rr.new_entity_path([*entity]), style, static=True)


def _send(
    recording: rr.RecordingStream,
    time: DriveTime,
    entity: list[str],
    t_ns: NDArray[np.int64] | NDArray[np.float64],
    values: NDArray[np.float64],
    *pieces: NDArray[Any],
) -> None:
    """Send a series, broken wherever one of ``pieces`` changes, shape (N,) each."""
    t_ns = np.asarray(t_ns, np.int64)
    changes = [np.flatnonzero(piece[1:] != piece[:-1]) + 1 for piece in pieces]
    breaks = np.unique(np.concatenate([np.empty(0, np.int64), *changes]))
    t_ns = np.insert(t_ns, breaks, t_ns[breaks - 1] + 1)
    values = np.insert(np.asarray(values, np.float64), breaks, np.nan)
    path = rr.new_entity_path([*entity])
    recording.send_columns(
        path, indexes=time.column(t_ns), columns=rr.Scalars.columns(scalars=values)
    )
