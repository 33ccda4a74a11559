"""Memory of `convert` depends on the structure of a log, not on its length."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.mcap_files import channel, header, record, schema
from support.measured import measured

RECORDS = 400_000
PAYLOAD = b"\0\1\0\0" + bytes(24)
DATA_END, FOOTER, MESSAGE = 0x0F, 0x02, 0x05


def _unchunked() -> bytes:
    """Vectors one after another without a chunk or an index."""
    rows = np.zeros(
        RECORDS,
        dtype=[
            ("opcode", "u1"),
            ("length", "<u8"),
            ("channel", "<u2"),
            ("sequence", "<u4"),
            ("log", "<u8"),
            ("publish", "<u8"),
            ("payload", f"V{len(PAYLOAD)}"),
        ],
    )
    rows["opcode"], rows["length"] = MESSAGE, rows.dtype.itemsize - 9
    rows["channel"], rows["payload"] = 1, np.void(PAYLOAD)
    rows["log"] = rows["publish"] = 10**18 + 1000 * np.arange(RECORDS)
    text = b"float64 x\nfloat64 y\nfloat64 z"
    start = header("ros2") + schema(1, "geometry_msgs/msg/Vector3", "ros2msg", text)
    end = record(DATA_END, bytes(4)) + record(FOOTER, bytes(20))
    magic = b"\x89MCAP0\r\n"
    return magic + start + channel(1, 1, "/v") + rows.tobytes() + end + magic


@pytest.mark.slow
def test_an_unchunked_log_of_many_small_records_is_converted_in_little_memory(
    tmp_path: Path,
) -> None:
    log = tmp_path / "log.mcap"
    log.write_bytes(_unchunked())

    out = str(tmp_path / "out.mcap")
    status, said, peak_mb = measured(["convert", str(log), "-o", out, "--json"])

    assert status == 0, said
    assert str(RECORDS) in said
    assert peak_mb < 200
