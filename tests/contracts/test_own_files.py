"""Files of ours and files of a log go through one door each, which follows no link."""

import os
import re
import resource
import shlex
import shutil
import subprocess
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval import cli
from crosscue.replay.errors import LogError
from crosscue.replay.formats import FORMATS
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from support.commands import python
from support.empty_inputs import empty_inputs
from support.every_format import EVERY_FORMAT
from support.pictures import picture_folder
from support.refusals import refusal

MAIN: Final = "from crosscue.eval.cli import main; main()"
VICTIM: Final = "years of work"
HUGE_BYTES: Final = 1_500_000_000
# Address space of a command that reads a run; a planted file must not fill it.
MEMORY_BYTES: Final = 3 << 30


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A log, its run and its vehicle file."""
    return empty_inputs(tmp_path_factory.mktemp("inputs"))


@pytest.fixture
def names(inputs: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """As ``inputs``, with a copy of the run next to the log's folder, and a file of the user."""
    folder = tmp_path / "all"
    shutil.copytree(inputs["run"].parent, folder)
    (tmp_path / "victim").write_text(VICTIM)
    home = inputs["run"].parent.resolve()
    copied = {name: folder / path.resolve().relative_to(home) for name, path in inputs.items()}
    return {**copied, "victim": tmp_path / "victim", "out": tmp_path / "out"}


