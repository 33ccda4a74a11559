"""Labelled boxes in four formats, and tables in CSV: what is read, and what is refused."""

import json
from collections import Counter
from pathlib import Path

import pytest

from crosscue.datasets.truth.box_labels import boxes_inside, read_box_labels
from crosscue.datasets.truth.csv_rows import csv_rows
from crosscue.replay.errors import AnnotationError, UsageError
from support.trees import written


def coco(folder: Path) -> Path:
    tree = {
        "categories": [{"id": 1, "name": "car"}, {"id": 2, "name": "bus"}],
        "images": [{"id": 0, "file_name": "7.png", "width": 100, "height": 80}],
        "annotations": [
            {"id": 1, "image_id": 0, "category_id": 1, "bbox": [10, 20, 40, 40], "range_m": 12.5},
            {"id": 2, "image_id": 0, "category_id": 2, "bbox": [60, 0, 40, 80], "iscrowd": 1},
        ],
    }
    (folder / "coco.json").write_text(json.dumps(tree))
    return folder / "coco.json"


def yolo(folder: Path) -> Path:
    (folder / "data.yaml").write_text("names:\n  1: bus\n  0: car\n")
    (folder / "7.txt").write_text("0 0.3 0.5 0.4 0.5\n")
    return folder


def voc(folder: Path) -> Path:
    (folder / "7.xml").write_text(
        "<annotation><filename>7.png</filename><size><width>100</width><height>80</height></size>"
        "<object><name>car</name><difficult>0</difficult><part><name>wheel</name></part><bndbox>"
        "<xmin>11</xmin><ymin>21</ymin><xmax>50</xmax><ymax>60</ymax></bndbox></object>"
        "<object><name>bus</name><difficult>1</difficult><bndbox><xmin>61</xmin><ymin>1</ymin>"
        "<xmax>100</xmax><ymax>80</ymax></bndbox></object></annotation>"
    )
    return folder


def kitti(folder: Path) -> Path:
    (folder / "000007.txt").write_text(
        "car 0.00 0 -1.5 10 20 50 60 1.5 1.6 3.9 1.0 1.7 12.5 -1.6\n"
        "DontCare -1 -1 -10 60 0 100 80 -1 -1 -1 -1000 -1000 -1000 -10\n"
    )
    return folder


FORMATS = {"coco": coco, "yolo": yolo, "voc": voc, "kitti": kitti}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_yields_same_box(name: str, tmp_path: Path) -> None:
    found = read_box_labels(FORMATS[name](tmp_path))

    (picture,) = found.pictures
    car, *regions = boxes_inside(picture, (100, 80), Counter())
    assert found.format == name
    assert "car" in found.labels
    assert (car.label, car.is_crowd) == ("car", False)
    assert car.box_px == pytest.approx((10.0, 20.0, 50.0, 60.0))
    assert [one.is_crowd for one in regions] == ([] if name == "yolo" else [True])
    assert car.range_m == (12.5 if name in ("coco", "kitti") else None)


CAR = {"classes.txt": "car"}


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"7.txt": "0 .5 .5 .1 .1"}, "--class-names FILE"),
        ({"7.txt": "car 0 0 0 1 2"}, "7.txt:1: 6 columns; expected KITTI"),
        ({"7.txt": "1 .5 .5 .1 .1"} | CAR, "7.txt:1: class 1, but"),
        ({"7.txt": "0 .5 .5 .1"} | CAR, "7.txt:1: expected a class"),
        ({"7.txt": "0 .5 .5 x .1"} | CAR, "expected numbers"),
        ({"7.txt": "", "data.yaml": "path: x"}, "class names under names"),
        ({"7.txt": "", "data.yaml": "names: " + "[" * 9000}, "class names under"),
        ({"7.txt": "", "data.yaml": "a: &a [x, x]\nnames: [*a, *a]"}, "class names under names"),
        ({"7.txt": "car" + " 1" * 14 + "\nbus 1 2"}, "7.txt:2: 3 columns"),
        ({"7.xml": "<!DOCTYPE a [<!ENTITY b 'c'>]><annotation/>"}, "document type"),
        ({"7.xml": "<annotation>"}, "not XML"),
        ({"7.xml": "<html/>"}, "no <annotation>"),
        ({"7.xml": "<annotation><object><name>a</name></object></annotation>"}, "expected bndbox"),
        ({"7.jpg": ""}, "no labels of boxes"),
        ({}, "no labels of boxes"),
    ],
)
def test_unreadable_labels_are_refused_in_one_line(
    files: dict[str, str], message: str, tmp_path: Path
) -> None:
    for name, text in files.items():
        (tmp_path / name).write_text(text)

    error = UsageError if message.startswith("--") else AnnotationError
    with pytest.raises(error) as raised:
        read_box_labels(tmp_path)

    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_rows_have_their_place_also_after_a_byte_order_mark(tmp_path: Path) -> None:
    table = written(tmp_path / "table.csv", "t_ns,range_m\n1,2.5\n3,4.5\n".encode("utf-8-sig"))

    assert list(csv_rows(table, "t_ns,range_m")) == [
        (f"{table}:2", {"t_ns": "1", "range_m": "2.5"}),
        (f"{table}:3", {"t_ns": "3", "range_m": "4.5"}),
    ]


def test_table_without_a_column_is_refused_with_those_it_has(tmp_path: Path) -> None:
    table = written(tmp_path / "table.csv", "t_ns,length_m\n1,2\n")

    with pytest.raises(
        AnnotationError, match=r"table\.csv:1: expected columns t_ns,range_m, got t_ns,length_m"
    ):
        list(csv_rows(table, "t_ns,range_m"))
