"""A run as a Rerun recording, laid out without a click.

The plan view is the map frame seen from above (x east, y north, metres). Everything lies on one
timeline, the log's time; columns are sent in bulk.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.replay.columns import Floats, Images, Int64s, Topic
from crosscue.replay.decode import decoder_for
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import Ledger
from crosscue.replay.log import Selection, open_log
from crosscue.replay.roles import Role, role_of
from crosscue.replay.run_folder import RunFolder, write_whole

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

TIMELINE: Final = "drive"
"""Not ``log_time``: under that name the viewer keeps the wall clock of the logging itself."""
YEAR_2000_NS: Final = 946_684_800_000_000_000
PASSED_THROUGH: Final = ("jpeg", "png")
"""Codings that the viewer decodes itself."""
PATH_POINTS: Final = 20_000
ELLIPSES_PER_S: Final = 5.0
ESTIMATE: Final = (31, 119, 180)
TRUTH: Final = (44, 160, 44)
ELLIPSE: Final = (255, 127, 14)


@dataclass(frozen=True, slots=True, eq=False)
class TruthTrack:
    """The true track on the log clock, in the map frame.

    Attributes:
        t_ns: Shape (N,), int64.
        x_m: Shape (N,).
        y_m: Shape (N,).
    """

    t_ns: Int64s
    x_m: Floats
    y_m: Floats


def save(run: RunFolder, path: Path, truth: TruthTrack | None = None) -> None:
    """Write the recording of a run, whole or not at all.

    Raises:
        RunError: The run's tables are missing or damaged.
        OutputError: It cannot be written.
    """
    import rerun as rr

    table = run.table("pose")
    columns = {name: table[name].to_numpy() for name in table.column_names if name != "landmark"}

    camera = _camera_of(run)

    def write(partial: Path) -> None:
        recording = rr.RecordingStream("crosscue", recording_id=str(run.path.resolve().name))
        recording.save(partial, default_blueprint=_blueprint(columns, truth, camera))
        recording.log("plan", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _log_pose(recording, columns)
        if truth is not None:
            _log_truth(recording, truth)
        if camera is not None:
            _log_camera(recording, *camera)
        recording.log("notes", _notes(run), static=True)
        recording.flush()
        recording.disconnect()

    write_whole(path, write)


def _log_pose(recording: rr.RecordingStream, pose: Mapping[str, Floats]) -> None:
    import rerun as rr

    if not len(pose["t_ns"]):
        return
    t_ns = pose["t_ns"].astype(np.int64)
    thin = slice(None, None, max(1, len(t_ns) // PATH_POINTS))
    flat = np.stack([pose["x_m"], pose["y_m"], np.zeros(len(t_ns))], axis=1)
    recording.log(
        "plan/estimate", rr.LineStrips3D([flat[thin]], colors=[ESTIMATE]),
        static=True,
    )  # fmt: skip
    some = _every(t_ns, ELLIPSES_PER_S)
    times = [_time_column(t_ns[some])]
    rings = _rings(flat[some], _position_cov(pose, some))
    recording.send_columns(
        "plan/ellipse", indexes=times, columns=rr.LineStrips3D.columns(strips=list(rings))
    )
    recording.log("plan/ellipse", rr.LineStrips3D.from_fields(colors=[ELLIPSE]), static=True)
    heading = pose["heading_rad"][some]
    ahead = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))], axis=1)
    recording.send_columns(
        "plan/car", indexes=times,
        columns=rr.Arrows3D.columns(origins=flat[some], vectors=ahead * 8.0),
    )  # fmt: skip
    recording.log("plan/car", rr.Arrows3D.from_fields(colors=[ESTIMATE], radii=[0.8]), static=True)
    series = {
        "speed/speed_mps": pose["speed_mps"],
        "heading/heading_deg": np.rad2deg(np.unwrap(pose["heading_rad"])),
        "heading_sd/heading_sd_deg": np.rad2deg(np.sqrt(pose["cov_hh_rad2"])),
        "ellipse/major_axis_m": pose["major_axis_m"],
    }
    for name, values in series.items():
        recording.send_columns(
            f"plots/{name}",
            indexes=[_time_column(t_ns)],
            columns=rr.Scalars.columns(scalars=values),
        )


def _log_truth(recording: rr.RecordingStream, truth: TruthTrack) -> None:
    import rerun as rr

    flat = np.stack([truth.x_m, truth.y_m, np.zeros(len(truth.t_ns))], axis=1)
    recording.log("plan/truth", rr.LineStrips3D([flat], colors=[TRUTH]), static=True)
    recording.send_columns(
        "plan/true_car", indexes=[_time_column(truth.t_ns)],
        columns=rr.Points3D.columns(positions=flat),
    )  # fmt: skip
    recording.log(
        "plan/true_car", rr.Points3D.from_fields(colors=[TRUTH], radii=[1.2]), static=True
    )


def _camera_of(run: RunFolder) -> tuple[Path, Topic] | None:
    """The log and topic with the pictures, where one is still at hand and no choice is left."""
    manifest = run.manifest()
    named = manifest["settings"]["topics"]["camera"]
    found: list[tuple[Path, Topic]] = []
    for entry in manifest["logs"]:
        path = Path(entry["path"])
        # The log may have gone since it was replayed; the rest of the run can still be seen.
        with suppress(LogError), open_log(path) as log:
            found += [(path, topic) for topic in log.topics if role_of(topic) is Role.CAMERA]
    if named is not None:
        found = [(path, topic) for path, topic in found if topic.name == named]
    return found[0] if len(found) == 1 else None


def _log_camera(recording: rr.RecordingStream, path: Path, topic: Topic) -> None:
    """Pictures as stored: their bytes pass through undecoded."""
    import rerun as rr

    ledger = Ledger(str(path))
    decode = decoder_for(topic)
    with open_log(path) as log:
        for block in log.read(ledger, Selection(frozenset({topic.name}))):
            images = (decode(block, ledger) if decode else block).rows
            if not isinstance(images, Images):
                continue
            for i, coding in enumerate(images.coding):
                if coding not in PASSED_THROUGH:
                    continue
                _set_time(recording, int(block.log_ns[i]))
                picture = rr.EncodedImage(
                    contents=bytes(images.bytes_.payload(i)), media_type=f"image/{coding}"
                )
                recording.log("camera", picture)
    recording.reset_time()


def _set_time(recording: rr.RecordingStream, t_ns: int) -> None:
    if t_ns > YEAR_2000_NS:
        recording.set_time(TIMELINE, timestamp=np.datetime64(t_ns, "ns"))
    else:
        recording.set_time(TIMELINE, duration=np.timedelta64(t_ns, "ns"))


def _time_column(t_ns: Int64s) -> rr.TimeColumn:
    """Wall-clock logs as dates, logs on a boot clock as durations."""
    import rerun as rr

    if len(t_ns) and int(t_ns.min()) > YEAR_2000_NS:
        return rr.TimeColumn(TIMELINE, timestamp=t_ns.astype("datetime64[ns]"))
    return rr.TimeColumn(TIMELINE, duration=t_ns.astype("timedelta64[ns]"))


def _every(t_ns: Int64s, rate_hz: float) -> Int64s:
    """Indices of about ``rate_hz`` rows a second, the last one included."""
    slots = (t_ns - t_ns[0]) // round(1e9 / rate_hz)
    first = np.flatnonzero(np.diff(slots, prepend=-1))
    return np.union1d(first, [len(t_ns) - 1]).astype(np.int64)


def _position_cov(pose: Mapping[str, Floats], rows: Int64s) -> Floats:
    xx, xy, yy = (pose[f"cov_{name}"][rows] for name in ("xx_m2", "xy_m2", "yy_m2"))
    return np.stack([np.stack([xx, xy], axis=-1), np.stack([xy, yy], axis=-1)], axis=-2)


def _rings(centre: Floats, cov: Floats, points: int = 33) -> Floats:
    """2-sigma ellipses, shape (N, points, 3)."""
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    values, vectors = np.linalg.eigh(cov)
    axes = vectors * (2.0 * np.sqrt(np.maximum(values, 0.0)))[:, None, :]
    rings = np.zeros((len(cov), points, 3))
    rings[:, :, :2] = np.swapaxes(axes @ circle, 1, 2)
    return rings + centre[:, None, :]


def _notes(run: RunFolder) -> rr.TextDocument:
    import rerun as rr

    manifest = run.manifest()
    logs = "\n".join(f"- `{log['path']}`" for log in manifest["logs"])
    notices = "\n".join(f"- {sentence}" for sentence in manifest["notices"]) or "- none"
    lost = sum(not account["is_whole"] for account in manifest["accounts"])
    whole = (
        "nothing is known to be lost" if not lost else f"{lost} log(s) with losses: see manifest"
    )
    text = (
        f"# {run.path.name}\n\nLogs ({whole}):\n{logs}\n\nNotes:\n{notices}\n\n"
        "Plan: x east, y north, metres. Blue: estimated path; orange: its 2-sigma ellipse; "
        "green: truth, where the run was scored."
    )
    return rr.TextDocument(text, media_type="text/markdown")


def _blueprint(
    pose: Mapping[str, Floats], truth: TruthTrack | None, camera: tuple[Path, Topic] | None
) -> rrb.Blueprint:
    import rerun.blueprint as rrb

    plots = {"speed": "Speed (m/s)", "heading": "Heading (deg)", "heading_sd": "Heading s.d. (deg)",
             "ellipse": "2-sigma ellipse, full major axis (m)"}  # fmt: skip
    # Without it the viewer shows a minute around the cursor, not the drive.
    whole = rrb.TimeRange(rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())
    series = [
        rrb.TimeSeriesView(origin=f"plots/{key}", name=name, axis_x=rrb.TimeAxis(view_range=whole))
        for key, name in plots.items()
    ]
    plan = rrb.Spatial3DView(
        origin="plan", name="Plan" if truth is None else "Plan, truth in green",
        line_grid=rrb.LineGrid3D(visible=True), eye_controls=_from_above(pose),
    )  # fmt: skip
    notes = rrb.TextDocumentView(origin="notes", name="Notes")
    left = [plan, notes]
    if camera is not None:
        left.insert(0, rrb.Spatial2DView(origin="camera", name=f"Camera {camera[1].name}"))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, row_shares=[3] * (len(left) - 1) + [1]),
            rrb.Vertical(*series),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE, expanded=False),
        rrb.SelectionPanel(expanded=False),
        rrb.BlueprintPanel(expanded=False),
    )


def _from_above(pose: Mapping[str, Floats]) -> rrb.EyeControls3D | None:
    """North up, the whole track in sight."""
    import rerun.blueprint as rrb

    if not len(pose["t_ns"]):
        return None
    x, y = pose["x_m"], pose["y_m"]
    middle = (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2)
    height_m = 1.4 * max(float(np.ptp(x)), float(np.ptp(y)), 20.0)
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=(*middle, height_m), look_target=(*middle, 0.0),
        eye_up=(0.0, 1.0, 0.0),
    )  # fmt: skip
