"""Formats of labelling tools preserve boxes, labels and times when written and read."""

import os
import tracemalloc
from pathlib import Path
from typing import Final

import pytest

from crosscue.datasets.labels.table import LABEL_FORMATS, ToolFormat, read_tool_labels
from crosscue.datasets.truth.annotations import Annotation, Annotations, Picture, time_in_name
from crosscue.replay.errors import CrosscueError

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
