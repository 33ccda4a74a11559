"""Write a run of a simulated intersection as files: log, vehicle file, DBC file and truth.

The log is written in parts of a second, so that memory holds the pictures of one second only.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.rendering.render import PictureSettings, RenderedFrame, Renderer
from crosscue.datasets.scenes.scene_truth import DriveAnnotations
from crosscue.datasets.scenes.settings import SceneSettings, world_of
from crosscue.datasets.simulated.drive import (
    FILES_OF_DRIVE,
    START_NS,
    DriveSettings,
    TrueMotion,
    dbc_path,
    sense,
    with_simulated_noise,
)
from crosscue.datasets.simulated.log_files import SOURCE, sensor_blocks, true_track
from crosscue.datasets.truth.truth import Approach, Features, Mounting
from crosscue.datasets.truth.tum import write_track_truth
from crosscue.replay.columns import Block, ImageCoding, Int64s, Messages, Topic, image_block
from crosscue.replay.encode.outgoing import standard_type
from crosscue.replay.encode.template import filled, template_of
from crosscue.replay.files import door
from crosscue.replay.files.made_of import SIMULATED, made_of, refuse_another
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import sha256_of, write_bytes, write_text
from crosscue.replay.ledger import Ledger
from crosscue.replay.write.convert import LogWriter
from crosscue.results import Result

from .layout import Layout
from .mobileye import Device
from .motion import Conditions
from .scene_truth import CueRuns, present
from .settings import scene_vehicle_text
from .world import World

# File that identifies the drive of a folder.
MADE_OF: Final = SIMULATED
CAR_BUS: Final = "/can/car"
MOBILEYE_BUS: Final = "/can/mobileye"
IMAGES: Final = "/camera/image/compressed"
CALIBRATION: Final = "/camera/camera_info"
# Start of drives with sparse pictures, as the distance before the intersection.
FROM_M: Final = 62.0
SPACING_M: Final = 5.0
SPACING_S: Final = 1.0
TOPICS: Final = (
    Topic(CAR_BUS, "crosscue/CanFrames", "columns"),
    Topic(MOBILEYE_BUS, "crosscue/CanFrames", "columns"),
    Topic(IMAGES, "crosscue/Images", "columns"),
    Topic(CALIBRATION, "sensor_msgs/msg/CameraInfo", "cdr"),
    Topic("/imu", "sensor_msgs/msg/Imu", "columns"),
    Topic("/compass", "sensor_msgs/msg/MagneticField", "columns"),
)


@dataclass(frozen=True, slots=True, repr=False)
class SceneFiles(Result):
    """The files of one simulated drive.

    Attributes:
        log: Path of ``drive.mcap``.
        vehicle: Path of ``vehicle.toml``.
        truth: Path of ``truth.json``.
        pictures: Number of pictures.
        seconds: Duration of the drive.
    """

    log: Path
    vehicle: Path
    truth: Path
    pictures: int
    seconds: float
    also: ClassVar = {"name": "name"}

    @property
    def name(self) -> str:
        """Name of the drive."""
        return self.log.parent.name

    def lines(self) -> Iterator[str]:
        """Yield the drive's folder, duration and number of pictures."""
        yield f"{self.log.parent}: {self.seconds:.1f} s, {self.pictures} pictures"


class Imager(NamedTuple):
    """Kind of pictures that a drive's camera records.

    Attributes:
        name: Name in ``simulated.json``; empty for photographs.
        pictures: Function that yields times and pictures of a run.
        encode: Function that encodes a picture.
        coding: Coding of the encoded pictures.
        is_painted: True if the pictures show the ground's colours.
    """

    name: str
    pictures: Callable[[World, SceneSettings], Iterator[tuple[int, RenderedFrame]]]
    encode: Callable[[RenderedFrame, PictureSettings], bytes]
    coding: ImageCoding
    is_painted: bool = True


