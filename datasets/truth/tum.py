"""Read and write trajectories in TUM files: ``timestamp x y z qx qy qz qw``, one pose per line.

Lines with ``#`` are comments. Times are decimal seconds. They are converted to integer nanoseconds
and back without floats, whose precision is too low for nanoseconds of this century.
"""

import math
from dataclasses import dataclass
from decimal import ROUND_HALF_EVEN, Decimal, InvalidOperation
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple, TextIO

import numpy as np

from crosscue.replay.columns import ColumnSet, Floats, Int64s
from crosscue.replay.errors import LogError, LogFormatError, LogTooLargeError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.limits import DEFAULT_LIMITS, Limits

from .truth import Mounting, Truth, save

POSE_FILE: Final = "pose.tum"
_COLUMNS: Final = 8
_LINE_CHARACTERS: Final = 4096
_NORM_OFF: Final = 1e-2
_LATEST_S: Final = (2**63 - 1) // 1_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory(ColumnSet):
    """N poses of one body in one frame.

    Attributes:
        t_ns: Times, shape (N,), int64, increasing.
        xyz_m: Positions, shape (N, 3).
        quat_wxyz: Unit quaternions that rotate body axes to the frame's axes, shape (N, 4).
    """

    t_ns: Int64s
    xyz_m: Floats
    quat_wxyz: Floats

    def __post_init__(self) -> None:
        """Refuse columns of inconsistent shapes, and values that are not poses.

        Raises:
            ValueError: A column is invalid; the message names it with its expected content.
        """
        n = len(self.t_ns)
        if self.xyz_m.shape != (n, 3):
            raise ValueError(f"xyz_m: expected ({n}, 3), got {self.xyz_m.shape}")
        if self.quat_wxyz.shape != (n, 4):
            raise ValueError(f"quat_wxyz: expected ({n}, 4), got {self.quat_wxyz.shape}")
        if (np.diff(self.t_ns) <= 0).any():
            raise ValueError("t_ns: expected increasing times")
        if not (np.isfinite(self.xyz_m).all() and np.isfinite(self.quat_wxyz).all()):
            raise ValueError("poses: expected finite numbers, got NaN or infinity")
        if (np.abs(np.linalg.norm(self.quat_wxyz, axis=1) - 1.0) > 1e-6).any():
            raise ValueError("quat_wxyz: expected unit quaternions")


def planar(t_ns: Int64s, x_m: Floats, y_m: Floats, heading_rad: Floats) -> Trajectory:
    """Return poses on the ground, rotated about the vertical axis only.

    Args:
        t_ns: Shape (N,), increasing.
        x_m: Shape (N,).
        y_m: Shape (N,).
        heading_rad: Shape (N,), counter-clockwise from +x.
    """
    zero = np.zeros(len(t_ns))
    quat = np.column_stack([np.cos(heading_rad / 2), zero, zero, np.sin(heading_rad / 2)])
    return Trajectory(t_ns, np.column_stack([x_m, y_m, zero]), quat)


def heading_rad(trajectory: Trajectory) -> Floats:
    """Return the direction of each pose's x axis in the ground plane, counter-clockwise from +x."""
    w, x, y, z = trajectory.quat_wxyz.T
    east: Floats = 1.0 - 2.0 * (y * y + z * z)
    north: Floats = 2.0 * (w * z + x * y)
    return np.arctan2(north, east)


def read_tum(path: Path, limits: Limits = DEFAULT_LIMITS) -> Trajectory:
    """Read a trajectory; times are rounded to nanoseconds.

    Raises:
        LogError: The file does not exist or is not readable.
        LogTooLargeError: The file exceeds the limit.
        LogFormatError: A line is not a pose or goes back in time; the message states its number.
    """
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise LogError(f"{path}: not a regular file; expected a TUM trajectory")
        if size > limits.chunk_bytes:
            raise LogTooLargeError(
                f"{path}: {size} bytes, over the limit of {limits.chunk_bytes}; split it"
            )
        with path.open(encoding="utf-8-sig") as lines:
            return _read(path, lines)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}; check the path") from None
    except UnicodeDecodeError:
        raise LogFormatError(f"{path}: not text; expected a TUM trajectory") from None


