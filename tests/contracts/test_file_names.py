"""A drive whose files and folders have any name can be replayed, and its results read again.

Commands that read a run open its log, DBC file and tables again under the names that were written.
"""

import json
import os
import shutil
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

import crosscue
from crosscue.eval import cli
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.runs.logs import log_location
from crosscue.replay.files.tree_text import spelled, unspelled
from support.commands import json_of
from support.gap_drive import VEHICLE, Clock, write_drive

HOSTILE: Final[dict[str, bytes]] = {
    "not UTF-8, with line ends and backslashes": b"\xff\xfe caf\xe9\n\ntwo a\\b\\\\c\\",
    "looks spelled or formatted, with quotes": b'it\'s "quoted" \\xff\\\\x41\\n 100%25 %s',
    "blanks, emoji, composed and decomposed": "  two  blanks \U0001f697\u200d\U0001f525 ".encode()
    + "".join(unicodedata.normalize(form, "café") for form in ("NFC", "NFD")).encode(),
    "markup and control": b"$\\frac$ <img src=x>&amp; \x1b[31m\x7f\xc2\x85\xe2\x80\xa8",
}


@given(st.binary(max_size=40).filter(lambda name: b"\0" not in name))
def test_every_name_is_spelled_reversibly_in_printable_text(name: bytes) -> None:
    text = spelled(os.fsdecode(name))

    assert os.fsencode(unspelled(text)) == name
    assert text.encode("utf-8").decode("utf-8") == text
    assert not any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in text)


@given(st.text(st.characters(exclude_categories=["C", "Z"], exclude_characters="\\")))
def test_printable_names_without_backslash_are_spelled_as_they_are(name: str) -> None:
    assert spelled(name) == name


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short drive."""
    folder = tmp_path_factory.mktemp("drive")
    write_drive(folder, Clock(), seconds=12)
    return folder


def _named(drive: Path, folder: Path, name: str) -> Path:
    """Copy a drive to a folder with this name; its log and DBC file have it, too."""
    place = folder / name
    shutil.copytree(drive, place)
    (place / "drive.mcap").rename(place / f"{name}.mcap")
    (place / "simulated_car.dbc").rename(place / f"{name}.dbc")
    dbc = json.dumps(spelled(f"{name}.dbc"), ensure_ascii=False)
    (place / "vehicle.toml").write_text(VEHICLE.replace('"simulated_car.dbc"', dbc))
    return place


def _lines(place: Path, log: Path, run: Path) -> Iterator[tuple[str, ...]]:
    truth = str(place / "truth.json")
    yield "seal", str(log)
    yield "replay", str(place), "-o", str(run), "--no-cache"
    yield "info", str(log), "--json"
    yield "query", str(run.parent), "select run, logs from runs"
    yield "score", str(run), "--truth", truth
    yield "estimate", str(run)
    yield "tag", str(run), "weather=rain"
    yield "view", str(run), "-o", f"{run}.rrd"
    yield "failures", str(run), "--truth", truth, "-o", f"{place}/worst.parquet"
    yield "browse", f"{place}/worst.parquet", "-o", f"{place}/site"
    yield "export", f"{place}/worst.parquet", "-o", f"{place}/labels"
    yield "merge", str(run.parent), "-o", f"{place}/all"
    yield "compare", str(run), str(run)
    yield "convert", str(log), "-o", f"{log}.copy.mcap"
    yield "decode", str(log), "-o", f"{place}/tables", "--vehicle", f"{place}/vehicle.toml"


@pytest.mark.slow
@pytest.mark.parametrize("what", HOSTILE)
def test_commands_accept_any_name(
    what: str, drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = os.fsdecode(HOSTILE[what])
    place = _named(drive, tmp_path, name)
    log, run = place / f"{name}.mcap", place / "runs" / name

    for line in _lines(place, log, run):
        status = cli.run([*line, *([] if "--json" in line else ["-q"])])
        assert status == 0, (line[0], capsys.readouterr().err)
    manifest = open_run(run).drive_manifest()
    found = crosscue.catalog(run.parent)

    assert log_location(RunFolder(run), manifest.logs[0]) == log
    assert manifest.logs[0].name == spelled(log.name)
    assert found.runs == (run,)
    assert found.query("select run from belief limit 1").to_pylist() == [{"run": spelled(name)}]
    assert crosscue.read_failures(place / "worst.parquet")[0].run == str(run)
    _check_text(place)


@pytest.mark.slow
def test_batch_of_drives_with_any_names(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in HOSTILE.values():
        _named(drive, tmp_path / "drives", os.fsdecode(name))
    broken = _named(drive, tmp_path / "drives", os.fsdecode(b"broken\xff"))
    (broken / f"{broken.name}.mcap").write_bytes(b"no log")
    argv = ["replay", str(tmp_path / "drives"), "-o", str(tmp_path / "runs"), "--no-cache", "-q"]

    assert cli.run(argv) == 3, capsys.readouterr().err
    capsys.readouterr()
    rows = json_of("query", tmp_path / "runs", "from runs")
    assert cli.run(["status", str(tmp_path / "runs"), "--json"]) == 3

    logs = sorted(name for row in rows for name in row["logs"] or [])
    assert logs == sorted(spelled(os.fsdecode(name) + ".mcap") for name in HOSTILE.values())
    assert [row["outcome"] for row in rows].count("failed") == 1
    _check_text(tmp_path / "runs")


def _check_text(folder: Path) -> None:
    """Check that every JSON file, table and page below a folder is valid for any reader."""
    for path in folder.rglob("*"):
        if path.suffix == ".json":
            _check_tree(json.loads(path.read_text(encoding="utf-8")))
        elif path.suffix in (".html", ".log", ".xml", ".toml", ".seal"):
            path.read_text(encoding="utf-8")
        elif path.suffix == ".parquet":
            json.dumps(
                pq.read_table(pa.BufferReader(path.read_bytes())).to_pylist(), default=str
            ).encode("utf-8")


def _check_tree(tree: Any) -> None:
    if isinstance(tree, str):
        tree.encode("utf-8")
    elif isinstance(tree, dict):
        _check_tree([*tree.keys(), *tree.values()])
    elif isinstance(tree, list):
        for one in tree:
            _check_tree(one)
