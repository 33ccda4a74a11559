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


def _unchunked_log() -> bytes:
    """Return an MCAP file of consecutive vectors without chunks and index."""
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
def test_unchunked_log_is_converted_within_memory_limit(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    log.write_bytes(_unchunked_log())

    out = str(tmp_path / "out.mcap")
    status, output, peak_mb = measured(["convert", str(log), "-o", out, "--json"])

    assert status == 0, output
    assert str(RECORDS) in output
    assert peak_mb < 200
