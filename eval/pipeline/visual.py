"""Visual odometry in the two stages: pictures are followed by ``detect``, and ``estimate`` uses it.

The table ``visual_odometry`` has one row for each pair of successive pictures. It is filled where
the vehicle file has ``odometry.kind = "visual"``, or by default where no log has a speed. It is
also filled where road is accumulated on the ground, which needs the camera's pitch in the rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from crosscue.detectors.base import Detections, Found, View
from crosscue.detectors.images import decode
from crosscue.detectors.runner import FrameResult
from crosscue.eval.runs.account import Line, line
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.tables.parquet import TableFolder
from crosscue.localization.odometry import BY_NOTHING, BY_YAW_RATE, Increments
from crosscue.localization.visual_odometry import HEIGHT_SD, VisualOdometry
from crosscue.replay.columns import Floats
from crosscue.replay.errors import VehicleError
from crosscue.replay.safe_text import counted
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.signals.plan import plan
from crosscue.replay.vehicle.vehicle import Vehicle

TABLE: Final = "visual_odometry"
# COCO's classes that move, beside the vehicle file's labels of cars; their boxes are masked.
MOVING: Final = ("person", "bicycle", "motorcycle", "bus", "truck", "train")
# Time for which the last speed is kept where the ground shows none, and s.d. of acceleration.
HELD_NS: Final = 1_000_000_000
ACCEL_SD_MPS2: Final = 2.0


def uses_pictures(drive: Drive, *, finds_road: bool) -> bool:
    """Return whether pictures are compared: for the odometry, or for the camera's pitch alone.

    Args:
        drive: The drive.
        finds_road: True if a detector finds road, whose projection to the ground needs the pitch.
    """
    vehicle = drive.vehicle
    kind = vehicle.odometry.kind
    if kind != "auto":
        return kind == "visual"
    if finds_road and vehicle.regions.kind == "area" and vehicle.camera.focal_px is not None:
        return True
    try:
        return plan(drive.topics, vehicle).source_of(Signal.WHEEL_SPEEDS) is None
    except VehicleError:
        # A named topic is in none of these logs; ``estimate`` reports it.
        return False


@dataclass(slots=True)
class VisualPass:
    """Visual odometry over the frames of the detect stage."""

    vehicle: Vehicle
    odometry: VisualOdometry = field(init=False)

    def __post_init__(self) -> None:
        self.odometry = VisualOdometry(self.vehicle.camera)

    def __call__(self, frame: FrameResult) -> dict[str, object] | None:
        """Return the row from the previous frame to this one; None for the first."""
        grey, _ = decode(frame.picture, View(is_grey=True), self.vehicle.camera.depth_bits)
        labels = {*self.vehicle.cars.labels, *MOVING}
        step = self.odometry(frame.t_ns, grey, moving_boxes(frame.found, labels))
        if step is None:
            return None
        return {
            name: None if isinstance(value, float) and math.isnan(value) else value
            for name, value in step._asdict().items()
        }


def moving_boxes(found: Sequence[Found], labels: set[str], score: float = 0.0) -> Floats:
    """Boxes of everything that may move, with a score above ``score``, shape (N, 4)."""
    boxes = [
        one.boxes_px[i]
        for one in found
        if isinstance(one, Detections)
        for i, label in enumerate(one.labels)
        if label in labels and one.scores[i] > score
    ]
    return np.array(boxes, np.float64).reshape(-1, 4)


def with_visual_scale(vehicle: Vehicle) -> Vehicle:
    """Return the settings with the scale error of distances that depend on the camera's height.

    It is common to all pairs of pictures, so ranges from motion cannot average it out.
    """
    scale_sd = max(vehicle.odometry.scale_sd, HEIGHT_SD)
    odometry = vehicle.odometry.model_copy(update={"scale_sd": scale_sd})
    return vehicle.model_copy(update={"odometry": odometry})


@dataclass(frozen=True, slots=True)
class VisualSource:
    """Odometry by the pictures of a run.

    Attributes:
        increments: Intervals of known motion; empty if the pictures show none.
        pairs: Number of pairs of pictures.
        standing: Number of those in which the car stands.
        assumed: Number of those for which the last speed is kept.
    """

    increments: Increments
    pairs: int
    standing: int
    assumed: int

    def notice(self) -> str:
        """Return what the run says about its odometry."""
        measured = len(self.increments) - self.assumed
        return (
            f"odometry from the pictures (visual): {measured} of "
            f"{counted(self.pairs, 'pair')} of pictures measured, {self.standing} standing; "
            f"{self.assumed} at the last speed; distances are as uncertain as camera.z_m"
        )

    def account(self) -> Line:
        """Return the account of the pairs of pictures."""
        used = len(self.increments)
        return line(self.pairs, used, {"neither standing nor seen to move": self.pairs - used})


def visual_source(run: TableFolder) -> VisualSource | None:
    """Return the odometry by the pictures of a run; None where they were not compared.

    Where the ground shows no speed for up to a second, the last one is kept, with the deviation of
    an unknown acceleration. Longer intervals are left out: their motion is unknown.

    Raises:
        RunError: The table is damaged.
    """
    if not run.file(f"{TABLE}.parquet").exists():
        return None
    rows = run.table(TABLE).to_pylist()
    if not rows:
        return None
    kept: list[tuple[float, ...]] = []
    starts: list[int] = []
    stops: list[int] = []
    assumed: list[bool] = []
    speed_mps, seen_ns = 0.0, None
    for row in rows:
        seconds = (row["t_ns"] - row["start_ns"]) * 1e-9
        distance_m, sd_m = row["distance_m"], row["distance_sd_m"]
        is_assumed = distance_m is None
        if distance_m is None:
            if seen_ns is None or row["t_ns"] - seen_ns > HELD_NS:
                continue
            unseen_s = (row["t_ns"] - seen_ns) * 1e-9
            distance_m, sd_m = speed_mps * seconds, ACCEL_SD_MPS2 * unseen_s * seconds
        else:
            speed_mps, seen_ns = distance_m / seconds, row["t_ns"]
        turn_rad, turn_sd_rad = row["turn_rad"], row["turn_sd_rad"]
        if turn_rad is None:
            turn_rad, turn_sd_rad = 0.0, 0.5 * seconds
        speed_var = (sd_m / seconds) ** 2 + (0.5 * ACCEL_SD_MPS2 * seconds) ** 2
        kept.append((distance_m, turn_rad, sd_m**2, turn_sd_rad**2, speed_mps, speed_var))
        starts.append(row["start_ns"])
        stops.append(row["t_ns"])
        assumed.append(is_assumed)
    columns = np.array(kept, np.float64).reshape(-1, 6).T
    is_gap = np.array(assumed, np.bool_)
    increments = Increments(
        np.array(starts, np.int64),
        np.array(stops, np.int64),
        *(columns[0], columns[1], columns[2], columns[3], columns[4], columns[5]),
        turn_source=np.where(is_gap, BY_NOTHING, BY_YAW_RATE).astype(np.uint8),
        is_gap=is_gap,
    )
    standing = sum(row["is_standing"] for row in rows)
    return VisualSource(increments, len(rows), standing, int(is_gap.sum()))
