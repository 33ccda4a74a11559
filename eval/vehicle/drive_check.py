"""Check of a vehicle file on a few seconds of a drive, as a table, a page or a picture."""

import base64
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.cues.road import outlines
from crosscue.detectors.ranging.ground_plane import GroundPlane
from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.eval.report.html import write_page
from crosscue.replay.base import name_of
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import EmptyResultError, OutputError, UsageError
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.vehicle.vehicle import Camera, Vehicle, vehicle_given
from crosscue.results import HIDDEN, Result, json_key, listing

from .check import Checked, check_drive_signals

AHEAD_M: Final = (5, 10, 15, 20, 30, 50, 80)
ASIDE_M: Final = (-15, -10, -5, 0, 5, 10, 15)
# Distance ahead of the camera at which the grid begins.
NEAREST_M: Final = 0.5
YELLOW, WHITE, GREEN, BLACK = (0, 230, 255), (255, 255, 255), (80, 230, 80), (0, 0, 0)


def draw_ground(pixels: NDArray[np.uint8], vehicle: Vehicle) -> NDArray[np.uint8]:
    """Return a copy with the horizon, a grid in metres on the road, and the regions.

    Args:
        pixels: Shape (H, W, 3), uint8, in BGR order.
        vehicle: Settings of the camera and regions.
    """
    canvas = pixels.copy()
    size_px = (pixels.shape[1], pixels.shape[0])
    scale = max(size_px[0] / 1280, 0.5)
    camera = vehicle.camera
    ground = GroundPlane.of(camera, size_px)
    if camera.focal_px is not None:
        sides = np.array([0.0, float(size_px[0])])
        y = ground.horizon_px(sides)
        _line(canvas, np.column_stack([sides, y]), YELLOW, scale)
        _write(canvas, "horizon", (8.0, float(y[0]) - 6.0), YELLOW, scale)
    if camera.focal_px is not None and camera.z_m > 0.0:
        for line, text in _grid(camera):
            points = ground.project(line)
            if np.isnan(points).any():
                continue
            _line(canvas, points, WHITE, 0.6 * scale)
            x, below = points[0].tolist()
            if text and below < size_px[1]:
                _write(canvas, text, (x + 4.0, below - 4.0), WHITE, scale)
    regions = outlines(vehicle.regions, size_px)
    for name, polygon in zip(("left", "straight", "right"), regions, strict=False):
        _line(canvas, np.vstack([polygon, polygon[:1]]), GREEN, scale)
        middle = polygon.mean(axis=0)
        _write(canvas, name, (float(middle[0]), float(middle[1])), GREEN, scale)
    return canvas


def _grid(camera: Camera) -> Iterator[tuple[NDArray[np.float64], str]]:
    """Yield labelled lines across the road, from left to right, then lines along it."""
    for ahead in AHEAD_M:
        if ahead - camera.x_m > NEAREST_M:
            across = np.array([[ahead, max(ASIDE_M)], [ahead, min(ASIDE_M)]], np.float64)
            yield across, f"{ahead} m ahead"
    near = camera.x_m + max(NEAREST_M, 2.0 * camera.z_m)
    for aside in ASIDE_M:
        yield np.array([[near, aside], [max(AHEAD_M), aside]], np.float64), ""


def _line(
    canvas: NDArray[np.uint8],
    points: NDArray[np.float64],
    colour: tuple[int, int, int],
    scale: float,
) -> None:
    high, wide = canvas.shape[:2]
    # A line of the grid may extend far beyond the picture, but OpenCV's coordinates are limited.
    clipped = np.clip(points, -4.0 * max(high, wide), 4.0 * max(high, wide))
    places = np.rint(clipped * 16).astype(np.int32).reshape(-1, 1, 2)
    thick = max(1, round(2 * scale))
    cv2.polylines(canvas, [places], False, BLACK, thick + 2, cv2.LINE_AA, 4)
    cv2.polylines(canvas, [places], False, colour, thick, cv2.LINE_AA, 4)


def _write(
    canvas: NDArray[np.uint8],
    text: str,
    at: tuple[float, float],
    colour: tuple[int, int, int],
    scale: float,
) -> None:
    high, wide = canvas.shape[:2]
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.6 * scale
    (width, height), _ = cv2.getTextSize(text, font, size, 1)
    place = (
        int(min(max(at[0], 2.0), wide - width - 2.0)),
        int(min(max(at[1], height + 2.0), high - 4.0)),
    )
    cv2.putText(canvas, text, place, font, size, BLACK, max(3, round(4 * scale)), cv2.LINE_AA)
    cv2.putText(canvas, text, place, font, size, colour, max(1, round(1.4 * scale)), cv2.LINE_AA)


PAGES: Final = (".html",)
PICTURES: Final = (".jpg", ".jpeg", ".png")
WIDTH_PX: Final = 1280


def check_report_place(path: Path, overwrite: bool) -> None:
    """Check before any reading that the report can be written.

    Raises:
        UsageError: The file ending is not that of a page or picture.
        OutputError: The file exists.
    """
    if path.suffix.lower() not in PAGES + PICTURES:
        endings = ", ".join(PAGES + PICTURES)
        raise UsageError(f"{path}: expected a page or a picture, by its ending: {endings}")
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")


