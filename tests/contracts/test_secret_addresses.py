"""Secrets in addresses of logs: no command prints, stores or names them."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive as simulated
from crosscue.eval.cli import COMMANDS, parser_of
from crosscue.eval.cli import run as crosscue
from crosscue.replay.remote import logs as remote
from crosscue.replay.remote import ranges as remote_ranges
from support.commands import python
from support.gap_drive import Clock, write_drive
from support.range_server import Served, serving
from support.street_map import write_crossing

SECRET: Final = "hunter2"
PARTS: Final = "?X-Amz-Signature=hunter2query&hunter2=1#hunter2fragment"
# Arguments of each command that reads logs at URLs, and its exit status.
FINE: Final[dict[str, tuple[str, int]]] = {
    "info": ("DRIVE --json -v", 0),
    "convert": ("DRIVE -o out.mcap", 0),
    "decode": ("DRIVE --vehicle CAR -o tables --json", 0),
    "detect": ("DRIVE --vehicle CAR -o found --no-cache", 0),
    "replay": ("DRIVE --vehicle CAR -o run --no-cache", 0),
    "fit compass": ("COMPASS --vehicle ITS_CAR", 0),
    "fit odometry": ("COMPASS --vehicle ITS_CAR --truth ITS_TRUTH --keep", 0),
    "truth from-gnss": ("COMPASS -o truth", 1),
    "truth from-map": ("COMPASS streets.osm -o truth", 1),
}
# Commands whose LOG is text, but must be on this machine.
LOCAL: Final = frozenset({"seal"})


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("drives")
    compass = simulated(folder / "compass", DriveSettings(seed=3, blocks=2, block_m=60.0))
    log = write_drive(folder, Clock(), seconds=4)
    return {
        "DRIVE": log,
        "CAR": folder / "car.toml",
        "COMPASS": compass.log,
        "ITS_CAR": compass.vehicle,
        "ITS_TRUTH": compass.truth,
    }


@pytest.fixture
def web(
    drives: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Served]:
    """Serve the drives to whoever knows the secret; everything is written below ``tmp_path``."""
    pytest.importorskip("aiohttp", reason="aiohttp, by which fsspec reads from the web, is missing")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(remote.STORE_VARIABLE, str(tmp_path / "store"))
    for variable in ("HOME", "XDG_CACHE_HOME", "TMPDIR"):
        monkeypatch.setenv(variable, str(tmp_path))
    monkeypatch.setattr(remote_ranges, "WAITS_S", (0.0,))
    with serving() as served:
        for name, path in drives.items():
            served.files[f"{name}{path.suffix}"] = path.read_bytes()
        write_crossing(tmp_path / "streets.osm")
        served.password = SECRET
        yield served


def url_of(web: Served, name: str) -> str:
    """Return the address of a file with a secret in each of its parts."""
    return f"{web.base.replace('//', '//hunter2user:hunter2password@')}/{name}{PARTS}"


def words_of(line: str, web: Served, drives: dict[str, Path]) -> list[str]:
    """Return the words of a line; logs become addresses, vehicle files paths."""
    return [
        url_of(web, f"{word}{drives[word].suffix}")
        if word in ("DRIVE", "COMPASS")
        else str(drives.get(word, word))
        for word in line.split()
    ]


def check_nothing_kept(folder: Path, printed: str) -> None:
    """Search a text, and names and contents of all files below a folder, for the secret."""
    assert SECRET not in printed
    for path in folder.rglob("*"):
        assert SECRET not in str(path.relative_to(folder))
        if not path.is_file():
            continue
        content = path.read_bytes()
        assert SECRET.encode() not in content, path
        if path.suffix == ".parquet":
            table = pq.read_table(path)
            assert SECRET not in f"{table.schema.metadata} {table.to_pylist()}", path
        elif path.name == "out.mcap":
            with path.open("rb") as stream:
                reader = make_reader(stream)
                rest = [*reader.iter_metadata(), *reader.iter_attachments(), reader.get_header()]
                assert SECRET not in repr(rest), path


def test_every_command_that_takes_a_log_is_tested() -> None:
    takes_text = {
        name
        for name in COMMANDS
        for action in parser_of(name)[1]._actions
        if action.metavar == "LOG" and action.type is None
    }

    assert takes_text == FINE.keys() | LOCAL


@pytest.mark.parametrize("name", FINE)
def test_command_keeps_no_secret(
    name: str,
    drives: dict[str, Path],
    web: Served,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    line, status = FINE[name]

    ended = crosscue([*name.split(), *words_of(line, web, drives)])

    printed = capfd.readouterr()
    assert ended == status, printed.err
    assert any(request.startswith("GET") for request in web.requests)
    check_nothing_kept(tmp_path, printed.out + printed.err)


@pytest.mark.parametrize("name", FINE)
@pytest.mark.parametrize("password", [SECRET, "another"])
def test_failing_command_keeps_no_secret(
    name: str,
    password: str,
    drives: dict[str, Path],
    web: Served,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The log does not exist, or its server refuses the password."""
    web.files = {}
    web.password = password

    words = [word for word in words_of(FINE[name][0], web, drives) if word != "-v"]
    assert crosscue([*name.split(), *words]) == 4
    assert crosscue([*name.split(), *words, "-v"]) == 4

    printed = capfd.readouterr()
    assert web.base in printed.err
    check_nothing_kept(tmp_path, printed.out + printed.err)


