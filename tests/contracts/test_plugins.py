"""An installed package adds a detector, a cue, a reader and a data set, and checks them."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import pytest

MODULE: Final = """
import csv, json
from pathlib import Path
import numpy as np
from crosscue import CueSpec, DataSet, Format

LINES = Format((".lines",), (), "dummy_package:open_lines", "lines of time and value")
DRIVE = DataSet(
    Format((), ("drive.lines",), "dummy_package:open_drive", "folder"), "dummy_package:truth"
)
ZEBRA = CueSpec(name="zebra", group="zebra", title="zebra crossing", observed_by="objects",
    rule="dummy_package:count", precision=0.61, supports=("straight",), scored_as="feature")


def count(boxes, vehicle, cue):
    return sum(found.labels.count("zebra") for found in boxes)


def row_of(line):
    t_ns, value = line.split()
    return int(t_ns), float(value)


def open_lines(path, limits):
    from crosscue.replay.readers.text_log import TextLog
    return TextLog(path, "lines", "/value", ["value"], row_of)


def open_drive(path, limits):
    from crosscue.replay.readers.text_log import TextLog
    return TextLog(path / "drive.lines", "line-drive", "/value", ["value"], row_of)


def truth(log, folder):
    from crosscue.datasets.truth.truth import Truth, save
    times = [int(line.split()[0]) for line in (log / "drive.lines").read_text().splitlines()]
    return save(Truth(version=1, start_ns=min(times), end_ns=max(times) + 1), folder)


def build(**settings):
    from support.detecting import build
    return build(**settings)
"""
POINTS: Final = """
[crosscue.detectors]
bright = dummy_package:build
broken = dummy_package:no_such_thing
signs = dummy_package:build

[crosscue.cues]
zebra = dummy_package:ZEBRA

[crosscue.readers]
lines = dummy_package:LINES
wrong = dummy_package:ZEBRA

[crosscue.datasets]
line-drive = dummy_package:DRIVE
"""
CHECKS: Final = """
import sys, pathlib
import crosscue, dummy_package
from crosscue import testing
from crosscue.detectors.base import DetectorChoice
from crosscue.detectors.registry import make
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Vehicle

def damage(path):
    file = path / "drive.lines" if path.is_dir() else path
    lines = file.read_text().splitlines()
    lines[4] = "?"
    file.write_text("\\n".join(lines))

here = pathlib.Path(sys.argv[1])
text = "".join(f"{10 * i} {i}\\n" for i in range(10))
(here / "a.lines").write_text(text)
(here / "drive").mkdir()
(here / "drive" / "drive.lines").write_text(text)
with crosscue.open(here / "a.lines") as log:
    assert log["/value"].table()["value"].to_pylist() == list(range(10))
testing.check_detector(lambda: make(DetectorChoice("bright", "bright")))
testing.check_cue(CUES["zebra"])
assert Vehicle(version=1).fusion.cues["zebra"].precision == 0.61
testing.check_reader(here / "a.lines", damage)
testing.check_dataset(here / "drive", here / "truth", damage)
print("kept")
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that pip would install of the package."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "dummy_package.py").write_text(MODULE)
    info = folder / "dummy_package-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dummy-package\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(POINTS)
    return folder


def _run(site: Path, *argv: str) -> subprocess.CompletedProcess[str]:
    paths = [str(site), *sys.path, str(Path(__file__).parents[1])]
    return subprocess.run(
        [sys.executable, *argv],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
        capture_output=True,
        text=True,
        check=False,
    )


def test_plugins_are_listed_with_their_problems(site: Path) -> None:
    done = _run(site, "-m", "crosscue.eval.cli", "plugins", "--json")

    assert done.returncode == 1, done.stderr
    listed: list[dict[str, Any]] = json.loads(done.stdout)["plugins"]
    ours = {
        (one["kind"], one["name"]): one["problem"]
        for one in listed
        if one["package"] == "dummy-package"
    }
    assert all(one["version"] == "1.2" for one in listed if one["package"] == "dummy-package")
    valid = [key for key, problem in ours.items() if not problem]
    assert sorted(valid) == [
        ("cue", "zebra"),
        ("dataset", "line-drive"),
        ("detector", "bright"),
        ("reader", "lines"),
    ]
    assert "no_such_thing" in ours["detector", "broken"]
    assert "name is already in use" in ours["detector", "signs"]
    assert "is CueSpec; expected Format" in ours["reader", "wrong"]


def test_plugins_work_and_fulfil_contracts(site: Path, tmp_path: Path) -> None:
    done = _run(site, "-c", CHECKS, str(tmp_path))

    assert done.stdout.strip() == "kept", done.stderr


def test_cue_with_name_other_than_entry_point_is_refused(site: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    info = tmp_path / "other" / "dummy_package-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dummy-package\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text("[crosscue.cues]\nother = dummy_package:ZEBRA\n")
    (tmp_path / "other" / "dummy_package.py").write_text(MODULE)

    done = _run(tmp_path / "other", "-m", "crosscue.eval.cli", "plugins")

    assert done.returncode == 1
    assert "expected the name" in done.stdout
