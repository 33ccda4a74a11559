"""Drives opened with ``crosscue.open``: tables, frames, signals and losses."""

import json
import warnings
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

import crosscue
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval.logs.log import _views
from crosscue.replay.columns import Messages
from support.every_format import EVERY_FORMAT


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    return write_drive(tmp_path_factory.mktemp("drive"), DriveSettings(seed=3, blocks=1))


def test_topics_are_printed_as_a_table(drive: DriveFiles) -> None:
    with crosscue.open(drive.log) as log:
        head, *lines = repr(log.topics).splitlines()

        assert head.split() == ["topic", "type", "encoding", "count"]
        assert [line.split()[0] for line in lines] == list(log.topics)
        assert "/can" in log.topics
        assert log["/can"].type_name in repr(log["/can"])


@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
def test_each_format_yields_tables_or_frames(name: str, tmp_path: Path) -> None:
    rows = 0
    with (
        warnings.catch_warnings(record=True) as warned,
        crosscue.open(EVERY_FORMAT[name](tmp_path)) as log,
    ):
        warnings.simplefilter("always", crosscue.LossWarning)
        for topic in log.topics.values():
            if "mage" in topic.type_name:
                rows += sum(frame.rgb.shape[2] == 3 for frame in topic.frames())
                continue
            table = topic.table()
            (reported,) = json.loads(table.schema.metadata[b"crosscue"]).values()
            assert len(table) == reported["used"] == sum(map(len, topic.batches()))
            assert table.column_names[0] == "log_t_ns"
            rows += len(table)
    assert rows or warned


@pytest.mark.parametrize("sizes", [(0, 1, 4, 11, 12, 13, 40), (13, 20), (12,), ()])
def test_pictures_of_any_size_are_views_of_their_bytes(sizes: tuple[int, ...]) -> None:
    buffer = np.arange(100, dtype=np.uint8)
    start = np.arange(len(sizes), dtype=np.int64) * 7 + 3
    messages = Messages(buffer, start, start + np.array(sizes, np.int64))

    views = _views(messages)

    assert views.to_pylist() == [
        buffer[i : i + n].tobytes() for i, n in zip(start, sizes, strict=True)
    ]


@pytest.mark.filterwarnings("ignore::crosscue.LossWarning")
@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
def test_batches_of_a_log_are_the_tables_of_its_topics(name: str, tmp_path: Path) -> None:
    with crosscue.open(EVERY_FORMAT[name](tmp_path)) as log:
        batches: dict[str, list[pa.RecordBatch]] = {}
        for topic, batch in log.batches():
            batches.setdefault(topic, []).append(batch)
        for topic, parts in batches.items():
            found = pa.Table.from_batches(parts)
            if "coding" in found.column_names:
                assert len(found) == sum(1 for _ in log[topic].frames())
            else:
                assert found.equals(log[topic].table())


def test_time_spans_are_half_open_and_intersect(drive: DriveFiles) -> None:
    with crosscue.open(drive.log) as log:
        name = next(n for n in log.topics if n != "/can")
        recorded = log[name].table()["log_t_ns"].to_numpy()
        zero = min(log[one].table()["log_t_ns"].to_numpy().min() for one in log.topics)
        selected = log[name].table(start_s=1, end_s=2)["log_t_ns"].to_numpy()
        parts = log.part(end_s=2)[name].table(start_s=1)["log_t_ns"].to_numpy()

        inside = (recorded >= zero + 1_000_000_000) & (recorded < zero + 2_000_000_000)
        np.testing.assert_array_equal(selected, recorded[inside])
        np.testing.assert_array_equal(parts, selected)
        with pytest.raises(crosscue.UsageError, match="not after start_s"):
            log.part(start_s=2, end_s=2)
        with pytest.raises(crosscue.UsageError, match="seconds after"):
            log.part(start_s=float("nan"))


def test_signals_are_tables_by_message_with_units(drive: DriveFiles) -> None:
    dbc = next(drive.vehicle.parent.glob("*.dbc"))
    with crosscue.open(drive.log) as log:
        signals = log.signals(dbc)
        frames = log["/can"].table()

        assert "message" in repr(signals).splitlines()[0]
        name = next(iter(signals))
        units = {field.name: field.metadata for field in signals[name].schema}
        assert any(one and one.get(b"unit") for one in units.values())
        assert len(frames) >= max(map(len, signals.values()))
        assert [*log.signals(dbc, messages=[name])] == [name]
        with pytest.raises(crosscue.UsageError, match="messages"):
            log.signals(dbc, messages=["NOT_THERE"])
        with pytest.raises(crosscue.errors.MissingTopicError, match="did you mean"):
            signals[name + "x"]


def test_losses_raise_warning_and_are_recorded_in_table_metadata(
    tmp_path: Path, drive: DriveFiles
) -> None:
    cut = tmp_path / "cut.mcap"
    recorded = drive.log.read_bytes()
    cut.write_bytes(recorded[: len(recorded) // 2])

    with crosscue.open(cut) as log, pytest.warns(crosscue.LossWarning) as caught:
        table = log["/can"].table()

    # At the user's line, and about nothing that the user did not read.
    assert {Path(one.filename).name for one in caught} == {Path(__file__).name}
    about = [str(one.message).removeprefix(f"{cut}: ") for one in caught]
    assert all(text.startswith(("/can: ", "unknown topics: ")) for text in about)

    reported = json.loads(table.schema.metadata[b"crosscue"])[str(cut)]
    assert reported["used"] == len(table)
    lost = (reported, reported["unattributed"])
    assert any(one["dropped"] or one["dropped_unknown"] for one in lost)


@pytest.mark.parametrize(
    ("paths", "error"),
    [
        ((), crosscue.UsageError),
        (("gone.mcap",), crosscue.LogError),
        (("x.unknown",), crosscue.errors.UnknownFormatError),
    ],
)
def test_unreadable_paths_raise_crosscue_errors(
    paths: tuple[str, ...], error: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("x.unknown").write_bytes(b"?")

    with pytest.raises(error):
        crosscue.open(*paths)
