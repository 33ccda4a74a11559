"""Detections are stored by ``detect``; cues are computed once, by ``estimate``."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Found, Frame, RoadMask, View
from crosscue.detectors.cues import labelled
from crosscue.detectors.cues.rules import rule_of
from crosscue.detectors.runner import OTHER_SIZE
from crosscue.eval.cli import run
from crosscue.eval.runs.folder import open_run
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.replay.files.made_of import SIMULATED
from crosscue.replay.vehicle.vehicle import SIMULATED_CAR, Vehicle, load
from support.commands import output_of
from support.data import shared
from support.gap_drive import Clock, GreyNumber, write_drive
from support.pictures import picture_log
from support.refusals import refusal

BRIGHT = "support.detecting:build"
CITY = (
    "road,sidewalk,building,wall,fence,pole,traffic light,traffic sign,vegetation,terrain,sky,"
    "person,rider,car,truck,bus,train,motorcycle,bicycle"
)
ROAD_CARDS = {
    "twinlitenet": (
        "twinlitenet",
        "cv2",
        """weights = "FOLDER/twinlitenet_best.onnx"
sha256 = "f505b56bd7c9e4e38b2928373aa4daa191a9a398e07e1fb340024b9ce84d4285"
[input]
width_px = 640
height_px = 360
colour = "rgb"
scale = [0.00392156862745098, 0.00392156862745098, 0.00392156862745098]
[output]
kind = "segmentation"
name = "da"
classes = ["other", "road"]
""",
    ),
    "road-segmentation-adas-0001": (
        "road-segmentation-adas-0001",
        "openvino",
        """weights = "FOLDER/road-segmentation-adas-0001.xml"
sha256 = "51d457ec677cb921c1003f6447671fdfba5acec5df6ecc0a236b613062ea852f"
sha256_bin = "2a1d09b6aab18e145f14d92f5f425af92ad5338a04b0670205759d8c5b075111"
[input]
width_px = 896
height_px = 512
[output]
kind = "segmentation"
classes = ["background", "road", "curb", "mark"]
road = ["road", "mark"]
""",
    ),
    "deeplab": (
        "deeplab_cityscapes_slim",
        "ai_edge_litert",
        f"""weights = "FOLDER/deeplab_mobilenet_edgetpu_slim_cityscapes_quant.tflite"