@pytest.mark.parametrize("name", COMMANDS)
def test_address_for_any_argument_is_not_printed(
    name: str, web: Served, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Paths are refused as wrong usage; what else a command makes of the address is its own."""
    parser = parser_of(name)[1]
    needed = [
        word
        for action in parser._actions
        if action.required and action.option_strings
        for word in (action.option_strings[-1], next(iter(action.choices or ["x.json"])))
    ]
    places = [action for action in parser._actions if not action.option_strings]
    url = url_of(web, "x.mcap")
    for action in parser._actions:
        if action.type is Path:
            words = [url for _ in places]
            if action.option_strings:
                words += [*needed, action.option_strings[-1], url]
            assert crosscue([*name.split(), *words]) == 2
    for text in (url, "http://hunter2:hunter2/hunter2@host/x.mcap", f"--{url}"):
        if places:
            crosscue([*name.split(), *(text for _ in places), *needed])

    printed = capfd.readouterr()
    check_nothing_kept(tmp_path, printed.out + printed.err)


def test_batch_keeps_no_secret(
    drives: dict[str, Path], web: Served, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Of four listed drives one is fine, one is missing, one damaged, one of an unknown suffix."""
    web.files["damaged.mcap"] = b"damaged"
    names = ("DRIVE.mcap", "missing.mcap", "damaged.mcap", "log.xyz")
    urls = "".join(f"'{url_of(web, name)}'\n" for name in names)
    drive_list = tmp_path.parent / f"{tmp_path.name}.txt"
    drive_list.write_text(urls)
    car = ["--vehicle", str(drives["CAR"])]
    replay = ["replay", f"@{drive_list}", *car, "-o", "runs", "--no-cache", "--workers", "2"]

    assert crosscue(replay) == 3
    assert crosscue([*replay, "--json"]) == 3
    for line in ("status runs", "merge runs -o merged", "tag runs a=b", "history runs"):
        crosscue(line.split())
    assert crosscue(["query", "runs", "from runs", "--json"]) in (0, 3)

    printed = capfd.readouterr()
    assert '"failed"' in printed.out
    assert len([*(tmp_path / "runs").glob("*/failure.log")]) == 3
    check_nothing_kept(tmp_path, printed.out + printed.err)


def test_run_of_secret_address_needs_a_copy_of_its_log(
    drives: dict[str, Path], web: Served, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    replay = ["replay", *words_of(FINE["replay"][0], web, drives)]
    assert crosscue(replay) == 0
    assert crosscue([*replay, "--resume"]) == 0
    web.files["elsewhere"] = web.files.pop("DRIVE.mcap")
    capfd.readouterr()

    assert crosscue(["estimate", "run"]) == 4
    assert crosscue(["view", "run", "-o", "run.rrd"]) == 4
    for line in capfd.readouterr().err.splitlines():
        assert "keeps no user, password or query" in line
    assert crosscue(["view", "run", "-o", "run.rrd", "--without-images"]) == 0
    copies = tmp_path / "copies"
    copies.mkdir()
    copies.joinpath("DRIVE.mcap").write_bytes(web.files["elsewhere"])
    assert crosscue(["estimate", "run", "--logs", "copies"]) == 0
    assert crosscue(["view", "run", "-o", "with.rrd", "--logs", "copies"]) == 0
    printed = capfd.readouterr()
    check_nothing_kept(tmp_path, printed.out + printed.err)


def test_messages_of_libraries_on_standard_error_lose_secrets() -> None:
    code = (
        "import logging, sys, warnings\n"
        "from crosscue.eval import cli\n"
        "def run(argv):\n"
        "    logging.getLogger('asyncio').error('Unclosed http://u:hunter2@h/a?hunter2')\n"
        "    warnings.warn('slow: http://u:hunter2@h/a?hunter2')\n"
        "    raise ValueError('http://u:hunter2@h/a?hunter2')\n"
        "cli.run = run\n"
        "cli.main([])\n"
    )
    ended = python(code, env={**os.environ, "PYTHONWARNINGS": "default"})

    assert ended.stderr.count("http://h/a") == 3
    assert SECRET not in ended.stderr