def pictures(world: World, settings: SceneSettings) -> Iterator[tuple[int, RenderedFrame]]:
    """Yield times and pictures of a run, without writing anything."""
    renderer = Renderer(world, settings.camera, settings.picture)
    for number, t_ns in enumerate(picture_times(world, settings).tolist()):
        yield t_ns, renderer.picture((t_ns - START_NS) * 1e-9, number)


def picture_times(world: World, settings: SceneSettings) -> Int64s:
    """Return the times at which pictures are grabbed."""
    motion = world.approach.motion
    step = 1_000_000_000 // settings.rate_hz
    return np.arange(int(motion.t_ns[0]), int(motion.t_ns[-1]), step, dtype=np.int64)


def jpeg(rgb: NDArray[np.uint8], quality: int) -> bytes:
    """Encode a picture as JPEG."""
    bgr = np.ascontiguousarray(rgb[..., ::-1])
    return bytes(cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, quality])[1])


def _photograph(picture: RenderedFrame, settings: PictureSettings) -> bytes:
    return jpeg(picture.rgb, settings.jpeg_quality)


PHOTOGRAPHS: Final = Imager("", pictures, _photograph, "jpeg")


def sparse_pictures(world: World, settings: SceneSettings) -> Iterator[tuple[int, RenderedFrame]]:
    """Yield photographs every ``SPACING_M`` of the last ``FROM_M``, or ``SPACING_S`` if slower."""
    renderer, motion = Renderer(world, settings.camera, settings.picture), world.approach.motion
    last_m, last_ns = -math.inf, 0
    for number, t_ns in enumerate(picture_times(world, settings).tolist()):
        x_m = float(np.interp(t_ns, motion.t_ns, motion.x_m))
        t_s = (t_ns - START_NS) * 1e-9
        if x_m < -FROM_M or t_s > world.approach.enter_s + 0.2:
            continue
        if x_m - last_m >= SPACING_M or t_ns - last_ns >= SPACING_S * 1e9:
            last_m, last_ns = x_m, t_ns
            yield t_ns, renderer.picture(t_s, number)


# Few enough photographs to process a hundred layouts with networks.
SPARSE_PHOTOGRAPHS: Final = Imager("sparse photographs 1", sparse_pictures, _photograph, "jpeg")


def write_scene(
    folder: Path,
    settings: SceneSettings,
    *,
    overwrite: bool = False,
    imager: Imager = PHOTOGRAPHS,
    is_calibrated: bool = True,
) -> SceneFiles:
    """Simulate a run and write its files to ``folder``.

    Args:
        folder: Folder for the files.
        settings: Settings of the run.
        overwrite: Replace an existing drive of the same settings.
        imager: Kind of pictures that its camera records.
        is_calibrated: Write the simulator's noise to the vehicle file; otherwise the noise is that
            of a generic car, as in the published study.

    Raises:
        OutputError: A file exists already, or cannot be written.
        UsageError: A different drive exists, which ``overwrite`` would destroy.
    """
    if overwrite:
        refuse_other_drive(folder, settings, imager)
    layout, conditions, world = world_of(settings, is_painted=imager.is_painted)
    log = folder / "drive.mcap"
    record = _Record(layout, conditions, world, settings, imager)
    with LogWriter(log, Ledger(str(log)), overwrite=overwrite, beside=FILES_OF_DRIVE) as writer:
        # Before the log is complete, so that a drive that was cut short can be made again.
        made = made_of([], _settings_of(settings, imager))
        write_text(folder / MADE_OF, strict_json(made) + "\n")
        for topic in TOPICS:
            writer.add_topic(topic)
        for block in record.blocks():
            writer.write(block)
    write_bytes(folder / "simulated_car.dbc", dbc_path().read_bytes())
    write_text(folder / "vehicle.toml", record.vehicle_text(is_calibrated=is_calibrated))
    return SceneFiles(
        log,
        folder / "vehicle.toml",
        record.write_truth(folder),
        len(record.objects.images),
        len(world.approach.motion) / 100.0,
    )


