"""Whoever reads, decodes, replays or scores a drive needs none of the heavy libraries."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

import pyarrow.parquet as pq
import pytest

from support.gap_drive import Clock, write_drive
from support.onnx_models import bright_box_model

HEAVY: Final = ("torch", "torchvision", "rerun", "ray", "matplotlib")
COMPILER: Final = (*HEAVY, "numba", "llvmlite")
BLOCKED_RUN: Final = """\
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in BLOCKED:
            raise AssertionError(f"{name} is imported")

BLOCKED = sys.argv.pop(1).split(",")
sys.meta_path.insert(0, Refuse())
"""
CHAIN: Final = """\
from crosscue.eval.cli import run
for line in sys.argv[1:]:
    status = run(line.split())
    assert status == 0, (line, status)
"""
COMMAND: Final = "from crosscue.eval.cli import main; main(sys.argv[1:])"
CARD: Final = """\
version = 1
weights = "net.onnx"
sha256 = "{sha256}"
[input]
width_px = 160
height_px = 90
fit = "stretch"
[output]
kind = "end-to-end"
classes = ["stop sign"]
score = 0.5
overlap = 1.0
"""
VEHICLE: Final = """
[detectors.bright]
kind = "model"
card = "card.toml"
"""


def without(
    modules: tuple[str, ...], code: str, *arguments: str, folder: Path | None = None
) -> str:
    """Output of a Python that cannot import ``modules``; any attempt fails, even a guarded one."""
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED_RUN + code, ",".join(modules), *arguments],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=False,
    )
    assert done.returncode == 0, f"{arguments}: {done.stderr[-2000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with camera, CAN and truth; its vehicle file names a detector of our own making."""
    folder = tmp_path_factory.mktemp("light")
    log = write_drive(folder, Clock())
    network = bright_box_model()
    (folder / "net.onnx").write_bytes(network)
    card = CARD.format(sha256=hashlib.sha256(network).hexdigest())
    (folder / "card.toml").write_text(card, encoding="utf-8")
    with (folder / "car.toml").open("a", encoding="utf-8") as stream:
        stream.write(VEHICLE)
    return log


def test_the_refusal_refuses() -> None:
    with pytest.raises(AssertionError, match="json is imported"):
        without(("json",), "import json")


def test_importing_crosscue_and_asking_for_help_compile_nothing() -> None:
    without(COMPILER, "import crosscue")
    assert "exit status" in without(COMPILER, COMMAND, "--help")


def test_a_log_is_described_without_a_compiler(drive: Path) -> None:
    assert "/can" in without(COMPILER, COMMAND, "info", str(drive))


def test_a_drive_is_replayed_with_an_onnx_detector_and_scored(drive: Path) -> None:
    run = drive.parent / "run"

    printed = without(
        HEAVY,
        CHAIN,
        "convert drive.mcap -o copy.mcap -q",
        "decode drive.mcap -o decoded --vehicle car.toml -q",
        "replay drive.mcap -o run --vehicle car.toml --detectors bright --cache c.sqlite --json",
        "estimate run --vehicle car.toml -q",
        "score run --without-figures -q",
        folder=drive.parent,
    )

    assert json.loads(printed)["detected"]["ran"] == {"bright": 140}
    boxes = pq.read_table(run / "detections.parquet")
    assert len(boxes) == 140 - 128
    assert set(boxes["label"].to_pylist()) == {"stop sign"}
    page = (run / "score" / "report.html").read_text(encoding="utf-8")
    assert "<h2>Cues</h2>" in page
    assert "<svg" not in page
    assert "<img" not in page.split("<h2>How")[0].replace("data:image/jpeg", "")
