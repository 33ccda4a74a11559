"""Readers, data sets and formats of labels fulfil their contracts."""

import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
import pytest

from crosscue.datasets.labels.table import LABEL_FORMATS, ToolFormat, read_tool_labels
from crosscue.datasets.truth.annotations import Annotation, Annotations, Picture, time_in_name
from crosscue.datasets.truth.truth import CARRIED
from crosscue.replay.errors import CrosscueError, LogFormatError
from crosscue.replay.formats import FORMATS
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.testing import check_dataset, check_reader
from support.every_format import EVERY_FORMAT
from support.kitti_drive import kitti_odometry_drive, raw_drive
from support.mcap_files import MAGIC, McapFile, channel, message, schema
from support.nuscenes_drive import nuscenes_drive
from support.one_row import ONE_ROW
from support.pandaset_drive import pandaset_drive

WITHOUT_SINGLE_ROW_DAMAGE: Final = {
    "mf4": "records have a fixed size and no mark or checksum: a damaged one cannot be reported",
    "comma2k19": "an .npy array has neither: a damaged number is another number",
    "kitti-raw": "a row is a line in each of several files",
    "video": "a damaged packet is found when it is decoded, and may take others with it",
}


def test_every_format_is_classified() -> None:
    assert EVERY_FORMAT.keys() == FORMATS.keys()
    assert ONE_ROW.keys() | WITHOUT_SINGLE_ROW_DAMAGE.keys() == FORMATS.keys()


@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
def test_every_reader_fulfils_contract(name: str, tmp_path: Path) -> None:
    check_reader(EVERY_FORMAT[name](tmp_path), is_in_order=name != "video")


@pytest.mark.parametrize("name", sorted(ONE_ROW))
def test_damaged_row_is_counted_as_one_dropped_row(name: str, tmp_path: Path) -> None:
    write, damage = ONE_ROW[name]

    check_reader(write(tmp_path), damage)