@pytest.mark.parametrize(
    "command",
    [
        "tag {run} a=b",
        "estimate {run}",
        "score {run} --truth {empty}/truth.json",
        "replay {log} -o {run} --vehicle {car} --no-cache --overwrite",
    ],
)
def test_link_as_lock_is_refused_and_its_target_is_kept(
    command: str, names: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    (names["run"] / ".lock").symlink_to(names["victim"])

    status = cli.run(command.format(**names).split())

    assert names["victim"].read_text() == VICTIM
    assert status != 0
    assert ".lock: a link" in capsys.readouterr().err


@pytest.mark.parametrize("folder", ["score", "pictures", ".new"])
def test_link_in_place_of_folder_of_run_is_not_followed(
    folder: str, names: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    outside = names["victim"].parent / "outside"
    outside.mkdir()
    (outside / "metrics.json").write_text(VICTIM)
    (names["run"] / folder).symlink_to(outside)
    line = {
        "score": "score {run} --truth {drive}/truth.json --without-figures",
        "pictures": "detect {log} -o {run} --vehicle {car} --detectors grey --draw 3 --overwrite",
        ".new": "estimate {run}",
    }[folder]

    status = cli.run(line.format(**names, drive=names["car"].parent).split())

    assert status != 0
    error = capsys.readouterr().err
    assert "a link" in error or f"({folder})" in error
    assert [path.name for path in outside.iterdir()] == ["metrics.json"]
    assert (outside / "metrics.json").read_text() == VICTIM


def _device(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.symlink_to("/dev/zero")


def _pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def _sparse(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.touch()
    os.truncate(path, HUGE_BYTES)


PLANTED: Final[dict[str, tuple[Callable[[Path], None], str, str]]] = {
    "manifest is a device": (_device, "run/manifest.json", "tag {run}"),
    "failure log is huge": (_sparse, "run/failure.log", "query {run} 'select * from runs'"),
    "catalog is huge": (_sparse, ".catalog", "query {run}/.. 'select * from runs'"),
    "tags are huge": (_sparse, "run/tags.json", "tag {run}"),
    "manifest is huge": (_sparse, "run/manifest.json", "tag {run}"),
    "lock is a pipe": (_pipe, "run/.lock", "tag {run} a=b"),
    "manifest is a pipe": (_pipe, "run/manifest.json", "tag {run}"),
    "table is a pipe": (_pipe, "run/pose.parquet", "merge {run} -o {out}"),
    "table of a query is a pipe": (_pipe, "run/pose.parquet", "query {run} 'from pose'"),
    "table is a device": (_device, "run/cues.parquet", "query {run} 'from cues'"),
    "seal is a pipe": (_pipe, "{log}.seal", "info {log}"),
    "seal is a device": (_device, "{log}.seal", "check {log}"),
    "input is a pipe": (
        _pipe,
        "run/input.json",
        "replay {log} -o {run} --vehicle {car} --no-cache --resume",
    ),
    "cache is a pipe": (
        _pipe,
        "cache.sqlite",
        "detect {log} -o {out} --vehicle {car} --detectors grey --cache {run}/../cache.sqlite",
    ),
}


def _limited(code: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Run code with little address space, for a minute at most."""
    one = {"OPENBLAS_NUM_THREADS": "1", "ARROW_NUM_THREADS": "1"}
    limit = partial(resource.setrlimit, resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    return python(code, *words, env={**os.environ, **one}, preexec_fn=limit, timeout=60)


@pytest.mark.parametrize("case", PLANTED)
def test_planted_file_is_refused_in_bounded_time_and_memory(
    case: str, names: dict[str, Path]
) -> None:
    plant, place, line = PLANTED[case]
    plant(names["run"].parent / place.format(**names))

    done = _limited(MAIN, *shlex.split(line.format(**names)))

    assert "Traceback" not in done.stderr
    assert "memory" not in done.stderr
    if case == "catalog is huge":
        # A catalog is only a cache: the runs are read again.
        assert done.returncode in (0, 3)
        assert "outcome" in done.stdout
    elif case == "failure log is huge":
        assert "over 16 MiB" in done.stdout + done.stderr
    else:
        assert done.returncode, done


OPENING: Final = re.compile(
    r"(?<![\w.])open\(|\.open\(|\.(?:read|write)_(?:bytes|text)\(|os\.open\(|OSFile\(|memmap\("
    r"|\bpq\.(?:read_table|read_schema|write_table|ParquetFile|ParquetWriter)\("
    r"|np\.(?:load|save)|fromfile\(|sqlite3\.connect\(|copyfile\(|copy2\(|copytree\(|\.touch\("
)
LOGS: Final = "files of a log: a link among them is refused when it is opened"
NAMED: Final = "a file that the user names, not one that crosscue keeps"
PACKAGE: Final = "a file of this package or of this machine"
NEW: Final = "a new file under a random name, made exclusively, which replaces a name when complete"
HANDLE: Final = "Arrow or Python reads a file that the door has opened"
# Modules that open files otherwise, or folders of them, and why they may.
PAST_THE_DOOR: Final[dict[str, str]] = {
    "datasets/adapters/": LOGS,
    "datasets/real/": NAMED,
    "datasets/scenes/drive.py": PACKAGE,
    "datasets/scenes/rendering/textures.py": PACKAGE,
    "datasets/simulated/log_files.py": PACKAGE,
    "datasets/truth/": NAMED,
    "detectors/catalog/": NAMED,
    "detectors/cues/road_layout.py": PACKAGE,
    "detectors/networks/mask_rcnn/coco.py": NAMED,
    "detectors/result_cache.py": "SQLite opens the cache itself, after the door",
    "detectors/signs/templates.py": PACKAGE,
    "detectors/training/loop.py": PACKAGE,
    "eval/catalog/query/records.py": HANDLE,
    "eval/catalog/query/remote.py": "a file of a remote store",
    "eval/catalog/query/index.py": "a table in memory",
    "eval/check.py": NAMED,
    "eval/cli.py": PACKAGE,
    "eval/failures/record.py": NEW,
    "eval/fit/ranges/fit.py": HANDLE,
    "eval/fit/vehicle_output.py": NAMED,
    "eval/fit/detector/fit.py": NAMED,
    "eval/logs/log.py": LOGS,
    "eval/report/html.py": PACKAGE,
    "eval/runs/folder.py": "copies files of ours that are no links, and reads this machine's",
    "eval/runs/tables/parquet.py": HANDLE,
    "eval/studies/simulated_drives.py": PACKAGE,
    "localization/landmarks/database.py": NAMED,
    "replay/can/layout_cache.py": PACKAGE,
    "replay/compiled.py": PACKAGE,
    "replay/files/bounded.py": NAMED,
    "replay/files/door.py": "the door",
    "replay/files/identity.py": LOGS,
    "replay/files/partial_file.py": NEW,
    "replay/files/transfer.py": NEW,
    "replay/files/whole_file.py": NEW,
    "replay/mobileye/layout.py": PACKAGE,
    "replay/readers/": LOGS,
    "replay/remote/logs.py": "a remote file, and its copy in a folder that was just made",
    "replay/seal/seal.py": LOGS,
    "replay/versions.py": PACKAGE,
    "replay/write/mcap.py": NEW,
}


def test_nothing_opens_file_of_ours_past_the_door() -> None:
    root = Path(__file__).parents[2]
    opening = {
        path.relative_to(root).as_posix()
        for package in ("replay", "detectors", "fusion", "localization", "datasets", "eval")
        for path in (root / package).rglob("*.py")
        for line in path.read_text().splitlines()
        if OPENING.search(re.sub(r"\bcrosscue\.open\(|\bdoor\.\w+\(|\bdef \w+\(", "", line))
    }

    assert {name for name in opening if not name.startswith(tuple(PAST_THE_DOOR))} == set()
    unused = {one for one in PAST_THE_DOOR if not any(name.startswith(one) for name in opening)}
    assert unused == set()


READS: Final = """
import sys
from pathlib import Path
from crosscue.replay.files import door
from crosscue.replay.files.bounded import read_at_most
path = Path(sys.argv[1])
print(len(door.read(path, 4 << 30)), len(read_at_most(path, 4 << 30)))
"""


def test_small_file_is_read_with_a_limit_larger_than_the_memory(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_bytes(bytes(3 << 20))

    done = _limited(READS, tmp_path / "manifest.json")

    assert (done.stdout, done.stderr) == (f"{3 << 20} {3 << 20}\n", "")


FOLLOWING: Final = Limits(follow_links=True)
FOLDERS: Final = sorted(name for name in EVERY_FORMAT if FORMATS[name].markers)


@pytest.mark.parametrize("name", FOLDERS)
def test_each_file_of_log_folder_is_refused_as_link(name: str, tmp_path: Path) -> None:
    log = EVERY_FORMAT[name](tmp_path)
    if not log.is_dir():
        pytest.skip("this sample is a file")
    open_log(log).close()
    files = sorted(path for path in log.rglob("*") if path.is_file())

    for number, path in enumerate(files):
        if path.name in ("truth.json", "vehicle.toml"):
            continue
        elsewhere = tmp_path / f"elsewhere{number}"
        path.rename(elsewhere)
        path.symlink_to(elsewhere)

        with pytest.raises(LogError, match="a link, which is not followed") as refused:
            open_log(log)
        assert str(path) in str(refused.value)
        open_log(log, FOLLOWING).close()
        elsewhere.replace(path)

    open_log(log).close()


@pytest.mark.parametrize("name", EVERY_FORMAT)
def test_log_given_as_link_is_opened(name: str, tmp_path: Path) -> None:
    log = EVERY_FORMAT[name](tmp_path)
    (tmp_path / "given").mkdir()
    link = tmp_path / "given" / log.name
    link.symlink_to(log)

    open_log(link).close()


def test_folder_inside_log_is_refused_as_link(tmp_path: Path) -> None:
    log = picture_folder(tmp_path / "front", 3, "rate_hz: 10\n")
    (tmp_path / "more").mkdir()
    (log / "more").symlink_to(tmp_path / "more")

    with pytest.raises(LogError, match="more: a link"):
        open_log(log)


@pytest.mark.parametrize("command", ["convert {log} -o {out}.mcap", "decode {log} -o {out}"])
def test_bytes_outside_log_are_not_copied_through_link(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = picture_folder(tmp_path / "front", 3, "rate_hz: 10\n")
    first = min(log.glob("*.png"))
    secret = tmp_path / "secret.png"
    shutil.move(first, secret)
    first.symlink_to(secret)
    line = command.format(log=log, out=tmp_path / "out").split()

    assert f"{first}: a link" in refusal(4, *line)
    assert not list(tmp_path.glob("out*"))

    assert cli.run([*line, "--follow-links"]) in (0, 1)
    assert "a link" not in capsys.readouterr().err


def test_time_file_and_journal_next_to_log_are_refused_as_links(tmp_path: Path) -> None:
    log = picture_folder(tmp_path / "front", 3, "rate_hz: 10\n")
    times = next(path for path in log.iterdir() if path.suffix != ".png")
    times.rename(tmp_path / "elsewhere")
    (tmp_path / "front.txt").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(LogError, match=r"front\.txt: a link"):
        open_log(log)

    bag = EVERY_FORMAT["rosbag2-sqlite3"](tmp_path)
    (tmp_path / "journal").write_bytes(b"")
    bag.with_name(bag.name + "-journal").symlink_to(tmp_path / "journal")
    with pytest.raises(LogError, match="-journal: a link"):
        open_log(bag)