def _settings_of(settings: SceneSettings, imager: Imager) -> dict[str, Any]:
    return asdict(settings) | ({"imager": imager.name} if imager.name else {})


def refuse_other_drive(folder: Path, settings: SceneSettings, imager: Imager = PHOTOGRAPHS) -> None:
    """Refuse to replace a drive of other settings.

    Raises:
        UsageError: The folder contains a drive of other or unknown settings.
    """
    if not (folder / "drive.mcap").exists():
        return
    try:
        there = json_tree(door.read(folder / MADE_OF))
    except (OSError, ValueError):
        there = None
    refuse_another(folder, "--overwrite", there, made_of([], _settings_of(settings, imager)))


class _Record:
    def __init__(
        self,
        layout: Layout,
        conditions: Conditions,
        world: World,
        settings: SceneSettings,
        imager: Imager,
    ) -> None:
        self._imager = imager
        self.layout, self.conditions = layout, conditions
        self.world, self.settings = world, settings
        self.objects = DriveAnnotations()
        approach = 0 if layout.is_intersection else None
        self._cues = CueRuns(1_000_000_000 // settings.rate_hz, approach)
        self._ranges: list[str] = []
        rng = np.random.default_rng([layout.seed, 8])
        self._heading_rad = float(rng.uniform(-np.pi, np.pi))
        self._car = DriveSettings(seed=conditions.seed)
        self._motion = _in_map(world.approach.motion, self._heading_rad)
        self._enter_ns = START_NS + round(world.approach.enter_s * 1e9)

    def blocks(self) -> Iterator[Block]:
        device = Device(self.world, np.random.default_rng([self.conditions.seed, 9]))
        others = [
            replace(block, topic=CAR_BUS) if block.topic == "/can" else block
            for block in sensor_blocks(sense(self._motion, self._car), self.conditions.seed)
        ]
        batch: list[tuple[int, RenderedFrame]] = []
        begin, until = -(2**62), START_NS
        late = np.random.default_rng([self.conditions.seed, 10])
        for t_ns, picture in self._imager.pictures(self.world, self.settings):
            self._note(t_ns, picture)
            batch.append((t_ns, picture))
            until = t_ns + 1_000_000_000 // self.settings.rate_hz
            if len(batch) == self.settings.rate_hz:
                yield from self._second(batch, _between(others, begin, until), device, late)
                # Pictures may be far apart, and the sensors continue between two batches.
                batch, begin = [], until
        if batch:
            yield from self._second(batch, _between(others, begin, until), device, late)
        for block in others:
            yield block.take(block.log_ns >= until)

    def _second(
        self,
        batch: list[tuple[int, RenderedFrame]],
        others: Iterator[Block],
        device: Device,
        late: np.random.Generator,
    ) -> Iterator[Block]:
        yield from others
        times = np.array([t_ns for t_ns, _ in batch], np.int64)
        log_ns = times + 9_000_000 + np.rint(late.exponential(2e6, len(times))).astype(np.int64)
        coded = [self._imager.encode(picture, self.settings.picture) for _, picture in batch]
        codings = [self._imager.coding] * len(coded)
        yield image_block(IMAGES, np.maximum.accumulate(log_ns), coded, codings, times)
        yield _calibration(times, log_ns, self.settings.camera)
        yield device.frames(times, [picture for _, picture in batch], MOBILEYE_BUS)

    def _note(self, t_ns: int, picture: RenderedFrame) -> None:
        to_start = -picture.view.rear_axle[0]
        self.objects.add(t_ns, picture, self.conditions.tags(self.layout), to_start)
        if t_ns < self._enter_ns:
            self._cues.add(t_ns, present(self.layout, picture))
            if not self.layout.is_intersection:
                return
            to_end = to_start + self.layout.end_m
            self._ranges.append(f"{t_ns},0,{to_start:.4f},{to_end:.4f}")

    def vehicle_text(self, *, is_calibrated: bool) -> str:
        text = scene_vehicle_text(
            self.settings.camera,
            traffic=self.settings.traffic,
            mounting_yaw_rad=self._car.mounting_yaw_rad,
            declination_rad=self._car.declination_rad,
            heading_rad=self._heading_rad,
        )
        return with_simulated_noise(text, self._car, self._motion) if is_calibrated else text

    def write_truth(self, folder: Path) -> Path:
        """Write truth, objects, trajectory and ranges, and return the path of the truth file."""
        motion, layout = self._motion, self.layout
        self.objects.save(folder / "objects.json", SOURCE)
        if layout.is_intersection:
            lines = ["t_ns,approach,start_m,end_m", *self._ranges, ""]
            write_text(folder / "ranges.csv", "\n".join(lines))
        start_ns, step = int(motion.t_ns[0]), 1_000_000_000 // self.settings.rate_hz
        approach = Approach(
            id=0,
            intersection=layout.name,
            start_ns=start_ns,
            enter_ns=self._enter_ns,
            control=layout.control,
            one_way=layout.one_way,
            do_not_enter=layout.do_not_enter,
            features=Features(
                left=layout.goes_left, right=layout.goes_right, straight=layout.goes_ahead
            ),
            conditions=self.conditions.tags(layout),
            length_m=layout.end_m,
        )
        return write_track_truth(
            folder,
            "drive.mcap",
            true_track(motion),
            SOURCE,
            log_sha256=sha256_of(folder / "drive.mcap"),
            end_ns=int(motion.t_ns[-1]) + step,
            place=layout.name,
            mounting=Mounting(),
            mounting_source=SOURCE,
            source=SOURCE,
            approaches=(approach,) if layout.is_intersection else (),
            cues=self._cues.finished(),
            objects="objects.json",
            ranges="ranges.csv" if layout.is_intersection else None,
        )


def _in_map(motion: TrueMotion, heading_rad: float) -> TrueMotion:
    """Transform a motion from the intersection's frame to the map, whose origin is the start."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    x, y = motion.x_m - motion.x_m[0], motion.y_m - motion.y_m[0]
    return replace(
        motion, x_m=c * x - s * y, y_m=s * x + c * y, heading_rad=motion.heading_rad + heading_rad
    )


def _between(blocks: list[Block], begin_ns: int, end_ns: int) -> Iterator[Block]:
    """Yield the parts of blocks between two times that have rows."""
    for block in blocks:
        part = block.take((block.log_ns >= begin_ns) & (block.log_ns < end_ns))
        if len(part):
            yield part


def _calibration(times: Int64s, log_ns: Int64s, camera: SceneCamera) -> Block:
    _, plan = standard_type("sensor_msgs/msg/CameraInfo")
    n, (cx, cy), f = len(times), camera.centre_px, camera.focal
    layout = template_of(
        plan, {"header.frame_id": "camera", "distortion_model": "plumb_bob"}, {"d": 5}
    )
    rows = filled(
        plan,
        layout,
        n,
        {
            "header.stamp": times,
            "height": np.full(n, camera.height_px),
            "width": np.full(n, camera.width_px),
            "k": np.tile([f, 0, cx, 0, f, cy, 0, 0, 1.0], (n, 1)),
            "r": np.tile(np.eye(3).ravel(), (n, 1)),
            "p": np.tile([f, 0, cx, 0, 0, f, cy, 0, 0, 0, 1.0, 0], (n, 1)),
        },
    )
    stop = np.arange(1, n + 1, dtype=np.int64) * rows.shape[1]
    messages = Messages(np.ascontiguousarray(rows).ravel(), stop - rows.shape[1], stop)
    return Block(CALIBRATION, np.maximum.accumulate(log_ns), messages)
