"""Kill replays at random times, and check that no partial run is ever taken for complete.

Run it as ``python benchmarks/kills.py [KILLS [SEED]]``. A replay of a small simulated drive, with
detectors, is killed (SIGKILL) after a random time. Then the same command with ``--resume`` runs to
its end, and every file of the run is compared with that of an undisturbed replay. The cache of
detection results is kept between kills in half of the rounds and deleted in the others, so that
kills also occur during detection.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.detectors.base import Detections, Found, Frame, View
from crosscue.eval import cli
from crosscue.eval.runs.folder import open_run
from crosscue.replay.errors import RunError

MIN_S = 0.001


class Bright:
    """Fast detector of one box around the brightest pixel, which differs in every frame."""

    view = View(min_width_px=64)
    identity = "bright 1"

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Found]:
        """Return one box for each frame."""
        return [self._of(frame) for frame in frames]

    def _of(self, frame: Frame) -> Found:
        grey = frame.pixels.sum(axis=2)
        y, x = np.unravel_index(int(grey.argmax()), grey.shape)
        box = np.array([[x, y, x + 2.0, y + 2.0]])
        return Detections(frame.t_ns, frame.size_px, box, np.array([0.99]), ("car",), (b"",))


def build() -> Bright:
    """Build the detector; the function that ``--detectors`` names."""
    return Bright()


def contents(run: Path) -> dict[str, str]:
    """Return the hash of each file by its name, except of its timings."""
    found = {}
    for path in sorted(run.rglob("*")):
        if path.is_file() and path.name != "timings.json" and not path.name.startswith("."):
            found[str(path.relative_to(run))] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def started(argv: list[str]) -> int:
    """Fork a process that runs a command line without output; return its id."""
    child = os.fork()
    if child:
        return child
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    os._exit(cli.run(argv))


def ended(child: int) -> int:
    """Return the exit status of a process; the negative signal number if it was killed."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def kill_and_resume(
    argv: list[str], run: Path, after_s: float, right: dict[str, str]
) -> tuple[list[str], float]:
    """Return the outcomes of a killed and resumed replay, and the seconds of the latter."""
    child = started(argv)
    time.sleep(after_s)
    os.kill(child, signal.SIGKILL)
    outcomes = ["finished first" if ended(child) == 0 else "killed", after_kill(run, right)]
    began = time.perf_counter()
    status = ended(started([*argv, "--resume"]))
    took_s = time.perf_counter() - began
    same = status == 0 and contents(run) == right
    return [*outcomes, "resumed to the same bytes" if same else "NOT THE SAME"], took_s


def main() -> None:
    """Kill, resume and compare replays, and print the counts."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    rng = random.Random(int(sys.argv[2]) if len(sys.argv) > 2 else 0)
    sys.modules["kills"] = sys.modules[__name__]
    outcomes: Counter[str] = Counter()
    resumed_s: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drive, run, cache = folder / "drive", folder / "run", folder / "cache.sqlite"
        write_scene(drive, SceneSettings("C", camera=SceneCamera(width_px=192, height_px=108)))
        argv = [
            "replay",
            str(drive / "drive.mcap"),
            "--vehicle",
            str(drive / "vehicle.toml"),
            "-q",
            "--detectors",
            "kills:build",
            "--cache",
            str(cache),
            "-o",
            str(run),
        ]
        whole = folder / "whole"
        for _ in range(2):
            assert cli.run([*argv, "-o", str(whole), "--overwrite"]) == 0
        right = contents(whole)
        began = time.perf_counter()
        assert ended(started([*argv, "-o", str(folder / "timed")])) == 0
        usual_s = time.perf_counter() - began
        for number in range(kills):
            if number % 2:
                for path in folder.glob("cache.sqlite*"):
                    path.unlink()
            after_s = rng.uniform(MIN_S, 1.1 * usual_s)
            found, took_s = kill_and_resume(argv, run, after_s, right)
            outcomes.update(found)
            resumed_s.append(took_s)
            shutil.rmtree(run)
    print(
        f"simulated drive; a replay takes {usual_s:.2f} s, a resumed one "
        f"{median(resumed_s):.2f} s (median)"
    )
    for outcome, times in outcomes.most_common():
        print(f"  {outcome:<40} {times:5} of {kills}")


def after_kill(run: Path, right: dict[str, str]) -> str:
    """Return the state of a killed run, which may be incomplete but not wrong."""
    try:
        manifest = open_run(run).manifest()
    except RunError:
        return "left: not a run"
    if manifest.stage != "estimate":
        return "left: only detected"
    return "left: complete" if contents(run) == right else "LEFT: TAKEN AS COMPLETE"


if __name__ == "__main__":
    main()