def write_tum(path: Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a trajectory, which ``read_tum`` reads back exactly.

    Raises:
        OutputError: It cannot be written.
    """
    heads = [f"# {line}" for line in [*comment.splitlines(), "timestamp x y z qx qy qz qw"]]
    numbers = np.column_stack([trajectory.xyz_m, trajectory.quat_wxyz[:, [1, 2, 3, 0]]])
    poses = (
        " ".join([seconds_text(t_ns), *map(repr, row)])
        for t_ns, row in zip(trajectory.t_ns.tolist(), numbers.tolist(), strict=True)
    )
    write_text(path, "\n".join(chain(heads, poses)) + "\n")


def write_track_truth(folder: Path, log: str, track: Trajectory, comment: str, **more: Any) -> Path:
    """Write a trajectory as ``pose.tum`` and the truth file that names it, and return its path.

    Args:
        folder: Folder for both files.
        log: Name of the log.
        track: The trajectory.
        comment: Comment of the trajectory.
        more: Further fields of ``Truth``; the times are by default those of the trajectory.

    Raises:
        OutputError: A file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_tum(folder / POSE_FILE, track, comment)
    fields: dict[str, Any] = {
        "version": 1,
        "log": log,
        "start_ns": int(track.t_ns[0]),
        "end_ns": int(track.t_ns[-1]) + 1,
        "pose": POSE_FILE,
    }
    return save(Truth(**fields | more), folder)


def seconds_text(t_ns: int) -> str:
    """Format nanoseconds as decimal seconds with nine decimal places."""
    whole, rest = divmod(abs(t_ns), 1_000_000_000)
    return f"{'-' if t_ns < 0 else ''}{whole}.{rest:09d}"


def nanoseconds(text: str) -> int:
    """Parse decimal seconds as nanoseconds, rounded half to even beyond the ninth decimal place.

    Raises:
        ValueError: The text is not a number, or exceeds 64 bits.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"{text!r} is not a number of seconds") from None
    # The exponent is checked first, because arithmetic on 1e999999999 overflows.
    if not seconds.is_finite() or seconds.adjusted() > 9 or abs(seconds) > _LATEST_S:
        raise ValueError(f"{text!r} is not a time within 64 bits of nanoseconds")
    return int((seconds * 1_000_000_000).quantize(Decimal(1), rounding=ROUND_HALF_EVEN))


def _read(path: Path, lines: TextIO) -> Trajectory:
    times: list[int] = []
    rows: list[list[float]] = []
    number = 0
    while line := lines.readline(_LINE_CHARACTERS):
        number += 1
        if line.startswith("#") or not line.strip():
            if not line.endswith("\n"):
                _skip_rest(lines)
            continue
        try:
            t_ns, row = _pose(line)
            if times and t_ns <= times[-1]:
                raise ValueError(f"time {line.split()[0]} is not after that of the previous line")
        except ValueError as error:
            raise LogFormatError(
                f"{path}, line {number}: {error}; expected timestamp x y z qx qy qz qw"
            ) from None
        times.append(t_ns)
        rows.append(row)
    poses = np.array(rows).reshape(-1, 7)
    quat = poses[:, [6, 3, 4, 5]]
    off = np.abs(np.linalg.norm(quat, axis=1, keepdims=True))
    is_unit = np.abs(off - 1.0) < 1e-12
    return Trajectory(np.array(times, np.int64), poses[:, :3], np.where(is_unit, quat, quat / off))


def _pose(line: str) -> tuple[int, list[float]]:
    words = line.replace(",", " ").split()
    if len(words) != _COLUMNS:
        raise ValueError(f"{len(words)} numbers instead of {_COLUMNS}")
    t_ns = nanoseconds(words[0])
    row = [float(word) for word in words[1:]]
    if not all(map(math.isfinite, row)):
        raise ValueError("a number is not finite")
    norm = math.hypot(*row[3:])
    if abs(norm - 1.0) > _NORM_OFF:
        raise ValueError(f"the quaternion has the length {norm:.3g}")
    return t_ns, row


def _skip_rest(lines: TextIO) -> None:
    """Skip to the end of a comment that is longer than one read."""
    while (rest := lines.readline(_LINE_CHARACTERS)) and not rest.endswith("\n"):
        pass


_TRAVEL_STEP_S: Final = 1.0
# Min length of a step; over a shorter one, positions with centimetre errors do not determine the
# course to half a degree.
_TRAVEL_MIN_M: Final = 3.0
_TRAVEL_MIN_STEPS: Final = 3
# Min standard deviation of a step's course, from the vehicle's slip and the track's error.
_TRAVEL_SD_RAD: Final = 0.005
_LEVER_M: Final = 1.0
# Prior standard deviation of the lever: the body is between the rear axle and the windscreen.
_LEVER_SD_M: Final = 1.5
# Max standard deviation of the yaw that is accepted, 0.3 degrees.
_TURNED_MAX_SD_RAD: Final = 0.005


class TurnedBy(NamedTuple):
    """Yaw of a body in its vehicle, counter-clockwise, and the standard deviation."""

    yaw_rad: float
    sd_rad: float


def turned_by(trajectory: Trajectory) -> TurnedBy | None:
    """Estimate a body's yaw in its vehicle from the direction of travel.

    The centre of the rear axle moves in the direction of the vehicle, which does not slip sideways.
    A point ahead of it swings outwards by its lever times the curvature. The body's heading minus
    its course is therefore its yaw minus that swing; both are fitted, the lever with a wide prior.

    Returns:
        The yaw, or None if the drive is too short, too slow, or curved throughout.
    """
    ends_s = (trajectory.t_ns - trajectory.t_ns[0]) * 1e-9
    at_s = np.arange(0.0, ends_s[-1], _TRAVEL_STEP_S)
    x, y = (np.interp(at_s, ends_s, trajectory.xyz_m[:, axis]) for axis in (0, 1))
    turned = np.unwrap(heading_rad(trajectory))
    heading, middle = (
        np.interp(t_s, ends_s, turned) for t_s in (at_s, at_s[:-1] + 0.5 * _TRAVEL_STEP_S)
    )
    step_m = np.hypot(np.diff(x), np.diff(y))
    moves = step_m > _TRAVEL_MIN_M
    if np.count_nonzero(moves) < _TRAVEL_MIN_STEPS:
        return None
    aside = np.angle(np.exp(1j * (middle - np.arctan2(np.diff(y), np.diff(x)))))[moves]
    curvature = (np.diff(heading) / np.maximum(step_m, _TRAVEL_MIN_M))[moves]
    rows = np.column_stack([np.ones(len(aside)), -curvature])
    sd_rad = _TRAVEL_SD_RAD
    for _ in range(2):
        weights = rows.T @ rows / sd_rad**2 + np.diag([0.0, _LEVER_SD_M**-2])
        found = np.linalg.solve(
            weights, rows.T @ aside / sd_rad**2 + [0.0, _LEVER_M * _LEVER_SD_M**-2]
        )
        sd_rad = max(_TRAVEL_SD_RAD, float(np.sqrt(np.mean((aside - rows @ found) ** 2))))
    yaw_sd_rad = float(np.sqrt(np.linalg.inv(weights)[0, 0]))
    return TurnedBy(float(found[0]), yaw_sd_rad) if yaw_sd_rad < _TURNED_MAX_SD_RAD else None


def mounting_in_car(
    track: Trajectory, stated: str = "position not published", **place_m: float
) -> dict[str, Any]:
    """Return a body's mounting, with the yaw estimated from its travel, as fields of ``Truth``.

    Args:
        track: Trajectory of the body.
        stated: Published description of its position, and its source.
        place_m: Published position: ``x_m``, ``y_m``, ``z_m`` of ``Mounting``.
    """
    found = turned_by(track)
    place: dict[str, float | None] = {**dict.fromkeys(Mounting.model_fields), **place_m}
    source = f"{stated}; yaw unknown, and the drive does not determine it"
    if found is not None:
        place["yaw_rad"] = round(found.yaw_rad, 5)
        degrees = math.degrees(found.sd_rad)
        source = f"{stated}; yaw by its direction of travel, +- {degrees:.2f} deg"
    return {"mounting": Mounting(**place), "mounting_source": source}
