"""The law of sides: a drive in a mirror gives the mirrored cues, ranges and beliefs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.faulty_labels import DETECTORS, LABEL_IMAGES
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Found, Frame, RoadMask, View
from crosscue.detectors.cues.far_side import MobileyeState
from crosscue.detectors.cues.observed import FrameDetections, RoadFractions, Sides
from crosscue.eval.cli import run
from crosscue.eval.pipeline.replay import observe
from crosscue.eval.pipeline.scene import stage
from crosscue.eval.pipeline.scene.stage import SceneTables, features_of, gives_reasons
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.runs.manifest import DetectManifest
from crosscue.eval.runs.tables.mobileye_tables import StoredMobileye
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.runs.tables.travelled import Odometer, Way
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS
from crosscue.replay.vehicle.vehicle import BUILTIN_CUES, CUES, Vehicle
from support.data import fetch_networks, shared
from support.pictures import picture_log
from support.scenes import shorten

OTHER: Final = {"left": "right", "right": "left"}


def exchanged(name: str) -> str:
    """Return a name with left and right exchanged."""
    return re.sub("left|right", lambda side: OTHER[side[0]], name)


def vehicle_of(vehicle: Vehicle, size_px: tuple[int, int]) -> Vehicle:
    """Return the vehicle file of the mirrored car."""
    camera, regions = vehicle.camera, vehicle.regions
    center_px = camera.center_px
    if center_px is not None:
        center_px = (size_px[0] - center_px[0], center_px[1])
    turned = {
        "center_px": center_px,
        "y_m": -camera.y_m,
        "yaw_rad": -camera.yaw_rad,
        "roll_rad": -camera.roll_rad,
    }
    polygons = {
        exchanged(side): tuple((1.0 - x, y) for x, y in getattr(regions, side))
        for side in ("left", "straight", "right")
    }
    return vehicle.model_copy(
        update={
            "camera": camera.model_copy(update=turned),
            "regions": regions.model_copy(update=polygons),
        }
    )


def mask_of(mask: bytes, size_px: tuple[int, int]) -> bytes:
    if not mask:
        return mask
    return rle.encode_mask(rle.decode_mask(mask, size_px)[:, ::-1], (0, 0), size_px)


def detections_of(found: Detections) -> Detections:
    boxes_px = found.boxes_px.copy()
    boxes_px[:, [0, 2]] = found.size_px[0] - boxes_px[:, [2, 0]]
    return replace(
        found,
        boxes_px=boxes_px,
        labels=tuple(map(exchanged, found.labels)),
        masks=tuple(mask_of(one, found.size_px) for one in found.masks),
    )


def frame_of(frame: FrameDetections) -> FrameDetections:
    road = frame.road
    if isinstance(road, RoadMask):
        road = replace(road, mask=mask_of(road.mask, road.mask_size_px))
    elif road is not None:
        road = RoadFractions(road.right, road.straight, road.left)
    return replace(
        frame,
        objects=tuple(map(detections_of, frame.objects)),
        signs=tuple(map(detections_of, frame.signs)),
        doubles=tuple(map(detections_of, frame.doubles)),
        road=road,
    )


def state_of(state: MobileyeState) -> MobileyeState:
    obstacles, lanes = state.obstacles, state.lanes
    if obstacles is not None:
        obstacles = obstacles.copy()
        obstacles[:, OBSTACLE_COLUMNS.index("y_m")] *= -1.0
    if lanes is not None:
        lanes = lanes.copy()
        for name in ("side", "c0_m", "c1", "c2_per_m", "c3_per_m2"):
            lanes[:, LANE_COLUMNS.index(name)] *= -1.0
    return MobileyeState(obstacles, lanes)


class Mirror:
    """Patches the scene stage so that it sees every run in a mirror."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        until, at = Odometer.until, StoredMobileye.at

        def mirrored_frames(*args: Any, **named: Any) -> Iterator[FrameDetections]:
            return map(frame_of, stored_frames(*args, **named))

        def mirrored_until(self: Odometer, t_ns: int) -> Way:
            way = until(self, t_ns)
            return way._replace(turn_rad=-way.turn_rad)

        def mirrored_at(self: StoredMobileye, t_ns: int) -> MobileyeState:
            return state_of(at(self, t_ns))

        patch.setattr(stage, "stored_frames", mirrored_frames)
        patch.setattr(Odometer, "until", mirrored_until)
        patch.setattr(StoredMobileye, "at", mirrored_at)