sha256 = "322fe29945cb1693f426952f2a330ab67ea5678545ddee6f2548e0cfd0ca03e5"
[input]
width_px = 513
height_px = 513
colour = "rgb"
layout = "nhwc"
dtype = "uint8"
[output]
kind = "segmentation"
classes = {json.dumps(CITY.split(","))}
""",
    ),
}


def _folder(tmp_path: Path, count: int = 5) -> Path:
    greys = np.zeros((count, 48, 64), np.uint8)
    for i, grey in enumerate(greys):
        grey[10:20, 8 + i : 24 + i] = 255
    return picture_log(tmp_path / "cam", greys)


@pytest.mark.parametrize(
    ("counted", "message"),
    [
        ('[cars]\nlabels = ["bright"]', "its cars do not count as parked"),
        (
            '[cues]\ntraffic_light_labels = ["bright"]',
            "heights of signs and lights are those of boxes",
        ),
        ("", None),
    ],
    ids=("cars", "lights", "not counted"),
)
def test_notice_names_rules_that_use_boxes_instead_of_masks(
    tmp_path: Path, counted: str, message: str | None
) -> None:
    """If a detector returns boxes only, eq. 15 uses boxes and eq. 16 is not evaluated."""
    log, out, vehicle = _folder(tmp_path, 1), tmp_path / "run", tmp_path / "car.toml"
    vehicle.write_text(f"version = 1\n{counted}\n")

    args = ["--vehicle", str(vehicle), "--detectors", BRIGHT, "--no-cache", "-q"]
    assert run(["replay", str(log), "-o", str(out), *args]) == 0

    notices = [one for one in open_run(out).drive_manifest().notices if "no masks" in one]
    assert [message in one for one in notices if message] == [True] * (message is not None)
    assert len(notices) == (message is not None)


def test_second_run_reads_cache_and_writes_same_detections(tmp_path: Path) -> None:
    log, cache = _folder(tmp_path), str(tmp_path / "cache.sqlite")
    reported = []
    for name in ("a", "b"):
        args = ["-o", str(tmp_path / name), "--detectors", BRIGHT, "--cache", cache, "--json"]
        reported.append(json.loads(output_of("detect", log, *args)))

    assert reported[0]["ran"] == {BRIGHT: 5}
    assert reported[1]["ran"] == {BRIGHT: 0}
    assert reported[1]["from_cache"] == {BRIGHT: 5}
    first, second = (open_run(tmp_path / name) for name in ("a", "b"))
    assert first.table("detections").equals(second.table("detections"))


def test_change_of_picture_size_is_handled_and_reported(tmp_path: Path) -> None:
    log = _folder(tmp_path)
    wide = np.zeros((96, 128), np.uint8)
    wide[50:60, 10:20] = 255
    cv2.imwrite(str(log / "frame_4.png"), wide)
    out = tmp_path / "run"

    assert run(["detect", str(log), "-o", str(out), "--detectors", BRIGHT, "--no-cache", "-q"]) == 0

    found = open_run(out).table("detections")
    assert found["picture_width_px"].to_pylist() == [64, 64, 64, 64, 128]
    (notice,) = [one for one in open_run(out).drive_manifest().notices if "sizes" in one]
    assert "pictures of several sizes: 4 of 64 x 48 px from" in notice
    assert "1 of 128 x 96 px from" in notice


OTHER_SIZES = {
    "center_px = [640.0, 24.0]": "center_px = (640, 24): outside the images of 64 x 48 pixels",
    "center_px = [44.0, 24.0]": "center_px = (44, 24): far from the middle of the images",
    "focal_px = 600.0": "focal_px = 600: images of 64 x 48 pixels would show 6 deg",
    "focal_px = 60.0\ncenter_px = [32.0, 24.0]\nsize_px = [80, 60]": "camera.size_px = [80, 60]: "
    "the images are 64 x 48 pixels; if they are scaled, state focal_px = 48, "
    "center_px = [25.6, 19.2], size_px = [64, 48]",
    "focal_px = 60.0\nsize_px = [64, 64]": "[64, 64]: the images are 64 x 48 pixels; state",
}


@pytest.mark.parametrize("camera", OTHER_SIZES)
def test_intrinsics_for_another_image_size_are_refused(tmp_path: Path, camera: str) -> None:
    log, vehicle, out = _folder(tmp_path), tmp_path / "vehicle.toml", tmp_path / "run"
    vehicle.write_text(f"version = 1\n[camera]\n{camera}\n")

    for command in ("detect", "replay"):
        argv = [command, str(log), "--vehicle", str(vehicle), "-o", str(out), "--no-cache"]
        assert OTHER_SIZES[camera] in refusal(2, *argv, "--detectors", BRIGHT)
        assert not out.exists()


def test_later_picture_not_matching_intrinsics_is_dropped(tmp_path: Path) -> None:
    log, vehicle, out = _folder(tmp_path), tmp_path / "vehicle.toml", tmp_path / "run"
    cv2.imwrite(str(log / "frame_4.png"), np.zeros((96, 128), np.uint8))
    vehicle.write_text("version = 1\n[camera]\nfocal_px = 60.0\n")
    command = ["detect", str(log), "--vehicle", str(vehicle), "-o", str(out), "--no-cache", "-q"]

    assert run([*command, "--detectors", BRIGHT]) == 3

    account = open_run(out).drive_manifest().account.reading[0].topics["cam"]
    assert (account.used, account.dropped) == (4, {OTHER_SIZE: 1})


def test_detector_in_a_file_of_this_folder_is_found_or_the_way_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = _folder(tmp_path)
    (tmp_path / "my_lamps.py").write_text("from support.detecting import build as bright\n")
    args = [str(log), "-o", str(tmp_path / "run"), "--detectors", "my_lamps:bright", "--no-cache"]
    monkeypatch.chdir(tmp_path)

    told = refusal(2, "detect", *args)

    assert "my_lamps.py is in this folder, which is not searched: set PYTHONPATH=." in told
    monkeypatch.syspath_prepend(tmp_path)
    assert run(["detect", *args, "-q"]) == 0


@pytest.mark.parametrize(
    ("detector", "message"),
    [
        ("nonsense", "detector 'nonsense': no such name"),
        ("no.such.module:make", "detector no.such.module:make: No module named"),
        ("support.detecting:nothing", "has no attribute 'nothing'"),
        ("support.detecting:too_few", "returned 0 results for"),
        (f"{BRIGHT},{BRIGHT}", "one is named twice"),
        ("", "none named; expected some of"),
    ],
)
def test_invalid_detector_is_reported_in_one_line(
    tmp_path: Path, detector: str, message: str
) -> None:
    log = _folder(tmp_path)
    args = ["-o", str(tmp_path / "run"), "--detectors", detector, "--no-cache"]

    assert message in refusal(2, "detect", log, *args)


@pytest.mark.parametrize("name", sorted(ROAD_CARDS))
def test_real_segmentation_network_finds_road_ahead_but_not_in_sky(
    name: str, tmp_path: Path
) -> None:
    folder, package, text = ROAD_CARDS[name]
    pytest.importorskip(package, reason=f"{package} is an optional back end")
    picture = shared("sequences", "us_signalized_intersection_dashcam", "frame_5050.jpg")
    card = tmp_path / "road.toml"
    card.write_text("version = 1\n" + text.replace("FOLDER", str(shared("weights", folder))))
    vehicle = tmp_path / "v.toml"
    vehicle.write_text(
        "version = 1\n[regions]\nstraight = [[0.5, 0.7], [0.65, 0.7], [0.75, 0.85], [0.5, 0.85]]\n"
        "left = [[0.0, 0.0], [0.3, 0.0], [0.3, 0.3], [0.0, 0.3]]\n"
    )
    log = picture_log(tmp_path / "us", [picture])
    args = ["--detectors", str(card), "--vehicle", str(vehicle), "--no-cache", "-q"]

    assert run(["replay", str(log), "-o", str(tmp_path / "run"), *args]) == 0

    fractions = open_run(tmp_path / "run").table("road").to_pylist()[0]
    assert fractions["fraction_straight"] > 0.8
    assert fractions["fraction_left"] < 0.02
    cues = {
        row["cue"]: row["count"] for row in open_run(tmp_path / "run").table("cues").to_pylist()
    }
    assert cues["road_straight"] == 1
    assert cues["road_left"] == 0


@pytest.mark.slow
def test_networks_trained_on_simulation_warn_on_other_logs(tmp_path: Path) -> None:
    log, vehicle = _folder(tmp_path), tmp_path / "car.toml"
    arguments = ["detect", str(log), "--detectors", "road", "--no-cache", "-q"]
    vehicle.write_text(f'version = 1\nname = "{SIMULATED_CAR}"\n')

    # The file next to the log decides, because a vehicle file can be copied or omitted.
    assert run([*arguments, "-o", str(tmp_path / "real"), "--vehicle", str(vehicle)]) == 0
    (tmp_path / SIMULATED).write_text("{}")
    assert run([*arguments, "-o", str(tmp_path / "simulated")]) == 0

    real, simulated = (open_run(tmp_path / name).drive_manifest() for name in ("real", "simulated"))
    (notice,) = real.notices
    assert notice.startswith("warning: road: the embedded network knows simulated scenes only")
    assert simulated.notices == ()
    assert [one.logs[0].is_simulated for one in (real, simulated)] == [False, True]


# Tables of the run that a cue reaches.
CUED = ("cues", "range", "belief", "ranged_objects")


class Second(GreyNumber):
    """Finds the same signs a second time under another name, with a lower score, and two more."""

    # Another than that of the first, for the cache.
    identity = "second"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Detect."""
        return [self._twice(found) for found in super().__call__(frames)]

    def _twice(self, found: Found) -> Found:
        assert isinstance(found, Detections)
        n = len(found)
        more = np.array([[20.0, 60.0, 80.0, 80.0], [2.0, 2.0, 6.0, 12.0]])
        return Detections(
            found.t_ns,
            found.size_px,
            np.concatenate([found.boxes_px, more]),
            np.concatenate([np.full(n, 0.6), [0.7, 0.4]]),
            (*(["octagon"] * n), "car", "lamp"),
            (b"",) * (n + 2),
        )


