"""A run folder is complete or marked as incomplete after a kill or fault at any time."""

import errno
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.eval import cli
from crosscue.eval.runs.folder import create, locked, open_run
from crosscue.replay.errors import RunError
from support import faults, scenes
from support.trees import tree

pytestmark = pytest.mark.slow

DETECTORS = """
[detectors.oracle]
kind = "support.oracle:build"
[detectors.oracle.settings]
objects = "{}"
"""


class Drive:
    """A small simulated drive and its run."""

    def __init__(self, folder: Path) -> None:
        camera = SceneCamera(width_px=192, height_px=108)
        with pytest.MonkeyPatch.context() as patch:
            scenes.shorten(patch, pictures=75)
            write_scene(folder, SceneSettings("C", camera=camera))
        self.folder = folder
        self.vehicle = folder / "vehicle.toml"
        self.vehicle.write_text(
            self.vehicle.read_text() + DETECTORS.format(folder / "objects.json")
        )
        assert cli.run(self.replay(folder / "complete", "-q")) == 0
        self.complete = tree(folder / "complete")
        assert {"manifest.json", "pose.parquet", "belief.parquet"} <= set(self.complete)

    def replay(self, run: Path, *more: str) -> list[str]:
        """Return the command line that replays two seconds of the drive."""
        line = f"replay {self.folder}/drive.mcap --vehicle {self.vehicle} -o {run}"
        part = f"--cache {self.folder}/cache.sqlite --from 4 --to 6"
        return [*line.split(), *part.split(), *more]


@pytest.fixture(scope="module")
def drive() -> Iterator[Drive]:
    # Not below pytest's folder, which only its owner can read.
    folder = Path(tempfile.mkdtemp(prefix="crosscue-kill-"))
    folder.chmod(0o755)
    try:
        yield Drive(folder)
    finally:
        shutil.rmtree(folder)


def _sampled_points(count: int, of: int, seed: int) -> list[int]:
    """Return the first, the last, and some random points."""
    between = random.Random(seed).sample(range(1, of - 1), min(count, of - 2))
    return [0, *sorted(between), of - 1]


def _check_message(ended: faults.Ended) -> None:
    assert ended.status == 1, ended
    assert ended.said.startswith("crosscue: ")
    assert ended.said.count("\n") == 1, ended.said
    assert "bug" not in ended.said


def _check_complete_or_marked(run: Path, *expected: dict[str, str]) -> None:
    """Check that a run has no valid manifest, or that all of its bytes are expected."""
    try:
        manifest = open_run(run).manifest()
    except RunError:
        return
    if manifest.stage == "estimate":
        present = {name: of for name, of in tree(run).items() if not name.startswith(".")}
        assert present in expected


def test_run_killed_anywhere_restarts_to_equal_bytes(drive: Drive, tmp_path: Path) -> None:
    run = drive.folder / tmp_path.name
    argv = drive.replay(run)
    count = len(faults.operations(run, faults.CHANGES, argv))
    assert count > 30

    for operation in _sampled_points(5, count, seed=1):
        shutil.rmtree(run)
        ended = faults.killed_before(run, operation, argv)
        assert ended.status == -signal.SIGKILL
        if run.exists():
            _check_complete_or_marked(run, drive.complete)
        again = "--resume" if operation % 2 else "--overwrite"
        assert cli.run(drive.replay(run, again, "-q")) == 0
        assert tree(run) == drive.complete


def test_killed_estimate_is_complete_or_marked(drive: Drive, tmp_path: Path) -> None:
    run, other = tmp_path / "run", tmp_path / "other.toml"
    shutil.copytree(drive.folder / "complete", run)
    text = drive.vehicle.read_text().replace("x_m = 1.7", "x_m = 1.2")
    other.write_text(text.replace('"simulated_car.dbc"', f'"{drive.folder}/simulated_car.dbc"'))
    argv = ["estimate", str(run), "--vehicle", str(other), "--logs", str(drive.folder)]
    count = len(faults.operations(run, faults.CHANGES, argv))
    replaced = tree(run)
    assert replaced != drive.complete

    for operation in _sampled_points(3, count, seed=3):
        shutil.rmtree(run)
        shutil.copytree(drive.folder / "complete", run)
        assert faults.killed_before(run, operation, argv).status == -signal.SIGKILL
        _check_complete_or_marked(run, drive.complete, replaced)
        assert cli.run([*argv, "-q"]) == 0
        assert tree(run) == replaced


@pytest.mark.parametrize("once", [True, False])
def test_failed_write_anywhere_leaves_no_partial_files(
    drive: Drive, tmp_path: Path, once: bool
) -> None:
    run = drive.folder / tmp_path.name
    argv = drive.replay(run)
    count = len(faults.operations(run, faults.WRITES, argv))

    for operation in _sampled_points(4, count, seed=4):
        shutil.rmtree(run, ignore_errors=True)
        ended = faults.failing_from(run, operation, argv, once=once)
        _check_message(ended)
        assert "the disk is full" in ended.said
        if run.exists():
            names = {path.name for path in run.iterdir()}
            assert not {one for one in names if one.endswith(".partial") or one == ".lock"}
            _check_complete_or_marked(run, drive.complete)


def test_locked_run_is_refused_and_names_the_process(drive: Drive, tmp_path: Path) -> None:
    run = drive.folder / tmp_path.name
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        with locked(create(run, overwrite=False)):
            os.write(write, b"!")
            time.sleep(60)
    os.read(read, 1)

    ended = faults.forked(lambda: None, drive.replay(run, "--overwrite"))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)

    assert ended.status == 1
    assert f"process {child} on " in ended.said
    assert cli.run(drive.replay(run, "--overwrite", "-q")) == 0


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become nobody")
def test_missing_permissions_are_reported(drive: Drive, tmp_path: Path) -> None:
    def as_nobody() -> None:
        os.setgid(65534)
        os.setuid(65534)

    secret = drive.folder / "secret.mcap"
    shutil.copy(drive.folder / "drive.mcap", secret)
    secret.chmod(0o600)

    output = faults.forked(as_nobody, drive.replay(drive.folder / "theirs"))
    present = faults.forked(as_nobody, drive.replay(drive.folder / "complete", "--overwrite"))
    estimate = faults.forked(as_nobody, ["estimate", str(drive.folder / "complete")])
    log = faults.forked(as_nobody, ["replay", str(secret), "-o", str(drive.folder / "theirs")])

    for ended in (output, present, estimate):
        _check_message(ended)
        assert "Permission denied" in ended.said
    assert log.status == 4
    assert "no permission to read it" in log.said
    assert tree(drive.folder / "complete") == drive.complete


def test_replay_opens_no_socket(drive: Drive, tmp_path: Path) -> None:
    def prepare() -> None:
        def hook(event: str, args: tuple[object, ...]) -> None:
            if event.startswith("socket.") and event != "socket.gethostname":
                raise OSError(errno.EACCES, f"{event} {args}")

        sys.addaudithook(hook)

    ended = faults.forked(prepare, drive.replay(tmp_path / "run"))

    assert ended.status == 0, ended.said
