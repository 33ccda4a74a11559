"""A link among the files of a log is refused by name; the log itself may be given as a link."""

import shutil
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval import cli
from crosscue.replay.errors import LogError
from crosscue.replay.formats import FORMATS
from crosscue.replay.limits import Limits
from crosscue.replay.logs.opening import open_log
from support.every_format import EVERY_FORMAT
from support.pictures import picture_folder
from support.refusals import refusal

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
