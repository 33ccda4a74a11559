"""The commands of the how-to page lead from an exported network to a scored drive."""

import json
import re
from pathlib import Path

import pytest
import torch

from crosscue.datasets.truth.truth import CueTruth, Truth, save
from crosscue.detectors.catalog.card import read_card
from crosscue.eval import cli
from support.decoder_samples import CLASSES, SAMPLES, export
from support.pandaset_drive import START_S, pandaset_drive
from support.pictures import picture
from support.torchvision_files import network

PAGE = Path(__file__).parents[2] / "docs" / "howto" / "networks.md"
# Folder in which the page expects the vehicle file and the truth of its drive.
HOME = Path("datasets") / "real" / "pandaset_002"
FRAMES = 3


def commands() -> list[str]:
    """Return the commands of the page's first block; ``view`` writes a recording instead."""
    page = PAGE.read_text(encoding="utf-8")
    block = re.search(r"```bash\n(crosscue model init.*?)```", page, re.S)
    assert block is not None
    return block[1].replace("view run", "view run -o drive.rrd").splitlines()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all inputs of the page except the network; pictures have 24 x 16 pixels."""
    place = tmp_path_factory.mktemp("place")
    camera = pandaset_drive(place / "PANDASET", FRAMES) / "camera" / "front_camera"
    (camera / "intrinsics.json").write_text('{"fx": 20.0, "fy": 20.0, "cx": 12.0, "cy": 8.0}')
    (place / "street.jpg").write_bytes(picture(0, ".jpg"))
    (place / "names.txt").write_text("\n".join(CLASSES))
    (place / HOME).mkdir(parents=True)
    (place / HOME / "vehicle.toml").write_text('version = 1\n[cues]\nkind = "frames"\n')
    start_ns, end_ns = round(1e9 * (START_S - 1.0)), round(1e9 * (START_S + 1.0))
    cue = CueTruth(cue="stop_sign", present=True, start_ns=start_ns, end_ns=end_ns)
    save(Truth(version=1, start_ns=start_ns, end_ns=end_ns, cues=(cue,)), place / HOME)
    return place


def follow_page(
    place: Path,
    weights: str,
    kind: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> tuple[int, int, int]:
    """Run the page's commands; return right and all positives and frames of the stop sign cue.

    The recording of ``view`` does not depend on the network: it is written for one.
    """
    monkeypatch.chdir(place)
    lines = commands()
    assert len(lines) == 5
    for line in lines if kind == "torchvision" else lines[:-1]:
        words = line.replace("my.onnx", weights).removeprefix("crosscue ").split()
        more = {
            "model init": ["--overwrite"],
            "replay PANDASET": ["--overwrite", "--no-cache"],
            "view run": ["--overwrite"],
        }
        assert cli.run([*words, *more.get(" ".join(words[:2]), [])]) == 0, capsys.readouterr().err
    metrics = json.loads(Path("run", "score", "metrics.json").read_text())
    found = metrics["cues"]["stop_sign"]
    right = found["precision"]
    return int(right["right"]), int(right["of"]), int(found["scored"])


@pytest.mark.parametrize("kind", SAMPLES)
def test_exported_network_is_scored_with_commands_of_page(
    place: Path, kind: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (place / "my.onnx").write_bytes(export(SAMPLES[kind]()))

    scored = follow_page(place, "my.onnx", kind, capsys, monkeypatch)

    assert read_card(place / "my.toml").output.kind == kind
    assert scored == (FRAMES, FRAMES, FRAMES)


def test_torchvision_weights_are_scored_with_commands_of_page(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    state = network("ssdlite320_mobilenet_v3_large", classes=1 + len(CLASSES)).state_dict()
    torch.save(state, place / "my.pth")

    scored = follow_page(place, "my.pth", "torchvision", capsys, monkeypatch)

    assert scored[2] == FRAMES
    assert Path("drive.rrd").stat().st_size
