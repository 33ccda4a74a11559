"""``crosscue decode``: every stream as a Parquet file, every frame accounted for."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from crosscue.eval import cli
from crosscue.eval.catalog.decoded_logs import decode_tables, table_file
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block, Messages, Table, Topic
from crosscue.replay.mobileye.can.encode import bursts_of, encode_tables
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.settings import MobileyeSettings
from crosscue.replay.vehicle.vehicle import Mobileye, Vehicle
from support.data import shared
from support.gap_drive import BEGIN, ROW, Clock, write_drive
from support.memory_log import MemoryLog, wheel_block

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


def _tables(path: Path, topics: Sequence[Topic], blocks: list[Block], vehicle: Vehicle) -> Path:
    log = MemoryLog(tuple(topics), blocks, path=Path(__file__))
    decode_tables([log], vehicle, create(path, overwrite=False), EVERYTHING)
    return path


def test_mobileye_frames_decode_to_obstacles_relative_to_rear_axle(tmp_path: Path) -> None:
    vehicle = Vehicle(version=1, mobileye=Mobileye(bus="eye", x_m=2.0))

    folder = _tables(tmp_path / "out", [EYE], _mobileye_drive(), vehicle)

    table = pq.read_table(folder / "eye_mobileye_obstacles.parquet")
    np.testing.assert_allclose(table["x_m"], 80.0 - np.arange(30), atol=1 / 32)
    np.testing.assert_allclose(table["y_m"], 2.0, atol=1 / 32)
    assert (folder / "eye_mobileye_status.parquet").exists()


def test_unsupported_topics_are_counted_as_skipped(tmp_path: Path) -> None:
    odd = Topic("odd", "acme/msg/Secret", "morse")
    rows = Messages(np.zeros(8, np.uint8), np.array([0, 4]), np.array([4, 8]))
    block = Block("odd", np.array([1, 2], np.int64), rows)
    wheels = Topic("wheels", "crosscue/WheelSpeeds", "columns")
    blocks = [block, wheel_block([3], [1.0]), *_mobileye_drive()]
    log = MemoryLog((odd, wheels, EYE), blocks, path=Path(__file__))

    done = decode_tables(
        [log], Vehicle(version=1), create(tmp_path / "out", overwrite=False), EVERYTHING
    )

    assert done.rows == {"wheels.parquet": 1}
    topics = done.account.reading[0].topics
    assert topics["odd"].skipped == {"type not understood": 2}
    assert topics["eye"].used == 0


@pytest.mark.parametrize("by_s", [-7.0, 0.0, 30.0])
def test_decoded_tables_record_segment_and_log_time(
    tmp_path: Path, by_s: float, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_drive(tmp_path, Clock(set_at_s=6.0, by_s=by_s))
    out = tmp_path / "out"
    car = str(tmp_path / "car.toml")

    status = cli.run(["decode", str(log), "--vehicle", car, "-o", str(out), "--json"])

    reported = json.loads(capsys.readouterr().out)
    assert status == (3 if by_s else 0)
    assert len(reported["time"]["segments"]) == (2 if by_s else 1)
    speed = pq.read_table(out / "can_WHEEL_SPEEDS.parquet")
    recorded = Clock(set_at_s=6.0, by_s=by_s).recorded(np.arange(140) * ROW + BEGIN)[1]
    assert speed["log_t_ns"].to_pylist() == recorded.tolist()
    assert np.all(np.diff(speed["t_ns"].to_numpy()) > 0)
    assert speed["segment"].to_pylist() == [0] * 60 + [1 if by_s else 0] * 80
    skipped = RunFolder(out).table("skipped").to_pylist()
    for name, topic in reported["account"]["reading"][0]["topics"].items():
        counts = [topic["used"], *topic["skipped"].values(), *topic["dropped"].values()]
        assert topic["in"] == sum(counts)
        rows = [row["count"] for row in skipped if row["topic"] == name]
        assert sum(rows) == topic["in"] - topic["used"]
    assert any(row["reason"] == "pictures are not tables" for row in skipped)


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


def test_recorded_ford_bus_decodes_to_plausible_wheel_speeds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = shared("can", "ford_fusion_2017")
    log = next(folder.glob("*.candump"))
    car = tmp_path / "car.toml"
    dbc = folder / "ford_lincoln_base_pt.dbc"
    car.write_text(f'version = 1\n[can]\ndbc = ["{dbc}"]\n')

    assert cli.run(["decode", str(log), "--vehicle", str(car), "-o", str(tmp_path / "out")]) == 0

    assert "id not in the database" in capsys.readouterr().out
    speed = pq.read_table(tmp_path / "out" / "can0_WheelSpeed.parquet")
    # 28 to 76 km/h, as recorded, on tyres of about 0.33 m.
    assert 8.0 < np.mean(speed["WhlRl_W_Meas"].to_numpy()) * 0.33 < 22.0
