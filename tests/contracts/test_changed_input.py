"""Commands that continue or replace a result refuse one that was made from other inputs."""

from dataclasses import asdict
from pathlib import Path

import pytest

from crosscue.datasets.scenes.drive import MADE_OF
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.eval import cli
from crosscue.replay.errors import OutputError
from crosscue.replay.files.made_of import made_of
from crosscue.replay.files.tree_text import strict_json
from support.coco import stop_signs
from support.pictures import picture
from support.refusals import refusal
from support.scenes import shorten
from support.trees import tree

# Arguments, the flag that resumes or overwrites, and an option that changes the input.
COMMANDS: dict[str, tuple[str, str, str]] = {
    "train road": (
        "--data {folder} -o {out}/net.safetensors --steps 1 --batch 1 --width 128 --device cpu",
        "--resume",
        "--seed 3",
    ),
    "train mask-rcnn": (
        "--data {folder}/coco.json --images {folder}/images -o {out}/net.safetensors --steps 1 "
        "--batch 1 --check-every 1 --window 64 64 --width 128 --device cpu",
        "--resume",
        "--seed 3",
    ),
    "simulate": ("A -o {out} --width 64", "--overwrite", "--seed 3"),
}
WRITERS = (
    "crosscue.detectors.networks.road.checkpoint.save_road",
    "crosscue.detectors.training.job.save_checkpoint",
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Pictures of a road with a stop sign, annotated."""
    folder = tmp_path / "data"
    for place in ("images", "masks"):
        (folder / place).mkdir(parents=True)
        for number in range(2):
            (folder / place / f"{number}.png").write_bytes(picture(number, width=128, height=80))
    labels = stop_signs([("0.png", 0), ("1.png", 1)], (128, 80))
    (folder / "coco.json").write_text(labels)
    return folder


def _prepare(name: str, folder: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Leave an interrupted training or a finished drive in ``out``, and return the command."""
    argv = [*name.split(), *COMMANDS[name][0].format(folder=folder, out=out).split()]
    if name == "simulate":
        drive = out / "A-01"
        drive.mkdir(parents=True)
        (drive / "drive.mcap").touch()
        settings = SceneSettings(camera=SceneCamera(width_px=64, height_px=36))
        (drive / MADE_OF).write_text(strict_json(made_of([], asdict(settings))))
        return argv
    out.mkdir()

    def full(*_: object) -> None:
        raise OutputError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr("crosscue.eval.training.road.SAVED_EVERY", 1)
        for writer in WRITERS:
            patched.setattr(writer, full)
        assert cli.run(argv) == 1
    return argv


@pytest.mark.parametrize("name", COMMANDS)
def test_changed_settings_are_refused_and_files_are_unchanged(
    name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    argv = _prepare(name, folder, tmp_path / "out", monkeypatch)
    _, flag, other = COMMANDS[name]
    before = tree(tmp_path)

    message = refusal(2, *argv, "-q", flag, *other.split())

    assert "seed: 0 there, 3 here" in message
    assert f"{flag} would destroy it" in message
    assert tree(tmp_path) == before


@pytest.mark.parametrize("name", ["train road", "train mask-rcnn"])
def test_changed_pictures_are_refused_with_both_identities(
    name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    argv = _prepare(name, folder, tmp_path / "out", monkeypatch)
    (folder / "images" / "1.png").write_bytes(picture(7, width=128, height=80))
    before = tree(tmp_path)

    assert refusal(2, *argv, "-q", "--resume").count(" bytes)") == 2
    assert tree(tmp_path) == before


@pytest.mark.parametrize("name", COMMANDS)
def test_unchanged_inputs_are_accepted(
    name: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten(monkeypatch, pictures=2)
    argv = _prepare(name, folder, tmp_path / "out", monkeypatch)

    assert cli.run([*argv, COMMANDS[name][1]]) == 0


def test_resume_refuses_finished_training(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "net.safetensors"
    out.write_bytes(b"weights")
    argv = ["train", "mask-rcnn", "--data", folder / "coco.json", "--images", folder / "images"]

    assert "--overwrite starts over" in refusal(1, *argv, "-o", out, "-q", "--resume")
    assert out.read_bytes() == b"weights"


def test_drive_without_recorded_inputs_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "A-01").mkdir()
    (tmp_path / "A-01" / "drive.mcap").write_bytes(b"recorded")

    argv = ["simulate", "A", "-o", tmp_path, "--width", "64", "--overwrite"]
    assert "its inputs are not recorded" in refusal(2, *argv)
    assert (tmp_path / "A-01" / "drive.mcap").read_bytes() == b"recorded"
