"""A run folder contains only complete files and has one writer at a time."""

import errno
import json
from pathlib import Path

import pytest

from crosscue.eval.runs.folder import open_run
from crosscue.replay.errors import OutputError, RunError
from crosscue.replay.files.whole_file import write_text, write_whole


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "old")

    def fail(partial: Path) -> None:
        partial.write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match="disk is full"):
        write_whole(tmp_path / "a.txt", fail)

    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "unreadable"),
        (json.dumps({"format_version": 99}), "format 99"),
        (json.dumps([1]), "format None"),
    ],
)
def test_damaged_or_unsupported_manifest_is_refused(
    tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "manifest.json").write_text(text)

    with pytest.raises(RunError, match=message):
        open_run(tmp_path)