Rows = dict[str, list[dict[str, Any]]]


def observed(drive: Drive, run: RunFolder, detected: DetectManifest) -> Rows:
    """Return the rows of the scene's tables."""
    found: Rows = {}

    def sink(name: str, columns: dict[str, list[Any]]) -> None:
        found.setdefault(name, []).extend(
            dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)
        )

    vehicle = drive.vehicle
    tables = SceneTables(sink, features_of(vehicle), gives_reasons(vehicle))
    observe(drive, run, detected, tables)
    tables.flush()
    return found


def rows_of(found: Rows, width_px: int) -> Rows:
    """Return the rows that the mirrored run has to have."""
    mirrored: Rows = {}
    for name, rows in found.items():
        mirrored[name] = [
            {
                exchanged(column): exchanged(value) if isinstance(value, str) else value
                for column, value in row.items()
            }
            for row in rows
        ]
        for row in mirrored[name]:
            if name == "ranged_objects":
                row["x0"], row["x1"] = width_px - row["x1"], width_px - row["x0"]
    return mirrored


def differences(one: Rows, other: Rows) -> list[str]:
    """Return what differs by more than rounding, apart from the order of rows of one frame."""
    found = []
    for name in sorted(one.keys() | other.keys()):
        mine, theirs = (sorted(rows.get(name, []), key=_key) for rows in (one, other))
        if len(mine) != len(theirs):
            found.append(f"{name}: {len(mine)} and {len(theirs)} rows")
        for a, b in zip(mine, theirs, strict=False):
            for column in a:
                if not _is_same(a[column], b[column]):
                    where = f"{name} at {a['t_ns']} {a.get('cue', '')} {column}"
                    found.append(f"{where}: {a[column]} and {b[column]}")
    return found


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    return row["t_ns"], row.get("cue", ""), row.get("reference") or "", row.get("object", 0)


