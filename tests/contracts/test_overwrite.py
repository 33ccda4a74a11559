"""A result that is continued or replaced: of the same inputs, and nobody else's files."""

import argparse
import hashlib
import json
import shlex
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Final

import pytest

from crosscue.datasets.scenes.drive import MADE_OF
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli
from crosscue.eval.runs.folder import MANIFEST, RunFolder, own_files
from crosscue.eval.runs.owned import files_in
from crosscue.replay.errors import OutputError
from crosscue.replay.files.made_of import made_of
from crosscue.replay.files.tree_text import strict_json
from support.coco import stop_signs
from support.commands import output_of
from support.empty_inputs import empty_inputs
from support.failures import table_of_failures
from support.pictures import picture, picture_folder
from support.refusals import refusal
from support.scenes import shorten
from support.trees import contents, tree

REPLAY: Final = "replay {log} -o {out} --vehicle {car} --no-cache"
DETECT: Final = "detect {log} -o {out} --vehicle {car} --detectors grey --no-cache --draw 3"
SIMULATE: Final = "simulate A --width 320 --fps 10 -o {out}"
# Commands that replace a folder, with arguments.
WRITING: Final[dict[str, str]] = {
    "replay": REPLAY,
    "detect": DETECT,
    "decode": "decode {log} -o {out} --vehicle {car}",
    "merge": "merge {run} -o {out}",
    "export": "export {failures} -o {out}",
    "browse": "browse {failures} -o {out}",
}
# Other commands whose help names a folder, and what they do.
BY_NAME: Final = {
    "truth": "writes a truth file of a given name",
    "model": "writes a model card of a given name",
    "simulate": "replaces the drives of the same settings, file by file",
    "fetch": "keeps what is there; a folder with anything else is refused",
    "demo": "writes a drive and a run, each as simulate and replay do",
    "study": "keeps finished parts, and replaces its pages file by file",
}


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A log, its vehicle file, its run, and failures of that run."""
    folder = tmp_path_factory.mktemp("inputs")
    found = empty_inputs(folder)
    table = folder / "failures.parquet"
    times = RunFolder(found["run"]).table("frames")["t_ns"].to_pylist()
    table_of_failures(found["run"], table, *times[:2])
    return {**found, "failures": table}


def _run(line: str, names: dict[str, Path], out: Path, *more: str) -> int:
    return cli.run([*shlex.split(line.format(**names, out=out)), *more])


def _content(folder: Path) -> dict[str, str]:
    """Return the hash of every file below a folder; of a link, its target."""
    return {
        name: str(path.readlink())
        if (path := folder / name).is_symlink()
        else hashlib.sha256(path.read_bytes()).hexdigest()
        for name in files_in(folder)
    }


def _writes_folder(parser: argparse.ArgumentParser) -> bool:
    options = {option: one for one in parser._actions for option in one.option_strings}
    output = options.get("--output") or options.get("-o")
    is_folder = output is not None and "folder" in str(output.help)
    return "--overwrite" in options and is_folder


def test_every_command_that_replaces_folder_has_case() -> None:
    writing = {name for name in cli.COMMANDS if _writes_folder(cli.parser_of(name)[1])}

    assert writing - WRITING.keys() == {n for n in writing if n.split()[0] in BY_NAME}
    assert writing >= WRITING.keys()


FOREIGN: Final[dict[str, dict[str, str]]] = {
    "photographs and labels": {"pictures/photo": "a photo", "labels.json": "{}"},
    "a training set": {"annotations.json": "{}", "train.parquet": "PAR1"},
    "a package": {"package.json": "{}"},
    "a thesis": {"thesis.tex": "years of work"},
    "a folder called score": {"score/thesis.tex": "years of work"},
    "a manifest of something else": {"manifest.json": '{"name": "app"}', "a.json": "1"},
    "an input of something else": {"input.json": '{"format_version": 6}', "pose.parquet": "1"},
}


@pytest.mark.parametrize("command", WRITING)
@pytest.mark.parametrize("case", FOREIGN)
def test_folder_of_user_is_refused_with_list_of_its_files(
    case: str, command: str, names: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    for name, text in FOREIGN[case].items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text(text)
    before = _content(out)

    error = refusal(2, *shlex.split(WRITING[command].format(**names, out=out)), "--overwrite")

    assert _content(out) == before
    assert all(name in error for name in before)


HAND_MADE: Final[dict[str, Callable[[Path], object]]] = {
    "truth.json": lambda path: path.write_text("{}"),
    "notes.parquet": lambda path: path.write_text("PAR1"),
    "drive2.rrd": lambda path: path.write_text("RRF2"),
    "score/notes.txt": lambda path: path.write_text("good"),
    "pictures/photo.jpg": lambda path: path.write_text("a photo"),
    "pictures/20240101.jpg": lambda path: path.write_text("a photo"),
    "link": lambda path: path.symlink_to("/etc/hostname"),
    "folder": lambda path: path.symlink_to("/etc"),
}


@pytest.fixture(scope="module")
def made(names: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Results of each command."""
    folder = tmp_path_factory.mktemp("made")
    for command, line in WRITING.items():
        assert _run(line, names, folder / command) in (0, 3)
    return {command: folder / command for command in WRITING}


