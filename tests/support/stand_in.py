"""A simulated recording and a small network on a local server, in place of the real ones."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import pytest

from crosscue.datasets.adapters.pandaset import read_pandaset_poses
from crosscue.datasets.real import recordings
from crosscue.datasets.truth.truth import Approach, CueTruth, Features, Truth, save
from crosscue.detectors.catalog import entries, places
from crosscue.detectors.catalog import fetch as weights
from crosscue.detectors.catalog.card import ModelCard, WeightFile
from support.onnx_models import bright_box_model
from support.pandaset_drive import pandaset_drive
from support.range_server import Served

COUNT = 6
CARD = """\
version = 1
weights = "net.onnx"
sha256 = "{sha256}"
[input]
width_px = 160
height_px = 90
[output]
kind = "end-to-end"
classes = ["stop sign"]
"""


@dataclass(frozen=True, slots=True)
class StandIn:
    """Served content and its source.

    Attributes:
        known: Entry of the recording, with the name ``pandaset_002``.
        folder: Contains the recording in ``sequences/pandaset_002`` and the network in ``weights``.
        server: Server of all files.
    """

    known: recordings.Recording
    folder: Path
    server: Served


def stand_in(place: Path, server: Served, monkeypatch: pytest.MonkeyPatch) -> StandIn:
    """Write and serve a drive and a network, and replace the product's entries by them."""
    data = place / "published"
    drive = pandaset_drive(data / "sequences" / "pandaset_002", COUNT)
    network = data / "weights" / "net" / "net.onnx"
    network.parent.mkdir(parents=True)
    network.write_bytes(bright_box_model())
    kept = place / "own" / "pandaset_002"
    kept.mkdir(parents=True)
    _write_bundled(kept, drive, network)
    files = sorted(path for path in drive.rglob("*") if path.is_file())
    lines = [_line(path, drive) for path in files]
    for path in files:
        server.files[f"drive/{path.relative_to(drive).as_posix()}"] = path.read_bytes()
    server.files["net.onnx"] = network.read_bytes()
    (kept / "recording.toml").write_text(
        'version = 1\nname = "pandaset_002"\nabout = "made up"\nlicence = "CC BY 4.0"\n'
        f'attribution = "nobody"\nurl = "{server.base}/drive"\n'
        f'folders = ["sequences/pandaset_002"]\nfiles = [{", ".join(lines)}]\n'
    )
    monkeypatch.setattr(recordings, "FOLDER", place / "own")
    monkeypatch.setenv(recordings.VARIABLE, str(place / "drives"))
    monkeypatch.setenv(places.VARIABLE, str(place / "models"))
    for name in (recordings.MIRROR, weights.DATA, weights.MIRROR):
        monkeypatch.delenv(name, raising=False)
    card = _card(network, server)
    monkeypatch.setattr(entries, "entry", lambda name: card)
    monkeypatch.setattr(weights, "entry", lambda name: card)
    return StandIn(recordings.recording("pandaset_002"), data, server)


def _line(path: Path, drive: Path) -> str:
    content = path.read_bytes()
    return (
        f'{{name = "{path.relative_to(drive).as_posix()}", size_bytes = {len(content)}, '
        f'sha256 = "{hashlib.sha256(content).hexdigest()}"}}'
    )


def _card(network: Path, server: Served) -> ModelCard:
    content = network.read_bytes()
    sha256 = hashlib.sha256(content).hexdigest()
    file = WeightFile(
        name=network.name,
        url=f"{server.base}/{network.name}",
        size_bytes=len(content),
        sha256=sha256,
    )
    original = entries.entry("yolox-nano")
    return original.model_copy(update={"weights": network.name, "sha256": sha256, "files": (file,)})


def _write_bundled(kept: Path, drive: Path, network: Path) -> None:
    """Write vehicle file, card and truth, which the product bundles."""
    sha256 = hashlib.sha256(network.read_bytes()).hexdigest()
    (kept / network.name).write_bytes(network.read_bytes())
    (kept / "card.toml").write_text(CARD.format(sha256=sha256))
    (kept / "vehicle.toml").write_text(
        'version = 1\n[detectors.bright]\nkind = "model"\ncard = "card.toml"\n'
    )
    times = read_pandaset_poses(drive).t_ns.tolist()
    approach = Approach(
        id=1,
        intersection="made up",
        start_ns=times[0],
        enter_ns=times[-1],
        control="stop_sign",
        features=Features(left=True, right=True, straight=True),
    )
    cue = CueTruth(cue="stop_sign", present=True, start_ns=times[0], end_ns=times[-1] + 1)
    truth = Truth(
        version=1, start_ns=times[0], end_ns=times[-1] + 1, approaches=(approach,), cues=(cue,)
    )
    save(truth, kept)
