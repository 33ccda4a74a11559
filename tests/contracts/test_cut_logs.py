"""Every format cut in the middle: what is left is used and 3 returned, or nothing is and 4."""

from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli
from crosscue.replay.formats import FORMATS
from support.every_format import EVERY_FORMAT

INDEX_AT_THE_END = {"mf4", "video"}
"""Files whose writer puts at their end what is needed to read any of it, if it gets there."""
CUT_TIMES = {"kitti-raw"}
"""Its largest file is a list of times; what has none is skipped, and so told."""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    """A short simulated drive."""
    folder = tmp_path_factory.mktemp("drive")
    return write_drive(folder, DriveSettings(seed=3, blocks=1, block_m=60.0))


def test_every_format_is_here() -> None:
    assert EVERY_FORMAT.keys() == FORMATS.keys()


@pytest.mark.parametrize("name", sorted(EVERY_FORMAT.keys() - CUT_TIMES))
@pytest.mark.parametrize("command", ["info", "convert"])
def test_a_log_cut_in_the_middle(
    name: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = EVERY_FORMAT[name](tmp_path)
    files = [log] if log.is_file() else [path for path in log.rglob("*") if path.is_file()]
    largest = max(files, key=lambda path: path.stat().st_size)
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])

    status = cli.run([command, str(log), *(["-o", str(tmp_path / "o.mcap")] * (command != "info"))])

    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    assert status in (3, 4), captured.err
    assert (status == 4) == captured.err.startswith("crosscue: ")
    if command == "info":
        assert status == 3 or name in INDEX_AT_THE_END
    elif status == 4:
        assert not (tmp_path / "o.mcap").exists()


@pytest.mark.parametrize(
    "flags",
    [
        "replay -o {out} --vehicle {car}",
        "replay -o {out} --vehicle {car} --topics /can",
        "replay -o {out} --vehicle {car} --to 5",
        "decode -o {out} --topics /can",
        "convert -o {out}.mcap --topics /can",
        "fit compass --vehicle {car}",
    ],
)
def test_a_log_cut_before_its_first_topic_is_unreadable_and_not_wrong_usage(
    drive: DriveFiles, flags: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "cut.mcap"
    log.write_bytes(drive.log.read_bytes()[:500])
    command, _, rest = flags.partition(" -")
    argv = f"-{rest}".format(out=tmp_path / "out", car=drive.vehicle).split()

    assert cli.run([*command.split(), str(log), *argv]) == 4
    err = capsys.readouterr().err
    assert err.startswith(f"crosscue: {log}: ")
    assert err.count("\n") == 1


def test_a_topic_that_a_whole_log_lacks_is_wrong_usage(
    drive: DriveFiles, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["decode", str(drive.log), "-o", str(tmp_path / "out"), "--topics", "/cam"]

    assert cli.run(argv) == 2
    assert "no such topic; there are: /can" in capsys.readouterr().err
