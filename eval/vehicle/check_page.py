"""Report of a vehicle file's check as a page or a picture."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from crosscue.eval.report.html import write_page
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.vehicle.vehicle import Vehicle

from .check import Checked
from .ground_picture import ASSUMED, draw_ground

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
        coded = base64.b64encode(_encoded(drawn, ".jpg")).decode("ascii")
        picture = f"data:image/jpeg;base64,{coded}"
        caption = f"{found.picture.topic} at {found.picture.t_ns} ns. {_in_words(vehicle)}"
    content = {
        "vehicle": vehicle.name,
        "logs": logs,
        "part": part,
        "contradictions": found.contradictions,
        "picture": picture,
        "caption": caption,
        "signals": found.signals,
        "missing": found.missing,
    }
    write_page(path, "vehicle_check.html.j2", content, {"number": _number})


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
    if vehicle.regions.kind == "area":
        return grid
    return (
        f"{grid} Green: the regions in which road would be detected if an intersection began "
        f"{ASSUMED.start_m:g} m ahead and ended at {ASSUMED.end_m:g} m."
    )


def _number(value: float, digits: int) -> str:
    return f"{value:,.{digits}f}" if math.isfinite(value) else "-"
