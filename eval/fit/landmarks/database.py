"""Building a landmark database from a log with poses, or from pictures with coordinates."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.truth.csv_rows import csv_rows
from crosscue.datasets.truth.tum import heading_rad
from crosscue.detectors.images import encoded, lose
from crosscue.eval.logs.log import Log as Drive
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.pose.score import load_truth, track_mounting
from crosscue.localization.angles import interpolate_angle
from crosscue.localization.ellipse import position_cov
from crosscue.localization.landmarks.database import LandmarkPosition, LandmarkWriter
from crosscue.localization.landmarks.features import Matcher
from crosscue.localization.landmarks.images import grey_of, read_encoded
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import AnnotationError, LogError, MissingTopicError, UsageError
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.signals.extractor import pictures_of
from crosscue.replay.signals.plan import chosen_camera
from crosscue.replay.vehicle.vehicle import Vehicle

# Min number of points of a landmark; pictures of a blank wall or at night have fewer.
MIN_POINTS: Final = 20
MAX_GAP_NS: Final = 500_000_000


@dataclass(frozen=True, slots=True, eq=False)
class CameraPoses:
    """N positions of the camera.

    Attributes:
        t_ns: Times, shape (N,), increasing.
        xy_m: Positions of the camera, shape (N, 2).
        heading_rad: Headings of the vehicle, shape (N,).
        cov_m2: Covariances of ``xy_m``, shape (N, 2, 2); zero if the source states no error.
    """

    t_ns: Int64s
    xy_m: Floats
    heading_rad: Floats
    cov_m2: Floats


@dataclass(slots=True)
class AddCounts:
    """Numbers of pictures by outcome.

    Attributes:
        pictures: All pictures.
        added: Pictures added as landmarks.
        too_near: Pictures too near to the last landmark.
        without_pose: Pictures without a pose at their time.
        undecodable: Pictures that do not decode.
        blank: Pictures with too few points.
    """

    pictures: int = 0
    added: int = 0
    too_near: int = 0
    without_pose: int = 0
    undecodable: int = 0
    blank: int = 0


def read_poses(path: Path, vehicle: Vehicle) -> CameraPoses:
    """Read the poses of a run folder, or of a truth file (``truth.json`` or its folder).

    Args:
        path: The run folder or truth file.
        vehicle: The camera's mounting, needed if a truth describes the rear axle.

    Raises:
        RunError: The run cannot be read.
        AnnotationError: The truth cannot be read.
    """
    if path.is_dir() and (path / "manifest.json").exists():
        return _run_poses(path)
    truth, track = load_truth(path)
    heading = heading_rad(track)
    lever = (vehicle.camera.x_m, vehicle.camera.y_m)
    xy_m = track.xyz_m[:, :2]
    if truth.pose_point != "camera":
        body = track_mounting(truth, vehicle)
        heading = heading - body.yaw_rad
        xy_m = xy_m + _turned((lever[0] - body.x_m, lever[1] - body.y_m), heading)
    return CameraPoses(track.t_ns, xy_m, heading, np.zeros((len(xy_m), 2, 2)))


def _run_poses(path: Path) -> CameraPoses:
    run = open_run(path)
    vehicle = run.drive_manifest().settings
    names = ["t_ns", "x_m", "y_m", "heading_rad", "cov_xx_m2", "cov_xy_m2", "cov_yy_m2"]
    table = run.table("pose", names)
    x, y, heading, xx, xy, yy = (table[name].to_numpy() for name in names[1:])
    offset = _turned((vehicle.camera.x_m, vehicle.camera.y_m), heading)
    return CameraPoses(
        table["t_ns"].to_numpy(),
        np.column_stack([x, y]) + offset,
        heading,
        position_cov(xx, xy, yy),
    )


def _turned(lever_m: tuple[float, float], heading: Floats) -> Floats:
    turned = complex(*lever_m) * np.exp(1j * heading)
    return np.column_stack([turned.real, turned.imag])


def add_from_log(
    writer: LandmarkWriter,
    matcher: Matcher,
    drive: Drive,
    vehicle: Vehicle,
    place_of: Callable[[int], LandmarkPosition | None],
    every_m: float,
) -> tuple[AddCounts, bool]:
    """Add a landmark every ``every_m`` along the path; return counts, and whether all rows count.

    Neighbouring landmarks share the errors of a run's poses, but a later replay assumes that they
    are independent. If the run drifted, make ``every_m`` large, or use a truth.

    Args:
        writer: Writer of the database.
        matcher: Matcher that computes the features.
        drive: The drive; warnings report what is dropped of its camera.
        vehicle: Names the camera if there are several; its clock is that of a replay.
        place_of: Place of the camera at a time; None where it is unknown.
        every_m: Straight distance between two landmarks.

    Raises:
        VehicleError: The logs have no camera, or several.
    """
    topics = [(i, topic) for i, log in enumerate(drive.logs) for topic in log.topics]
    camera = chosen_camera(topics, vehicle)
    if camera is None:
        raise MissingTopicError("the logs have no camera; use a log with pictures")
    number, topic = camera
    log, counts = drive.logs[number], AddCounts()
    ledger, last = Ledger(str(log.path)), None
    for block, pictures in pictures_of(log, number, topic, vehicle, ledger, drive.selection):
        for row, t_ns in enumerate(block.log_ns.tolist()):
            counts.pictures += 1
            place = place_of(t_ns)
            if place is None:
                counts.without_pose += 1
                continue
            if last is not None and math.dist(place.xy_m, last) < every_m:
                counts.too_near += 1
                continue
            try:
                features = matcher.describe(grey_of(encoded(pictures, row)))
            except LogError as error:
                counts.undecodable += 1
                lose(ledger, topic.name, t_ns, error)
                continue
            if len(features) < MIN_POINTS:
                counts.blank += 1
                continue
            writer.add(place, features)
            counts.added += 1
            last = place.xy_m
    warn_of(ledger)
    return counts, ledger.is_whole


def place_at(t_ns: int, poses: CameraPoses, sd_m: float, source: str) -> LandmarkPosition | None:
    """Return the camera's place at a time, named ``source/time``; None if no pose is near.

    Args:
        t_ns: The time.
        poses: Poses of the drive.
        sd_m: S.d. of the vehicle's distance from the landmark at the best match; added to the
            covariance of the poses.
        source: Name of the drive.
    """
    after = int(np.searchsorted(poses.t_ns, t_ns))
    if after == len(poses.t_ns) or (after == 0 and poses.t_ns[0] != t_ns):
        return None
    before = max(after - 1, 0) if poses.t_ns[after] != t_ns else after
    span_ns = int(poses.t_ns[after] - poses.t_ns[before])
    if span_ns > MAX_GAP_NS:
        return None
    fraction = (t_ns - int(poses.t_ns[before])) / span_ns if span_ns else 0.0
    xy_m = (1.0 - fraction) * poses.xy_m[before] + fraction * poses.xy_m[after]
    two = slice(before, after + 1)
    at = np.array([t_ns], np.int64)
    heading = interpolate_angle(at, poses.t_ns[two], poses.heading_rad[two])
    cov = poses.cov_m2[after] + sd_m**2 * np.eye(2)
    return LandmarkPosition(f"{source}/{t_ns}", xy_m, cov, float(heading[0]), source)


def add_from_images(
    writer: LandmarkWriter, matcher: Matcher, folder: Path, coordinates: Path, source: str
) -> AddCounts:
    """Add each picture that a table of coordinates names.

    The table is a CSV file with a header: ``image,x_m,y_m`` and ``sd_m`` or ``var_x_m2``,
    ``cov_xy_m2``, ``var_y_m2``, and optionally ``heading_rad`` (counter-clockwise from east).

    Raises:
        AnnotationError: The table is invalid; the message names the line.
        LogError: A picture is missing or does not decode.
    """
    counts = AddCounts()
    for name, place in read_coordinates(coordinates, source):
        counts.pictures += 1
        path = folder / name
        try:
            features = matcher.describe(grey_of(read_encoded(path)))
        except LogError as error:
            text = str(error)
            raise type(error)(text if text.startswith(str(path)) else f"{path}: {text}") from None
        if len(features) < MIN_POINTS:
            counts.blank += 1
            continue
        writer.add(place, features)
        counts.added += 1
    return counts


_COV_COLUMNS: Final = ("var_x_m2", "cov_xy_m2", "var_y_m2")


def read_coordinates(path: Path, source: str) -> Iterator[tuple[str, LandmarkPosition]]:
    """Yield the picture names and places of a table, as described in ``add_from_images``.

    Raises:
        AnnotationError: The table is invalid; the message names the line.
    """
    with_cov = f"image,x_m,y_m,{','.join(_COV_COLUMNS)}"
    for where, row in csv_rows(path, "image,x_m,y_m,sd_m", with_cov):
        yield str(row["image"]), _place_of(row, where, source)


def _place_of(row: dict[str, str], where: str, source: str) -> LandmarkPosition:
    def number(column: str) -> float:
        text = row.get(column)
        try:
            value = float(text or "")
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise AnnotationError(
                f"{where}: {column}: expected a finite number, got {text!r}; correct it"
            )
        return value

    xy_m = np.array([number("x_m"), number("y_m")])
    if row.get("sd_m"):
        sd_m = number("sd_m")
        if not sd_m > 0.0:
            raise AnnotationError(f"{where}: sd_m: expected > 0, got {sd_m}; correct it")
        cov = sd_m**2 * np.eye(2)
    else:
        xx, xy, yy = (number(column) for column in _COV_COLUMNS)
        cov = np.array([[xx, xy], [xy, yy]])
    heading = number("heading_rad") if row.get("heading_rad") else None
    try:
        return LandmarkPosition(f"{source}/{row['image']}", xy_m, cov, heading, source)
    except ValueError as error:
        raise AnnotationError(f"{where}: {error}; correct it") from None


def metres(text: str) -> float:
    """Parse a length in metres.

    Raises:
        UsageError: Not a finite number above 0.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise UsageError(f"{text!r}: expected metres, above 0")
    return value


def near_of(text: str | None) -> tuple[Floats, float] | None:
    """Parse ``x,y,r`` as a position and a radius in metres.

    Raises:
        UsageError: The text does not have this form.
    """
    if text is None:
        return None
    try:
        x, y, radius = (float(part) for part in text.split(","))
    except ValueError:
        x = y = radius = math.nan
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(radius) and radius >= 0.0):
        raise UsageError(f"near: {text}, expected x,y,radius in metres, such as --near=-12.5,80,50")
    return np.array([x, y]), radius
