"""The same input yields the same bytes, whatever the circumstances of the process that wrote them.

Each test compares whole run folders, file by file. Only ``NOT_COMPARED`` is left out.
"""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval.batch.journal import JOURNAL
from crosscue.eval.runs.folder import LOCK, MANIFEST, TIMINGS, RunFolder
from support.gap_drive import Clock, write_drive
from support.trees import contents

pytestmark = pytest.mark.slow
NOT_COMPARED: Final[Mapping[str, str]] = {
    TIMINGS: "how long it took, and how much was read from the cache",
    LOCK: "names the process that is writing; gone when the run is finished",
    JOURNAL: "part of a batch, not of a run; knows files by path and time, to see what is done",
}
DRIVES: Final = ("A", "B")
# Circumstances of the expected files.
HERE: Final = {"PYTHONHASHSEED": "1", "TZ": "UTC", "LC_ALL": "C.UTF-8", "COLUMNS": "80"}
ELSEWHERE: Final = {"PYTHONHASHSEED": "2", "TZ": "Asia/Kolkata", "LC_ALL": "C", "COLUMNS": "190"}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short drives, each in a folder of its own with its vehicle file."""
    folder = tmp_path_factory.mktemp("place")
    for i, name in enumerate(DRIVES):
        write_drive(folder / "drives" / name, Clock(), seconds=4 + i)
        (folder / "drives" / name / "car.toml").rename(folder / "drives" / name / "vehicle.toml")
    return folder


def _lines(workers: str, *cache: str) -> list[list[str]]:
    """Return the commands that write each kind of run folder, next to the folder of drives.

    All but the first find its detections in the cache, if they use one.
    """
    log, truth = "../drives/A/drive.mcap", "../drives/A/truth.json"
    vehicle = ["--vehicle", "../drives/A/vehicle.toml"]
    return [
        ["replay", "../drives", "-o", "batch", "--workers", workers, "--draw", "2"],
        ["detect", log, "-o", "detect", *vehicle, *cache],
        ["replay", "../drives/A", "-o", "replay", *cache],
        ["replay", "../drives/A", "-o", "estimate", *cache],
        ["estimate", "estimate"],
        ["decode", log, "-o", "decode", *vehicle],
        ["merge", "batch", "-o", "merge"],
        ["score", "replay", "--truth", truth],
    ]


def _run(folder: Path, lines: Sequence[Sequence[str]], environment: Mapping[str, str]) -> None:
    """Run command lines in one new process, in ``folder``; each must succeed."""
    folder.mkdir(exist_ok=True)
    script = (
        "import json, sys\nfrom crosscue.eval.cli import run\nif __name__ == '__main__':\n"
        "    for line in json.loads(sys.argv[1]):\n"
        "        status = run([*line, '-q'])\n        assert status == 0, (line, status)\n"
    )
    given = {**os.environ, **HERE, **environment, "XDG_CACHE_HOME": str(folder.parent / "cache")}
    given["PYTHONPATH"] = os.pathsep.join(sys.path)
    subprocess.run(
        [sys.executable, "-c", script, json.dumps(lines)], env=given, cwd=folder, check=True
    )


def _different(there: Path, here: Path) -> list[str]:
    """Return the names of files that are missing or different."""
    a, b = contents(there), contents(here)
    compared = {
        name for name in a.keys() | b.keys() if not NOT_COMPARED.keys() & {*Path(name).parts}
    }
    return sorted(name for name in compared if a.get(name) != b.get(name))


@pytest.fixture(scope="module")
def expected(place: Path) -> Path:
    """Run folders made by each command, with an empty detection cache."""
    shutil.rmtree(place / "cache", ignore_errors=True)
    _run(place / "first", _lines("1"), {})
    return place / "first"


def test_run_folders_have_same_bytes_in_other_circumstances(place: Path, expected: Path) -> None:
    """Other hash seed, time zone, locale and terminal, drives in parallel, and no cache.

    It is another folder, with the same relative paths between drives and runs.
    """
    # On the same disk, with other times of the same files.
    elsewhere = place / "deeper" / "elsewhere"
    shutil.copytree(place / "drives", elsewhere / "drives", copy_function=shutil.copyfile)
    _run(elsewhere / "again", _lines("2", "--no-cache"), ELSEWHERE)

    assert not _different(expected, elsewhere / "again")


def test_resumed_run_has_same_bytes(place: Path, expected: Path) -> None:
    log, vehicle = "../drives/A/drive.mcap", "../drives/A/vehicle.toml"
    resume = ["replay", log, "--vehicle", vehicle, "--resume", "-o"]
    shutil.copytree(expected / "detect", place / "resumed" / "after_detect")
    shutil.copytree(expected / "replay", place / "resumed" / "without_manifest")
    shutil.rmtree(place / "resumed" / "without_manifest" / "score")
    (place / "resumed" / "without_manifest" / MANIFEST).unlink()
    names = ("after_detect", "without_manifest")
    _run(place / "resumed", [[*resume, name] for name in names], {})
    shutil.rmtree(expected / "replay" / "score")

    for name in names:
        assert not _different(expected / "replay", place / "resumed" / name)
    assert not _different(expected / "replay", expected / "estimate")


def test_manifest_has_no_times_and_timings_file_has_them(expected: Path) -> None:
    found = {path.parent.name for path in expected.rglob(TIMINGS)}
    for path in expected.rglob(MANIFEST):
        assert not {"timings", "ran", "from_cache", "decoded"} & _keys(json.loads(path.read_text()))
    timed = RunFolder(expected / "estimate").timings()

    assert {"detect", "replay", "estimate"} < found
    assert timed is not None
    assert timed.seconds > 0.0
    assert timed.detect is not None
    assert timed.detect.from_cache == {"grey": 40}


def _keys(tree: object) -> set[str]:
    """Return all names of fields in a JSON document."""
    if isinstance(tree, dict):
        return set(tree).union(*map(_keys, tree.values()))
    return set().union(*map(_keys, tree)) if isinstance(tree, list) else set()