class Road:
    """Finds road in the lower half of every picture."""

    labels: tuple[str, ...] = ()
    view = View(is_grey=True)
    identity = "the lower half"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Detect."""
        mask = rle.encode_mask(np.ones((8, 32), np.bool_), (0, 8), (32, 16))
        return [RoadMask(one.t_ns, one.size_px, mask, (32, 16)) for one in frames]


NAMES = ",".join(f"{__name__}:{name}" for name in ("GreyNumber", "Second", "Road"))
PICTURE = '[regions]\nkind = "picture"\n'
CHANGES = {
    "threshold of a cue": "[cues]\nstop_sign_score = 0.3\n",
    "kind of car cues": '[cars]\nkind = "pairs"\nscore = 0.1\n',
    "fraction of road": f"[cues]\nroad_fraction = 0.6\n{PICTURE}",
    "regions": f"{PICTURE}left = [[0.0, 0.1], [0.3, 0.1], [0.3, 0.6], [0.0, 0.6]]\n",
    "own cue": '[cues.own.lamps]\nlabels = ["lamp"]\nscore = 0.3\n',
    # Both detectors then find the same signs, of which one counts.
    "labels of a cue": '[cues.own.signs]\nlabels = ["stop sign", "octagon"]\nscore = 0.3\n',
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with wheel speeds and pictures."""
    return write_drive(tmp_path_factory.mktemp("drive"), Clock(), seconds=6)


