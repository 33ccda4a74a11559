"""``crosscue decode``: every stream as a Parquet file, every frame accounted for."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

from crosscue.eval.catalog.decoded_logs import decode_tables, table_file
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import create
from crosscue.replay.columns import Block, Table, Topic
from crosscue.replay.mobileye.can.encode import bursts_of, encode_tables
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.settings import MobileyeSettings
from crosscue.replay.vehicle.vehicle import Mobileye, Vehicle
from support.memory_log import MemoryLog

EYE = Topic("eye", "crosscue/CanFrames", "columns")


def _mobileye_drive() -> list[Block]:
    """One car ahead, simulated, fifteen images a second."""
    image_ns = np.arange(30, dtype=np.int64) * 66_000_000 + 1_000_000_000
    x_m = 80.0 - np.arange(30)
    objects = Table(
        {
            "t_ns": image_ns,
            "x_m": x_m,
            "y_m": np.full(30, 2.0),
            "obstacle_id": np.full(30, 7, np.int16),
        }
    )
    settings = MobileyeSettings(mounting=DevicePosition(2.0, 0.0, 0.0))
    return [encode_tables(bursts_of(image_ns, objects, settings, bus="eye"), settings, "eye")]


def test_mobileye_frames_decode_to_obstacles_relative_to_rear_axle(tmp_path: Path) -> None:
    vehicle = Vehicle(version=1, mobileye=Mobileye(bus="eye", x_m=2.0))

    folder, log = tmp_path / "out", MemoryLog((EYE,), _mobileye_drive(), path=Path(__file__))
    decode_tables(Drive([log], vehicle), create(folder, overwrite=False))

    table = pq.read_table(folder / "eye_mobileye_obstacles.parquet")
    np.testing.assert_allclose(table["x_m"], 80.0 - np.arange(30), atol=1 / 32)
    np.testing.assert_allclose(table["y_m"], 2.0, atol=1 / 32)
    assert (folder / "eye_mobileye_status.parquet").exists()


def test_file_names_of_topics_are_unique_and_stay_in_the_folder() -> None:
    taken: set[str] = set()
    for topic in (
        "/a/b",
        "/a_b",
        "a b",
        "/A/B",
        "/é",
        "/è",
        "..",
        ".",
        "../../etc/passwd",
        "x" * 999,
    ):
        name = table_file(topic, taken)
        assert name.lower() not in taken
        assert "/" not in name
        assert not name.startswith(".")
        assert len(name) < 120
        taken.add(name.lower())
