"""A small simulated drive towards a stop sign, with a log whose clock is set or pauses.

The grey level of each picture is the number of its frame. The detector below computes the sign from
it, so that detections do not depend on times, which the clock changes.
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from crosscue.datasets.simulated.drive import dbc_path
from crosscue.datasets.truth.truth import Approach, CueTruth, Features, Truth, save
from crosscue.datasets.truth.tum import planar, write_tum
from crosscue.detectors.base import Detections, Found, Frame, View, nothing_found
from crosscue.eval.pipeline.detecting import Detecting, choices_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.encode import encode
from crosscue.replay.columns import DATA, Block, CanFrames, Floats, Images, Int64s, Messages, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load
from crosscue.replay.write.convert import LogWriter

SECOND: Final = 1_000_000_000
BEGIN: Final = 1_700_000_000 * SECOND
# Ten wheel rows and pictures per second.
ROW: Final = SECOND // 10
SPEED_MPS: Final = 6.0
# Distance from the first frame to the intersection.
START_M: Final = 70.0
# Range of distances in which the sign is visible.
SIGN_M: Final = (8.0, 55.0)
SIZE: Final = (160, 90)
FOCAL_PX: Final = 200.0
BUS: Final = Topic("/can", "crosscue/CanFrames", "columns")
CAMERA: Final = Topic("camera", "crosscue/Images", "columns")
CHOICE: Final = "support.gap_drive:build"
VEHICLE: Final = f"""version = 1
[topics]
camera = "camera"
[can]
bus = "/can"
dbc = ["simulated_car.dbc"]
[can.wheel_speeds]
front_left = "WHEEL_SPEEDS.FRONT_LEFT"
front_right = "WHEEL_SPEEDS.FRONT_RIGHT"
rear_left = "WHEEL_SPEEDS.REAR_LEFT"
rear_right = "WHEEL_SPEEDS.REAR_RIGHT"
[start]
heading_rad = 0.0
[camera]
x_m = 0.0
z_m = 1.4
focal_px = {FOCAL_PX}
center_px = [80.0, 45.0]
[ranges.stop_sign]
family = "pinhole"
parameters = [{FOCAL_PX}]
residual_sd_m = 0.5
[detectors.grey]
kind = "{CHOICE}"
"""


@dataclass(frozen=True, slots=True)
class Clock:
    """Mapping from true times to log times.

    Attributes:
        set_at_s: Time at which the clock is set.
        by_s: Change of the clock at that time.
        pause_s: Half-open interval in which no rows are recorded.
    """

    set_at_s: float = 0.0
    by_s: float = 0.0
    pause_s: tuple[float, float] = (0.0, 0.0)

    def recorded(self, t_ns: Int64s) -> tuple[Int64s, Int64s]:
        """Return the indices of the recorded rows, and their stamps."""
        first, last = (BEGIN + round(s * SECOND) for s in self.pause_s)
        rows = np.flatnonzero((t_ns < first) | (t_ns >= last))
        is_later = t_ns[rows] >= BEGIN + round(self.set_at_s * SECOND)
        return rows, t_ns[rows] + is_later * round(self.by_s * SECOND)


def distance_m(t_ns: Int64s) -> Floats:
    """True distance to the intersection, shape (N,)."""
    left: Floats = START_M - SPEED_MPS * (t_ns - BEGIN) / SECOND
    return left


def grey_pictures(numbers: Int64s) -> Images:
    """Return pictures whose grey level is the number of the frame."""
    grey = [np.full(SIZE[::-1], number, np.uint8) for number in numbers]
    return png_pictures([cv2.imencode(".png", picture)[1].tobytes() for picture in grey])


def png_pictures(coded: Sequence[bytes]) -> Images:
    """Return a block of encoded pictures."""
    edges = np.cumsum([0, *map(len, coded)])
    messages = Messages(np.frombuffer(b"".join(coded), np.uint8), edges[:-1], edges[1:])
    return Images(messages, ("png",) * len(coded))


def write_drive(
    folder: Path,
    clock: Clock,
    seconds: int = 14,
    rows_a_block: int = 7,
    name: str = "drive.mcap",
    topics: Sequence[Topic] = (BUS, CAMERA),
    pictures: Callable[[Int64s], Images] = grey_pictures,
) -> Path:
    """Write log, vehicle file and truth, and return the path of the log."""
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / name
    true_ns = np.arange(seconds * 10) * ROW + BEGIN
    rows, stamps = clock.recorded(true_ns)
    with LogWriter(log, Ledger(str(log)), overwrite=True) as writer:
        for topic in topics:
            writer.add_topic(topic)
        for part in np.array_split(np.arange(len(rows)), max(len(rows) // rows_a_block, 1)):
            at = stamps[part]
            if BUS in topics:
                writer.write(Block(BUS.name, at, _wheels(len(at))))
            if CAMERA in topics:
                writer.write(Block(CAMERA.name, at, pictures(rows[part])))
    shutil.copyfile(dbc_path(), folder / "simulated_car.dbc")
    (folder / "car.toml").write_text(VEHICLE, encoding="utf-8")
    _write_truth(folder, true_ns)
    return log


def replay(folder: Path, log: Path, run: str = "run", selection: Selection = EVERYTHING) -> Outcome:
    """Replay a log with the folder's vehicle file and detector."""
    vehicle = load(folder / "car.toml")
    detecting = Detecting(tuple(choices_of(vehicle).values()), cache=folder / "cache.sqlite")
    with open_log(log) as opened:
        into = create(folder / run, overwrite=True)
        return replay_drive(Drive([opened], vehicle, selection), into, detecting)


