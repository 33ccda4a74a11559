"""ROS 2 bag folders: the files take precedence over metadata.yaml."""

import shutil
import sqlite3
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.rosbag_files import Row, by_topic, read_rows, rows_of, write_folder

Storage = Literal["sqlite3", "mcap"]
STORAGES: tuple[Storage, ...] = ("sqlite3", "mcap")


def folder_of_parts(folder: Path, *parts: list[Row], storage: Storage = "sqlite3") -> Path:
    """Write a folder whose storage files ``part_0``, ``part_1``, ... have the rows of each part."""
    folder.mkdir()
    suffix = "db3" if storage == "sqlite3" else "mcap"
    for i, rows in enumerate(parts):
        made = write_folder(folder.parent / f"{folder.name}_{i}", rows, storage)
        next(made.glob(f"*.{suffix}")).rename(folder / f"part_{i}.{suffix}")
    return folder


def write_metadata(folder: Path, *names: str, counts: dict[str, int] | None = None) -> None:
    """Write a metadata.yaml that lists ``names``, with message counts by topic."""
    files = "".join(f"  - {name}\n" for name in names)
    topics = "".join(
        f"  - topic_metadata: {{name: {name}, type: std_msgs/msg/String, serialization_format: cdr,"
        f" offered_qos_profiles: ''}}\n    message_count: {count}\n"
        for name, count in (counts or {}).items()
    )
    (folder / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n"
        f"  relative_file_paths:\n{files}  topics_with_message_count:\n{topics}"
    )


def count_by_topic(rows: list[Row]) -> dict[str, int]:
    return dict(Counter(row.topic for row in rows))


@pytest.mark.parametrize("storage", STORAGES)
@pytest.mark.parametrize("compression", ["none", "file", "message"])
def test_every_kind_of_folder_is_read_completely(
    tmp_path: Path, storage: Storage, compression: Literal["none", "file", "message"]
) -> None:
    rows = rows_of(600)
    reading = read_rows(write_folder(tmp_path / "bag", rows, storage, compression))

    assert by_topic(reading.rows) == by_topic(rows)
    assert reading.ledger.is_whole
    # SQLite counts nothing by itself, and opening reads the topics only.
    declared = dict.fromkeys(count_by_topic(rows)) if storage == "sqlite3" else count_by_topic(rows)
    assert {t.name: t.declared for t in reading.log.topics} == declared
    assert any("decompressed to" in notice for notice in reading.ledger.notices) == (
        compression == "file"
    )


@pytest.mark.slow
@settings(max_examples=8)
@given(cuts=st.lists(st.integers(0, 300), min_size=2, max_size=4), seed=st.integers(0, 99))
def test_rows_split_over_files_are_read_in_order(
    tmp_path_factory: pytest.TempPathFactory, cuts: list[int], seed: int
) -> None:
    rows = rows_of(300, seed)
    edges = sorted({0, 300, *cuts})
    parts = [rows[a:b] for a, b in pairwise(edges)]
    overlapping = [part[i::2] for part in parts for i in (0, 1)]
    folder = folder_of_parts(
        tmp_path_factory.mktemp("split") / "bag", *[p for p in overlapping if p]
    )

    assert by_topic(read_rows(folder).rows) == by_topic(rows)


@pytest.mark.parametrize("reason", ["storage file is missing", "storage file cannot be opened"])
def test_messages_of_missing_or_unreadable_listed_file_are_dropped_by_topic(
    tmp_path: Path, reason: str
) -> None:
    rows = rows_of(300)
    folder = folder_of_parts(tmp_path / "bag", rows[:100], rows[100:])
    write_metadata(folder, "part_0.db3", "part_1.db3", counts=count_by_topic(rows))
    (folder / "part_1.db3").unlink()
    if "missing" not in reason:
        (folder / "part_1.db3").write_bytes(b"nothing of the kind")

    reading = read_rows(folder)

    assert by_topic(reading.rows) == by_topic(rows[:100])
    dropped = {name: a.dropped[reason] for name, a in reading.ledger.accounts.items()}
    assert {name: count for name, count in dropped.items() if count} == count_by_topic(rows[100:])
    for name, count in count_by_topic(rows).items():
        assert reading.ledger.topic(name).in_file == count
    assert any("part_1.db3" in sentence for sentence in reading.ledger.notices)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[" * 50_000,
        "a: &a [x]\nb: [*a, *a]\n",
        "rosbag2_bagfile_information: 7\n",
        "rosbag2_bagfile_information: {relative_file_paths: 3, files: [1, {path: 5}]}\n",
        "rosbag2_bagfile_information:\n  relative_file_paths: [../../etc/passwd]\n",
        "!!python/object/apply:os.system [exit]\n",
        "\x00\x01",
        "k: " + "9" * 5000 + "\n",
        "x" * 2_000_000,
    ],
)
def test_invalid_metadata_does_not_stop_reading(tmp_path: Path, text: str) -> None:
    rows = rows_of(60)
    folder = folder_of_parts(tmp_path / "bag", rows)
    (folder / "metadata.yaml").write_text(text)
    reading = read_rows(folder)

    assert by_topic(reading.rows) == by_topic(rows)
    assert reading.ledger.notices


def test_compressed_file_and_its_decompressed_copy_are_read_once(tmp_path: Path) -> None:
    rows = rows_of(100)
    folder = write_folder(tmp_path / "bag", rows, compression="file")
    plain = write_folder(tmp_path / "plain", rows)
    shutil.copy(next(plain.glob("*.db3")), folder / "bag.db3")
    reading = read_rows(folder)

    assert by_topic(reading.rows) == by_topic(rows)
    assert any("it was not read" in sentence for sentence in reading.ledger.notices)


@pytest.mark.parametrize("storage", STORAGES)
def test_truncated_compressed_file_yields_readable_part(tmp_path: Path, storage: Storage) -> None:
    rows = rows_of(4000)
    folder = write_folder(tmp_path / "bag", rows, storage, compression="file")
    path = next(folder.glob("*.zstd"))
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    reading = read_rows(folder)

    assert len(reading.rows) > 1000 or storage == "mcap"
    assert not Counter(reading.rows) - Counter(rows)
    assert not reading.ledger.is_whole
    dropped = sum(a.dropped.total() for n, a in reading.ledger.accounts.items())
    assert dropped == len(rows) - len(reading.rows)


def test_same_recording_in_two_formats_is_read_once(tmp_path: Path) -> None:
    rows = rows_of(100)
    folder = folder_of_parts(tmp_path / "bag", rows)
    other = write_folder(tmp_path / "other", rows, "mcap")
    shutil.copy(next(other.glob("*.mcap")), folder / "part_0.mcap")
    write_metadata(folder, "part_0.db3")
    reading = read_rows(folder)

    assert by_topic(reading.rows) == by_topic(rows)
    assert any("in another format" in sentence for sentence in reading.ledger.notices)


def test_two_types_on_one_topic_are_not_mixed(tmp_path: Path) -> None:
    rows = rows_of(100)
    folder = folder_of_parts(tmp_path / "bag", rows[:50], rows[50:])
    with sqlite3.connect(folder / "part_1.db3") as db:
        db.execute("UPDATE topics SET type = 'std_msgs/msg/Int8' WHERE name = '/can'")
    db.close()
    reading = read_rows(folder)
    odd = count_by_topic(rows[50:])["/can"]

    assert reading.ledger.topic("/can").skipped == {"another message type on the same topic": odd}
