"""The camera section of a drafted vehicle file, and the sections that no log can fill."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

from crosscue.replay.base import Log, Selection, name_of
from crosscue.replay.columns import Table
from crosscue.replay.decode import decoder_for
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.vehicle.roles import Role, role_of


class Intrinsics(NamedTuple):
    """Intrinsics of a camera in pixels, and their source."""

    focal_px: float
    center_px: tuple[float, float]
    source: str
    size_px: tuple[int, int] | None = None


class MountingParameter(NamedTuple):
    """A parameter of the camera, its source, and whether it differs from the default."""

    value: float
    source: str
    is_set: bool = True


class CameraMounting(NamedTuple):
    """Mounting of the camera, where known; names are those of the vehicle file.

    Attributes:
        x_m: Distance ahead of the rear axle.
        y_m: Distance to the left of the vehicle's middle.
        z_m: Height above the road.
        pitch_rad: Angle of the optical axis below the horizon.
        yaw_rad: Angle of the optical axis to the left.
        focal_px: Focal length, where the log publishes none.
        delay_s: Delay of the pictures' time stamps.
        notes: Remarks on known or unknown parameters, one sentence each.
    """

    x_m: MountingParameter | None = None
    y_m: MountingParameter | None = None
    z_m: MountingParameter | None = None
    pitch_rad: MountingParameter | None = None
    yaw_rad: MountingParameter | None = None
    focal_px: MountingParameter | None = None
    delay_s: MountingParameter | None = None
    notes: tuple[str, ...] = ()


@runtime_checkable
class KnowsItsCameras(Protocol):
    """A log whose data set publishes camera intrinsics."""

    def intrinsics(self, camera: str) -> tuple[float, float, float] | None:
        """Return a camera's focal length and optical center; None if they are not published.

        Raises:
            LogFormatError: They are published but cannot be read.
        """


MEASURE: Final = {
    "x_m": "ahead of the rear axle: measure it, then pass --camera-x-m",
    "y_m": "left of the car's middle: measure it, then pass --camera-y-m",
    "z_m": "above the road: measure it, then pass --camera-height-m; or a drive on a textured road "
    "with images, speed and focal_px",
    "yaw_rad": "to the left: estimated as pitch_rad is, or pass --camera-yaw-deg",
    "pitch_rad": "below the horizon: estimated from a drive with images, speed and focal_px, or "
    "pass --camera-pitch-deg",
}

AFTER_CAMERA: Final = """\
# [regions]  # where road is searched: on the ground, which needs camera.focal_px and z_m
# kind = "area"  # or "picture", with a polygon for each side, drawn on an image from:
# crosscue detect LOG --draw 1

# [ranges]  # default: from motion, where camera.focal_px and odometry are known
# kind = "curve"  # after: crosscue fit ranges RUN... --truth TRUTH...

# [detectors.yolox-nano]  # after: crosscue model fetch yolox-nano; others: crosscue model list
# kind = "yolox-nano"  # for your own network: crosscue model init NET.onnx, then card = "NET.toml"

# [cues]  # default: each detector's own thresholds, see crosscue fit detector
# stop_sign_score = 0.5
# traffic_light_score = 0.5
# [cars]
# score = 0.5
"""


def camera_lines(logs: Sequence[Log], mounting: CameraMounting) -> Iterator[str]:
    """Yield the lines of the section ``[camera]``; none for logs without a camera."""
    camera = first_camera(logs)
    if camera is None:
        return
    _, _, found = camera
    yield "[camera]"
    if found is None and mounting.focal_px is not None:
        yield f"focal_px = {mounting.focal_px.value:.5g}  # {mounting.focal_px.source}"
    elif found is None:
        yield "# No calibration in the log; without it there are no ranges from motion."
        yield "# focal_px = 1000.0"
        yield "# center_px = [640.0, 360.0]"
    else:
        yield f"focal_px = {found.focal_px:.10g}  # {found.source}"
        yield f"center_px = [{found.center_px[0]:.10g}, {found.center_px[1]:.10g}]"
        if found.size_px is not None:
            yield f"size_px = [{found.size_px[0]}, {found.size_px[1]}]"
    for name, default in (
        ("x_m", 0.0),
        ("y_m", 0.0),
        ("z_m", 1.2),
        ("pitch_rad", 0.0),
        ("yaw_rad", 0.0),
    ):
        given: MountingParameter | None = getattr(mounting, name)
        if given is None:
            yield f"# {name} = {default}  # {MEASURE[name]}"
        else:
            yield f"{name} = {given.value:.5g}  # {given.source}"
    if mounting.delay_s is not None:
        mark = "" if mounting.delay_s.is_set else "# "
        yield f"{mark}delay_s = {mounting.delay_s.value:.3f}  # {mounting.delay_s.source}"
    yield from (f"# {note}" for note in mounting.notes)
    yield ""


def first_camera(logs: Sequence[Log]) -> tuple[Log, str, Intrinsics | None] | None:
    """Return the first camera's log, topic and intrinsics; None for logs without a camera."""
    for log in logs:
        for topic in log.topics:
            if role_of(topic) is Role.CAMERA:
                return log, topic.name, _intrinsics(logs, log, topic.name)
    return None


def _intrinsics(logs: Sequence[Log], log: Log, camera: str) -> Intrinsics | None:
    """Return the intrinsics published with the data set, else those of the first message."""
    if isinstance(log, KnowsItsCameras) and (published := log.intrinsics(camera)) is not None:
        focal, x, y = published
        return Intrinsics(focal, (x, y), "published with the data set")
    for other in logs:
        for topic in other.topics:
            if role_of(topic) is Role.CAMERA_INFO:
                found = _of_message(other, topic.name)
                if found is not None:
                    return found
    return None


def _of_message(log: Log, name: str) -> Intrinsics | None:
    """Return the intrinsics in the first message of a topic; None if it has none."""
    topic = next(topic for topic in log.topics if topic.name == name)
    ledger = Ledger(name_of(log))
    decode = decoder_for(topic) if topic.encoding != "columns" else None
    for block in log.read(ledger, Selection(frozenset({name}))):
        rows: Any = (decode(block, ledger) if decode else block).rows
        if isinstance(rows, Table) and len(rows) and "k" in rows.columns:
            k = [float(value) for value in rows["k"][0]]
            warn_of(ledger)
            is_calibrated = len(k) == 9 and all(map(math.isfinite, k)) and k[0] > 0.0
            if not is_calibrated:
                return None
            size_px = (int(rows["width_px"][0]), int(rows["height_px"][0]))
            return Intrinsics(k[0], (k[2], k[5]), f"from {name}", size_px if all(size_px) else None)
    return None