def write_check(
    path: Path, found: Checked, vehicle: Vehicle, logs: Sequence[str], part: str
) -> None:
    """Write the page, or only the picture, depending on the file's ending.

    Args:
        path: The file.
        found: Result of the check.
        vehicle: The settings that were checked.
        logs: Names of the logs.
        part: The seconds examined, in words.

    Raises:
        UsageError: A picture is requested, but the log has none.
        OutputError: The file cannot be written.
    """
    drawn = None if found.picture is None else draw_ground(found.picture.pixels, vehicle)
    if path.suffix.lower() in PICTURES:
        if drawn is None:
            raise UsageError(f"{path}: the log has no picture to draw on; give a name in .html")
        write_bytes(path, _encoded(drawn, path.suffix.lower()))
        return
    picture, caption = "", ""
    if drawn is not None and found.picture is not None:
        if drawn.shape[1] > WIDTH_PX:
            size = (WIDTH_PX, round(drawn.shape[0] * WIDTH_PX / drawn.shape[1]))
            drawn = np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), np.uint8)
        picture = base64.b64encode(_encoded(drawn, ".jpg")).decode("ascii")
        caption = f"{found.picture.topic} at {found.picture.t_ns} ns. {_in_words(vehicle)}"
    content = {
        "vehicle": vehicle.name,
        "logs": logs,
        "part": part,
        "contradictions": found.contradictions,
        "camera": picture,
        "caption": caption,
        "signals": found.signals,
        "missing": found.missing,
    }
    write_page(path, "vehicle_check.html.j2", content)


def _encoded(pixels: Bytes, ending: str) -> bytes:
    _, coded = cv2.imencode(ending, pixels)
    return coded.tobytes()


def _in_words(vehicle: Vehicle) -> str:
    """Return the legend of the lines in the picture."""
    if vehicle.camera.focal_px is None:
        return "No horizon and no grid: camera.focal_px is not in the vehicle file."
    grid = (
        f"Yellow: the horizon. White: metres from the rear axle on a level road, for a camera "
        f"{vehicle.camera.z_m:g} m above it, {math.degrees(vehicle.camera.pitch_rad):.2f} deg "
        "below the horizon; the lines along the road are 5 m apart."
    )
    if vehicle.regions.kind == "picture":
        return f"{grid} Green: the regions in which road is detected."
    return grid


HEAD = ("signal", "read from", "readings", "rate_hz", "lowest", "highest", "unit")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleCheck(Result):
    """Signals of a drive as decoded with a vehicle file, and their contradictions.

    Attributes:
        path: The page or picture; None if it was not requested.
        part: Seconds of the drive that were examined, in words.
        found: The signals, and the picture.
    """

    path: Path | None = field(metadata=json_key("page"))
    part: str
    found: Checked = field(metadata=HIDDEN)

    also: ClassVar = {
        "contradictions": "contradictions",
        "signals": "found.signals",
        "missing": "found.missing",
        "picture": "picture",
    }

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Contradictions between signals, one sentence each."""
        return self.found.contradictions

    @property
    def exit_status(self) -> int:
        """1 when signals contradict each other, else 0."""
        return 1 if self.contradictions else 0

    @property
    def picture(self) -> dict[str, object] | None:
        """Topic, time and size of the picture that was checked; None without a camera."""
        shown = self.found.picture
        if shown is None:
            return None
        height, width = shown.pixels.shape[:2]
        return {"topic": shown.topic, "t_ns": shown.t_ns, "size_px": (width, height)}

    def lines(self) -> Iterator[str]:
        """Yield a table of the signals, and what agrees or contradicts."""
        signals = self.found.signals
        rows = [
            (row.signal, row.source, row.count, row.rate_hz, row.low, row.high, row.unit)
            for row in signals
        ]
        yield from (
            f"examined {self.part}",
            "",
            listing(HEAD, rows, 2) if rows else "no signal",
            "",
        )
        yield from (f"agrees   {row.signal}: {row.agrees}" for row in signals if row.agrees)
        yield from (f"not read {signal}: {why}" for signal, why in self.found.missing.items())
        yield from [f"WRONG    {text}" for text in self.contradictions] or [
            "no contradiction found"
        ]
        if self.path is not None:
            yield str(self.path)


def check_vehicle(
    log: Log | UnopenedLog | Path | str,
    vehicle: Vehicle | Path | str,
    output: Path | str | None = None,
    *,
    start_s: float = 0.0,
    seconds: float = 10.0,
    overwrite: bool = False,
) -> VehicleCheck:
    """Check a vehicle file on part of a drive, and list contradictions.

    The values of each signal are listed. The page shows a picture with the horizon, distances along
    the road, and the regions searched for road. The exit status is 1 when signals contradict each
    other.

    Args:
        log: The drive, or its path.
        vehicle: The vehicle file to check.
        output: Page (.html) or picture (.jpg, .png) to write.
        start_s: Start this many seconds after the first message.
        seconds: Seconds of the log to read.
        overwrite: Replace an existing file.

    Raises:
        VehicleError: The vehicle file does not fit the drive.
        UsageError: The time span is out of range, or the output is neither a page nor a picture.
        OutputError: The file exists, or cannot be written.
        EmptyResultError: Those seconds contain neither a signal nor a picture.
    """
    path = None if output is None else Path(output)
    if path is not None:
        check_report_place(path, overwrite)
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        part = drive.part(start_s, start_s + seconds)
        found = check_drive_signals(part.logs, settings, part.selection)
        names = [name_of(one) for one in part.logs]
    words = f"{seconds:g} s starting at {start_s:g} s"
    if not found.signals and found.picture is None:
        why = "; ".join(f"{signal}: {text}" for signal, text in found.missing.items())
        raise EmptyResultError(f"{', '.join(names)}: {words}: no signal and no picture: {why}")
    if path is not None:
        write_check(path, found, settings, names, words)
    return VehicleCheck(path, words, found)
