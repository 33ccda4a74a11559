"""Cues are computed once, by ``estimate``, from what ``detect`` has stored."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Found, Frame, RoadMask, View
from crosscue.detectors.cues import labelled
from crosscue.detectors.cues.rules import rule_of
from crosscue.eval.cli import run
from crosscue.eval.runs.folder import open_run
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.replay.vehicle.vehicle import Vehicle, load
from support.gap_drive import Clock, GreyNumber, write_drive

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
