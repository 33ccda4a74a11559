"""Reading a table leaves no state that could abort the process on exit."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.files import door

READS = """
import sys
from pathlib import Path
from crosscue.eval.runs.folder import RunFolder
for _ in range(3):
    RunFolder(Path(sys.argv[1])).table("many")
"""


@pytest.mark.slow
def test_process_exits_cleanly_after_reading_table(tmp_path: Path) -> None:
    # With reads through a Python file, 26 of 60 processes were aborted on exit.
    columns = {f"column_{i}": np.arange(2000.0) for i in range(30)}
    pq.write_table(
        pa.table(columns), tmp_path / "many.parquet", row_group_size=200, write_page_checksum=True
    )

    for _ in range(6):
        command = [sys.executable, "-c", READS, str(tmp_path)]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert run.returncode == 0, run.stderr


def test_table_at_path_that_is_not_utf_8_is_read(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes UTF-8 names only")
    pq.write_table(pa.table({"t_ns": [1, 2]}), tmp_path / "one.parquet")
    (tmp_path / "one.parquet").rename(folder / "one.parquet")

    assert RunFolder(folder).table("one").num_rows == 2


def test_missing_table_is_named_in_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="absent"):
        door.arrow_file(tmp_path / "absent.parquet")