# Contents that no reader accepts, and words of the refusal, by the name of the file.
UNSUPPORTED: Final = {
    "a.blf": ((b"", "empty"), (b"LOGG", "no BLF header"), (bytes(500), "no BLF header")),
    "a.mf4": (
        (b"", "empty file"),
        (b"PK\x03\x04" + bytes(100), "not an MDF file"),
        (b"MDF     3.30    " + bytes(100), "version '3.30'"),
        (b"MDF     4.10    " + bytes(100), "header damaged"),
    ),
    "a.bag": (
        (b"", "begins with b''"),
        (b"#ROSBAG V1.2\n", "rosbag fix"),
        (b"#ROSBAG V2.0\n", "no readable record"),
        (b"PK\x03\x04", "format 2.0"),
    ),
    "a.db3": (
        (b"", "begins with b''"),
        (b"SQLite format 2", "SQLite format 3"),
        (bytes(999), "SQLite"),
    ),
    "a.mcap": (
        (b"", "an empty file"),
        (MAGIC[:5], "not an MCAP file"),
        (b"#ROSBAG V2.0\n" + bytes(100), "not an MCAP file"),
        (MAGIC, "no readable record"),
        (MAGIC + b"\x01\xff", "no readable record"),
        (MAGIC + bytes(500), "no readable record"),
    ),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_unsupported_file_is_refused_in_one_line_and_closed(name: str, tmp_path: Path) -> None:
    for content, words in UNSUPPORTED[name]:
        (tmp_path / name).write_bytes(content)
        before = len(list(Path("/proc/self/fd").iterdir()))

        with pytest.raises(LogFormatError, match=words) as refused:
            open_log(tmp_path / name)

        assert "\n" not in str(refused.value)
        assert str(tmp_path / name) in str(refused.value)
        assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_damaged_row_counted_in_statistics_is_dropped_once(tmp_path: Path) -> None:
    messages = [message(1, 10 * i, b"%4d" % i) for i in range(20)]
    intact = McapFile([schema(1), channel(1, 1, "/a"), *messages]).coded()
    log = tmp_path / "log.mcap"
    at = intact.index(messages[7])
    log.write_bytes(intact[: at + 9] + b"\x4d\0" + intact[at + 11 :])

    ledger = Ledger(str(log))
    with open_log(log) as opened:
        rows = sum(len(block) for block in opened.read(ledger))

    assert rows == 19
    assert ledger.topic("/a").dropped.total() == 1
    assert ledger.topic("").dropped.total() == 0
    (drop,) = ledger.drops()
    assert drop.topic == "/a"
    assert "bytes" in drop.detail


def _comma(path: Path) -> Path:
    """Write a segment of ten seconds along a straight road near Paris, with its speed."""
    times = np.arange(200) * 0.05
    east = np.outer(20.0 * times, (-0.0406, 0.9992, 0.0))
    arrays = {
        "processed_log/CAN/speed/t": times,
        "processed_log/CAN/speed/value": np.full((200, 1), 20.0),
        "global_pose/frame_times": times,
        "global_pose/frame_positions": np.array((4_201_000.0, 171_000.0, 4_780_000.0)) + east,
        "global_pose/frame_velocities": np.gradient(east, 0.05, axis=0),
        "global_pose/frame_orientations": np.tile((1.0, 0.0, 0.0, 0.0), (200, 1)),
        "global_pose/frame_gps_times": np.stack([np.full(200, 2000.0), times], axis=1),
    }
    for name, rows in arrays.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        with (path / name).open("wb") as file:
            np.save(file, rows)
    return path


# By format: a function that writes a small drive.
DRIVES: Final[dict[str, Callable[[Path], Path]]] = {
    "comma2k19": _comma,
    "kitti-raw": raw_drive,
    "kitti-odometry": kitti_odometry_drive,
    "nuscenes": nuscenes_drive,
    "pandaset": pandaset_drive,
}


def test_every_data_set_has_sample_drive() -> None:
    assert DRIVES.keys() == CARRIED.keys()


@pytest.mark.parametrize("name", sorted(CARRIED))
def test_every_data_set_fulfils_contract(name: str, tmp_path: Path) -> None:
    check_dataset(DRIVES[name](tmp_path / "drive"), tmp_path / "truth")


T_NS: Final = 1_700_000_000_123_456_789
SIZE: Final = (1280, 719)


def labels() -> Annotations:
    """Boxes at edges and between pixels, a label that needs escaping, a picture without boxes."""
    names = ("stop sign", 'a "car" & <more>: #1')
    things = (
        Annotation(names[0], (0.0, 0.0, 1280.0, 719.0), score=0.25),
        Annotation(names[1], (10.125, 20.5, 11.375, 700.0625), score=1.0),
    )
    pictures = (
        Picture(f"A-01_{T_NS}ns.jpg", SIZE, T_NS, None, things),
        Picture("A-01_5000000000ns.jpg", SIZE, 5_000_000_000, None, ()),
    )
    return Annotations("worst.parquet", names, pictures)


def times(read: Annotations) -> dict[int, Picture]:
    found = {}
    for one in read.pictures:
        t_ns = one.t_ns if one.t_ns is not None else time_in_name(Path(one.name).stem)
        assert t_ns is not None
        found[t_ns] = one
    return found


@pytest.mark.parametrize("name", LABEL_FORMATS)
@pytest.mark.parametrize("is_named", [True, False], ids=["format named", "recognised"])
def test_written_labels_are_read_back_unchanged(
    name: ToolFormat, is_named: bool, tmp_path: Path
) -> None:
    wrote = labels()
    path = LABEL_FORMATS[name].write(tmp_path, wrote)

    sizes = {Path(one.name).stem: one.size_px for one in wrote.pictures}
    read = read_tool_labels(path, sizes, name if is_named else None)

    assert times(read).keys() == {T_NS, 5_000_000_000}
    for one in wrote.pictures:
        assert one.t_ns is not None
        same = times(read)[one.t_ns]
        assert same.size_px == one.size_px
        assert [thing.label for thing in same.things] == [thing.label for thing in one.things]
        for thing, was in zip(same.things, one.things, strict=True):
            assert thing.box_px == pytest.approx(was.box_px, abs=1e-6)
    assert {*read.labels} >= {thing.label for one in wrote.pictures for thing in one.things}


@pytest.mark.parametrize("name", LABEL_FORMATS)
@pytest.mark.parametrize("content", [b"{", b"[1]", b'{"labels": 3}', b"<a", b"\xff\xfe"])
def test_damaged_labels_are_refused_with_file_name(
    name: ToolFormat, content: bytes, tmp_path: Path
) -> None:
    path = LABEL_FORMATS[name].write(tmp_path, labels())
    path.write_bytes(content)
    for text in tmp_path.glob("labels/*.txt"):
        text.write_bytes(content)

    with pytest.raises(CrosscueError, match=r"^[^\n]*$") as caught:
        read_tool_labels(path, {"*": SIZE}, name)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("place", "names"),
    [
        ("labels/val", {"dataset.yaml": "names: [stop sign, car]\nval: ./images/val/\n"}),
        ("labels/train", {"data.yaml": "names: {0: stop sign, 1: car}\n", "train.txt": "a.jpg\n"}),
        ("obj_train_data", {"obj.names": "stop sign\ncar\n", "train.txt": "a.jpg\n"}),
    ],
    ids=["FiftyOne", "CVAT, Ultralytics", "CVAT, Darknet"],
)
def test_yolo_labels_are_read_in_layouts_of_common_tools(
    place: str, names: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / place).mkdir(parents=True)
    (tmp_path / place / "a.txt").write_text("1 0.5 0.5 0.5 0.5\n")
    for name, text in names.items():
        (tmp_path / name).write_text(text)

    (picture,) = read_tool_labels(tmp_path, {"a": (100, 80)}).pictures
    assert [(one.label, one.box_px) for one in picture.things] == [("car", (25, 20, 75, 60))]


def test_coco_file_is_readable_by_pycocotools(tmp_path: Path) -> None:
    tools = pytest.importorskip("pycocotools.coco")
    tree = tools.COCO(str(LABEL_FORMATS["coco"].write(tmp_path, labels())))

    boxes = tree.loadAnns(tree.getAnnIds())
    assert boxes[0]["bbox"] == [0.0, 0.0, 1280.0, 719.0]
    assert boxes[1]["bbox"] == [10.125, 20.5, 1.25, 679.5625]
    assert [one["name"] for one in tree.loadCats(tree.getCatIds())] == list(labels().labels)


@pytest.mark.parametrize("name", LABEL_FORMATS)
def test_export_above_the_limit_is_refused_before_it_is_read(
    name: ToolFormat, tmp_path: Path
) -> None:
    path = LABEL_FORMATS[name].write(tmp_path, labels())
    files = [path] if path.is_file() else [*path.rglob("*.json")]
    for file in [*files, *tmp_path.glob("labels/*.txt")]:
        os.truncate(file, (512 << 20) + 1)

    tracemalloc.start()
    with pytest.raises(
        CrosscueError, match=r"^[^\n]*(over \d+ MiB|more than 536,870,912 bytes)[^\n]*$"
    ):
        read_tool_labels(path, {"*": SIZE}, name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 64 << 20
