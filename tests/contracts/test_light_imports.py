"""Modules import neither themselves nor, to read and score a drive, a heavy library."""

import json
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Final

import grimp
import pyarrow.parquet as pq
import pytest

from support.commands import python
from support.gap_drive import Clock, write_drive
from support.onnx_models import bright_box_model, write_card

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
# What takes longer to import than a small log to read.
SLOW: Final = (*COMPILER, "pydantic", "pyarrow", "tomllib", "email", "fsspec")
COMMAND: Final = "from crosscue.eval.cli import main; main(sys.argv[1:])"
VEHICLE: Final = """
[detectors.bright]
kind = "model"
card = "net.toml"
"""


def run_without(
    modules: tuple[str, ...], code: str, *arguments: str, folder: Path | None = None
) -> str:
    """Run code that fails on any attempt to import ``modules``, and return its output."""
    done = python(BLOCKED_RUN + code, ",".join(modules), *arguments, timeout=300, cwd=folder)
    assert done.returncode == 0, f"{arguments}: {done.stderr[-2000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with camera, CAN and truth; its vehicle file names a small network as detector."""
    folder = tmp_path_factory.mktemp("light")
    log = write_drive(folder, Clock())
    output = 'kind = "end-to-end"\nclasses = ["stop sign"]\nscore = 0.5\noverlap = 1.0'
    write_card(folder, bright_box_model(), output, (160, 90), 'fit = "stretch"')
    with (folder / "car.toml").open("a", encoding="utf-8") as stream:
        stream.write(VEHICLE)
    return log


def test_import_of_blocked_module_fails() -> None:
    with pytest.raises(AssertionError, match="json is imported"):
        run_without(("json",), "import json")


def test_info_does_not_import_compiler(drive: Path) -> None:
    assert "/can" in run_without(COMPILER, COMMAND, "info", str(drive))


@pytest.mark.parametrize("options", [(), ("--quick",)])
def test_info_of_log_without_odometry_imports_neither_vehicle_file_nor_tables(
    options: tuple[str, ...], drive: Path
) -> None:
    assert "/can" in run_without(SLOW, COMMAND, "info", str(drive), *options)


def test_replay_and_estimate_with_detector_do_not_import_pandas(drive: Path) -> None:
    lines = (
        "replay drive.mcap -o seen --vehicle car.toml --detectors bright -q",
        "estimate seen --vehicle car.toml -q",
    )
    run_without((*HEAVY, "pandas"), CHAIN, *lines, folder=drive.parent)


def test_tables_and_batches_of_a_log_do_not_import_pandas(drive: Path) -> None:
    code = """
import sys
import crosscue
with crosscue.open(sys.argv[1]) as log:
    rows = sum(batch.num_rows for _, batch in log.batches())
    print(rows, len(log["/can"].table()))
"""
    printed = run_without((*HEAVY, "pandas"), code, str(drive))
    assert min(map(int, printed.split())) > 0


def test_replay_with_onnx_detector_and_score_need_no_heavy_library(drive: Path) -> None:
    run = drive.parent / "run"

    printed = run_without(
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
    # Pictures of frames are JPEG; figures would be PNG.
    assert page.count("<img") == page.count("data:image/jpeg")


PACKAGES = [
    f"crosscue.{name}"
    for name in ("replay", "detectors", "fusion", "localization", "datasets", "eval")
]


def test_imports_have_no_cycle() -> None:
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}

    assert len([*TopologicalSorter(imports).static_order()]) == len(imports) > 100