def replayed(folder: Path, log: Path, run: str = "run") -> RunFolder:
    """Replay a log like ``replay``, and return the run folder."""
    return replay(folder, log, run).run


def _wheels(n: int) -> CanFrames:
    message = CanDatabase.load([dbc_path()]).named("WHEEL_SPEEDS")
    speed = np.full(n, SPEED_MPS * 3.6)
    names = ("FRONT_LEFT", "FRONT_RIGHT", "REAR_LEFT", "REAR_RIGHT")
    payload = encode(message, dict.fromkeys(names, speed))
    no = np.zeros(n, np.bool_)
    identifier, length = np.full(n, 176, np.uint32), np.full(n, payload.shape[1], np.uint8)
    return CanFrames(identifier, no, np.full(n, DATA, np.uint8), length, payload, no)


def _write_truth(folder: Path, true_ns: Int64s) -> None:
    left_m = distance_m(true_ns)
    enter_ns = int(true_ns[left_m > 0.0][-1])
    save(
        Truth(
            version=1,
            source="made up",
            start_ns=int(true_ns[0]),
            end_ns=int(true_ns[-1]) + 1,
            pose="pose.tum",
            ranges="ranges.csv",
            approaches=(
                Approach(
                    id=0,
                    intersection="A",
                    start_ns=int(true_ns[0]),
                    enter_ns=enter_ns,
                    control="stop_sign",
                    features=Features(left=True, right=True, straight=True),
                    length_m=10.0,
                ),
            ),
            cues=(
                CueTruth(cue="stop_sign", present=True, start_ns=int(true_ns[0]), end_ns=enter_ns),
            ),
        ),
        folder,
    )
    zero = np.zeros(len(true_ns))
    write_tum(folder / "pose.tum", planar(true_ns, START_M - left_m, zero, zero), "made up")
    lines = [f"{t},0,{m:.4f},{m + 10.0:.4f}" for t, m in zip(true_ns, left_m, strict=True)]
    (folder / "ranges.csv").write_text("\n".join(["t_ns,approach,start_m,end_m", *lines]) + "\n")


class GreyNumber:
    """A detector that reads the frame's number and returns the sign visible at that position."""

    view = View(is_grey=True)
    identity = "grey number"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Detect."""
        return [self._one(frame) for frame in frames]

    def _one(self, frame: Frame) -> Found:
        number = int(np.median(frame.pixels))
        left_m = float(distance_m(np.array([BEGIN + number * ROW], np.int64))[0])
        if not SIGN_M[0] < left_m < SIGN_M[1]:
            return nothing_found(frame)
        height = FOCAL_PX / left_m
        box = np.array([[100.0, 40.0, 100.0 + height, 40.0 + height]])
        return Detections(frame.t_ns, frame.size_px, box, np.ones(1), ("stop sign",), (b"",))


def build() -> GreyNumber:
    """Build the detector, as ``CHOICE`` specifies."""
    return GreyNumber()