def _command(verb: str, log: Path, out: Path, vehicle: Path) -> None:
    options = ["--vehicle", str(vehicle), "--detectors", NAMES]
    cache = str(log.parent / "cache.sqlite")
    assert run([verb, str(log), "-o", str(out), *options, "--cache", cache, "-q"]) == 0


def test_detect_stores_detections_and_no_cues(drive: Path, tmp_path: Path) -> None:
    _command("detect", drive, tmp_path / "run", drive.with_name("car.toml"))

    tables = {file.stem for file in (tmp_path / "run").glob("*.parquet")}
    assert tables == {"frames", "detections", "road", "skipped", "visual_odometry"}
    manifest = json.loads((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["counts"].keys() == {"frames", "objects"}


def test_rule_of_a_cue_is_called_once_for_a_frame(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    count = labelled.count

    def counted(*given: object) -> object:
        calls.append(given[2].name)  # type: ignore[attr-defined]
        return count(*given)  # type: ignore[arg-type]

    monkeypatch.setattr(labelled, "count", counted)
    rule_of.cache_clear()
    _command("replay", drive, tmp_path / "run", drive.with_name("car.toml"))
    rule_of.cache_clear()

    frames = open_run(tmp_path / "run").table("frames").num_rows
    assert calls.count("stop_sign") == frames == 60


@pytest.mark.parametrize("change", CHANGES)
def test_changed_cue_needs_no_picture_and_equals_a_new_replay(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    plain = drive.with_name("car.toml").read_text()
    shutil.copy(drive.with_name("simulated_car.dbc"), tmp_path)
    (tmp_path / "old.toml").write_text(plain)
    (tmp_path / "new.toml").write_text(f"{plain}\n{CHANGES[change]}")
    _command("replay", drive, tmp_path / "again", tmp_path / "old.toml")
    _command("replay", drive, tmp_path / "whole", tmp_path / "new.toml")
    before = {name: open_run(tmp_path / "again").table(name) for name in CUED}

    def fail(*_: object, **__: object) -> None:
        raise AssertionError("a picture was opened")

    monkeypatch.setattr("crosscue.detectors.runner.decode", fail)
    monkeypatch.setattr("crosscue.detectors.images.decode", fail)
    monkeypatch.setattr(GreyNumber, "__call__", fail)
    vehicle = ["--vehicle", str(tmp_path / "new.toml")]
    assert run(["estimate", str(tmp_path / "again"), *vehicle, "-q"]) == 0

    again, whole = (open_run(tmp_path / name) for name in ("again", "whole"))
    for name in CUED:
        assert again.table(name).equals(whole.table(name)), name
    assert any(not again.table(name).equals(before[name]) for name in CUED)
    manifests = [one.drive_manifest() for one in (again, whole)]
    assert sorted(manifests[0].notices) == sorted(manifests[1].notices)


def test_frames_are_read_with_the_labels_of_the_present_vehicle_file(
    drive: Path, tmp_path: Path
) -> None:
    """Once a cue counts both, an octagon is the sign that the other detector found."""
    plain = drive.with_name("car.toml").read_text()
    shutil.copy(drive.with_name("simulated_car.dbc"), tmp_path)
    (tmp_path / "new.toml").write_text(f"{plain}\n{CHANGES['labels of a cue']}")
    _command("detect", drive, tmp_path / "run", drive.with_name("car.toml"))
    stored = open_run(tmp_path / "run")
    detected = stored.drive_manifest().detected
    assert detected is not None

    def octagons(vehicle: Vehicle) -> int:
        frames = stored_frames(stored, detected, vehicle)
        return sum(one.labels.count("octagon") for frame in frames for one in frame.objects)

    assert octagons(detected.settings) > 20
    assert octagons(load(tmp_path / "new.toml")) == 0