@pytest.mark.parametrize("command", WRITING)
@pytest.mark.parametrize("foreign", HAND_MADE)
def test_result_with_one_file_of_user_keeps_everything(
    foreign: str, command: str, names: dict[str, Path], made: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(made[command], out)
    (out / foreign).parent.mkdir(exist_ok=True)
    HAND_MADE[foreign](out / foreign)
    before = _content(out)

    error = refusal(2, *shlex.split(WRITING[command].format(**names, out=out)), "--overwrite")

    assert _content(out) == before
    assert foreign in error


@pytest.mark.parametrize("command", WRITING)
def test_result_alone_is_replaced(
    command: str, names: dict[str, Path], made: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(made[command], out)

    assert _run(WRITING[command], names, out, "--overwrite") in (0, 3)

    assert _content(out).keys() == _content(made[command]).keys()


def test_scored_tagged_and_viewed_run_has_no_file_of_another(
    names: dict[str, Path], made: dict[str, Path], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(names["run"].parent, tmp_path / "all")
    run = tmp_path / "all" / "run"
    truth = names["car"].parent / "truth.json"
    for line in (
        f"score {run} --truth {truth} --any-log",
        f"tag {run} a=b",
        f"view {run} -o {run}/drive.rrd",
    ):
        assert cli.run(shlex.split(line)) in (0, 3)
    assert (run / "score" / "report.html").exists()

    is_ours = own_files(RunFolder(run))
    assert [name for name in files_in(run) if not is_ours(name)] == []
    assert _run(REPLAY, names, run, "--overwrite") in (0, 3)
    assert not (run / "score").exists()
    assert json.loads((run / "tags.json").read_text())["tags"] == {"a": "b"}


def test_interrupted_run_is_overwritten_but_not_with_file_of_user(
    names: dict[str, Path], made: dict[str, Path], tmp_path: Path
) -> None:
    run = tmp_path / "out"
    shutil.copytree(made["detect"], run)
    (run / "manifest.json").unlink()
    (run / "truth.json").write_text("{}")
    before = _content(run)

    assert _run(DETECT, names, run, "--overwrite") == 2
    assert _content(run) == before

    (run / "truth.json").unlink()
    assert _run(DETECT, names, run, "--overwrite") in (0, 3)


def test_batch_leaves_folders_of_user_alone(
    names: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drives, out = tmp_path / "drives", tmp_path / "runs"
    for name in ("a", "b"):
        shutil.copytree(names["log"].parent, drives / name)
    line = f"replay {drives} -o {out} --vehicle {names['car']} --no-cache --overwrite"
    cli.run(shlex.split(line))
    first, second = sorted(path for path in out.iterdir() if path.name[0] in "ab")
    (first / "labels.json").write_text("{}")
    elsewhere = tmp_path / "elsewhere"
    second.rename(elsewhere)
    second.symlink_to(elsewhere)
    for run in (first, elsewhere):
        (run / "manifest.json").unlink()
    before = _content(first), _content(elsewhere)
    capsys.readouterr()

    assert cli.run(shlex.split(line)) != 0

    assert (_content(first), _content(elsewhere)) == before
    printed = "".join(capsys.readouterr())
    assert "labels.json" in printed
    assert "a link" in printed


@pytest.mark.parametrize("name", ["truth.json", "vehicle.toml"])
@pytest.mark.parametrize("overwrite", [[], ["--overwrite"]])
def test_drive_is_not_written_over_user_files(
    overwrite: list[str], name: str, names: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    place = out / "A-01"
    place.mkdir(parents=True)
    (place / name).write_text("by hand")

    assert _run(SIMULATE, names, out, *overwrite) != 0

    assert _content(place).keys() == {name}
    assert (place / name).read_text() == "by hand"


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


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    folder = tmp_path_factory.mktemp("drive")
    return write_drive(folder, DriveSettings(seed=3, blocks=1, block_m=60.0))


@pytest.mark.parametrize("command", ["replay", "estimate", "decode", "detect"])
def test_finished_run_is_unchanged_if_next_result_is_empty(
    drive: DriveFiles, tmp_path: Path, command: str
) -> None:
    out, car = tmp_path / "out", tmp_path / "car.toml"
    first = "replay" if command == "estimate" else command
    log, flags = str(drive.log), ["--vehicle", str(drive.vehicle), "-o", str(out)]
    if command == "detect":
        log = str(picture_folder(tmp_path / "front", 3, "rate_hz: 10\n"))
        flags = ["--detectors", "signs", "--no-cache", "-o", str(out)]
    assert cli.run([first, log, *flags]) == 0
    before = contents(out)
    car.write_text("version = 1\n")
    argv = ["--overwrite", "--from", "100000", *flags]

    if command == "estimate":
        refusal(1, "estimate", out, "--vehicle", car)
    else:
        refusal(1, command, log, *argv)

    assert contents(out) == before


def test_overwritten_run_contains_only_new_files(drive: DriveFiles, tmp_path: Path) -> None:
    out, fresh = tmp_path / "out", tmp_path / "fresh"
    argv = ["replay", str(drive.log), "--vehicle", str(drive.vehicle)]
    assert cli.run([*argv, "-o", str(out)]) == 0
    (out / "score").mkdir()
    (out / "cues.parquet").write_bytes(b"")
    message = output_of(*argv, "-o", out, "--overwrite", "--to", "5", "--json")
    assert cli.run([*argv, "-o", str(fresh), "--to", "5"]) == 0

    assert json.loads(message)["run"] == str(out)
    timed = {MANIFEST, "timings.json"}
    kept = {name: data for name, data in contents(out).items() if name not in timed}
    assert kept == {name: data for name, data in contents(fresh).items() if name not in timed}