def _is_same(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return bool(np.isclose(one, other, rtol=1e-6, atol=1e-6, equal_nan=True))
    if isinstance(one, str) and isinstance(other, str):
        # Reasons are in the order of the table of cues.
        return sorted(one.split("; ")) == sorted(other.split("; "))
    return bool(one == other)


SCENE: Final = SceneSettings("L0", camera=SceneCamera(width_px=192, height_px=108))
# Label, left edge, its speed across, upper edge, width and height as fractions of the picture.
OBJECTS: Final = (
    ("stop sign", 0.7, 0.0, 0.3, 0.05, 0.09),
    ("traffic light", 0.62, 0.0, 0.2, 0.04, 0.12),
    ("car", 0.05, 0.12, 0.5, 0.2, 0.12),
    ("car", 0.75, -0.07, 0.55, 0.2, 0.12),
    ("car", 0.02, 0.0, 0.65, 0.2, 0.12),
    ("car", 0.3, 0.0, 0.66, 0.2, 0.12),
    ("one way left", 0.2, 0.0, 0.35, 0.08, 0.06),
    ("one way right", 0.85, 0.0, 0.36, 0.08, 0.06),
    ("do not enter", 0.4, 0.0, 0.34, 0.06, 0.1),
)
# A drive on which cars come from beyond the intersection, go there, and move in a leg.
CARS: Final = SceneSettings("M7806", camera=SceneCamera(width_px=480, height_px=270))
SIGNS: Final = ("one way left", "one way right", "do not enter")
PERIOD_NS: Final = 5_000_000_000


class Busy:
    """Finds the same objects in every picture, some of which move."""

    view = View(min_width_px=64)
    labels = tuple(dict.fromkeys(one[0] for one in OBJECTS if one[0] not in SIGNS))
    identity = "busy"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Detect."""
        return [self._of(frame) for frame in frames]

    def _of(self, frame: Frame) -> Found:
        width, height = frame.size_px
        passed_s = frame.t_ns % PERIOD_NS * 1e-9
        boxes, masks, labels = [], [], []
        for number, (label, x, speed, y, wide, high) in enumerate(OBJECTS):
            if label not in self.labels:
                continue
            size = (round(wide * width), round(high * height))
            corner = (round((x + speed * passed_s) * width), round(y * height))
            boxes.append([*corner, corner[0] + size[0], corner[1] + size[1]])
            outline = np.ones(size[::-1], np.bool_)
            # One end of a car is lower: its nose, on either side in turn.
            quarter = slice(0, size[0] // 4) if number % 2 else slice(-(size[0] // 4), None)
            outline[: size[1] // 2, quarter] = label != "car"
            masks.append(rle.encode_mask(outline, corner, frame.size_px))
            labels.append(label)
        scores = np.full(len(labels), 0.99)
        return Detections(
            frame.t_ns, frame.size_px, np.array(boxes, float), scores, tuple(labels), tuple(masks)
        )


class Signs(Busy):
    """Finds the signs that name a side."""

    labels = SIGNS
    identity = "signs"
    is_for_signs = True


class Road:
    """Finds road that is wider on the left, and goes on for some seconds."""

    labels: tuple[str, ...] = ()
    view = View(is_grey=True)
    identity = "road"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Detect."""
        mask = np.zeros((54, 96), np.bool_)
        mask[26:] = True
        mask[:40, 70:] = False
        return [
            RoadMask(one.t_ns, one.size_px, rle.encode_mask(mask, (0, 0), (96, 54)), (96, 54))
            for one in frames
        ]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A simulated drive with a Mobileye, in which every kind of object is found."""
    folder = tmp_path_factory.mktemp("mirror")
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch, pictures=80)
        files = write_scene(folder / "drive", SCENE)
    names = ",".join(f"{__name__}:{one}" for one in ("Busy", "Signs", "Road"))
    argv = ["replay", str(files.log), "--vehicle", str(files.vehicle), "--no-cache"]
    assert run([*argv, "--detectors", names, "-o", str(folder / "run")]) == 0
    return open_run(folder / "run")


@pytest.fixture(scope="module")
def labelled(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A simulated drive whose objects and road are the renderer's, with faults."""
    folder = tmp_path_factory.mktemp("labelled")
    files = write_scene(folder / "drive", CARS, imager=LABEL_IMAGES)
    argv = ["replay", str(files.log), "--vehicle", str(files.vehicle), "--no-cache"]
    assert run([*argv, "--detectors", DETECTORS, "-o", str(folder / "run")]) == 0
    return open_run(folder / "run")


def both(drive_run: RunFolder, changes: Mapping[str, Any]) -> tuple[Rows, Rows]:
    """Rows of a run, exchanged, and those of the run in a mirror."""
    manifest = drive_run.drive_manifest()
    detected = manifest.detected
    assert isinstance(detected, DetectManifest)
    frames = drive_run.table("frames", ["width_px", "height_px"])
    size_px = (frames["width_px"][0].as_py(), frames["height_px"][0].as_py())
    vehicle = manifest.settings
    for section, values in changes.items():
        changed = getattr(vehicle, section).model_copy(update=values)
        vehicle = vehicle.model_copy(update={section: changed})
    drive = Drive([], vehicle, segments=detected.timeline)
    straight = observed(drive, drive_run, detected)
    with pytest.MonkeyPatch.context() as patch:
        Mirror(patch)
        mirrored = observed(
            replace(drive, vehicle=vehicle_of(vehicle, size_px)), drive_run, detected
        )
    return rows_of(straight, size_px[0]), mirrored


def positive(rows: Rows) -> set[str]:
    return {row["cue"] for row in rows["cues"] if row["count"]}


CHANGES: Final[dict[str, dict[str, Any]]] = {
    "published rules": {},
    "tracks": {
        "cars": {"kind": "tracks", "leg_traffic": True},
        "cues": {"kind": "tracks"},
        "fusion": {"kind": "persistent"},
    },
}
REAL: Final = {
    "regions": {"kind": "area"},
    "cues": {"kind": "tracks"},
    "fusion": {"kind": "persistent"},
}
CHANGES_OF_CARS: Final[dict[str, dict[str, Any]]] = {
    "rules of real drives": {
        **REAL,
        "cars": {"kind": "tracks", "leg_traffic": True},
        "ranges": {"kind": "motion"},
    },
    "road by its shape": {**REAL, "camera": {"focal_px": None}},
}


def test_simulated_drive_in_a_mirror_is_mirrored_and_shows_every_cue(
    simulated: RunFolder, labelled: RunFolder
) -> None:
    seen: set[str] = set()
    for drive_run, some in ((simulated, CHANGES), (labelled, CHANGES_OF_CARS)):
        for name, changes in some.items():
            expected, mirrored = both(drive_run, changes)
            assert expected["belief"], name
            assert differences(expected, mirrored) == [], name
            # A cue of one side is that of the other in the mirror.
            seen |= positive(mirrored) | {exchanged(cue) for cue in positive(mirrored)}

    # Maps have a mirror of their own, see test_road_map.
    assert {BUILTIN_CUES[cue].group for cue in BUILTIN_CUES.keys() - seen} == {"map"}


def test_mirror_finds_a_rule_that_assumes_a_side(
    simulated: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A law that cannot fail would say nothing."""
    from crosscue.detectors.cues import cars

    def more_to_the_left(pairs: cars.Pairs, settings: object) -> Sides:
        x = pairs.step_px[:, 0]
        return Sides(int((x < 0).sum()), int((x > 2.0).sum()))

    monkeypatch.setattr(cars, "cross_traffic", more_to_the_left)
    expected, mirrored = both(simulated, {})

    assert any("cross_traffic" in one for one in differences(expected, mirrored))


def test_each_cue_of_a_side_has_the_same_row_on_the_other() -> None:
    for cue in CUES.values():
        other = CUES[exchanged(cue.name)]
        assert other.supports == tuple(map(exchanged, cue.supports))
        assert other.excludes == tuple(map(exchanged, cue.excludes))
        same = replace(cue, name="", supports=(), excludes=(), colour=(0, 0, 0), label=None)
        assert (
            replace(other, name="", supports=(), excludes=(), colour=(0, 0, 0), label=None) == same
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("folder", "pictures", "camera"),
    [
        (
            "kitti_t_junction",
            "image_0/*.*",
            "[camera]\nfocal_px = 707.0912\ncenter_px = [601.8873, 183.1104]\nz_m = 1.65\n",
        ),
        (
            "kitti_seq2_right_turn_98deg",
            "image_l/*.*",
            "[cars]\nleg_traffic = true\n"
            "[camera]\nfocal_px = 718.856\ncenter_px = [607.1928, 185.2157]\nz_m = 1.65\n",
        ),
        ("camvid_0016e5_light", "*.jpg", ""),
    ],
)
def test_real_drive_in_a_mirror_is_mirrored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, pictures: str, camera: str
) -> None:
    pytest.importorskip("openvino")
    # Without a focal length no road is seen.
    names = ["yolox-nano", "road-segmentation-adas-0001"][: 2 if camera else 1]
    fetch_networks(monkeypatch, tmp_path / "models", *names)
    every = sorted(shared("sequences", folder).glob(pictures))
    picture_log(tmp_path / "front", every[:52:2], 5.0)
    (tmp_path / "car.toml").write_text(f"version = 1\n{camera}")
    argv = ["replay", str(tmp_path / "front"), "--vehicle", str(tmp_path / "car.toml")]
    argv += ["--detectors", ",".join(names), "--no-cache", "-o", str(tmp_path / "run")]
    assert run(argv) == 0

    expected, mirrored = both(open_run(tmp_path / "run"), {})

    assert expected["belief"]
    assert differences(expected, mirrored) == []
