"""COCO and CVAT annotations and a plug-in's truth, and the check of a truth against its log."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from crosscue.datasets.truth import truth as truth_file
from crosscue.datasets.truth.label_xml import read_cvat
from crosscue.datasets.truth.truth import read_truth
from crosscue.eval import cli
from crosscue.replay.errors import AnnotationError, SchemaError
from crosscue.replay.formats import DataSet, Format
from support.refusals import refusal
from support.trees import written

WIDE, HIGH = 64, 36
START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
FRAMES = 6


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write six pictures at 10 Hz."""
    folder = tmp_path_factory.mktemp("log")
    for number in range(FRAMES):
        cv2.imwrite(str(folder / f"{number:06d}.png"), np.zeros((HIGH, WIDE, 3), np.uint8))
    times = [f"{(START_NS + i * STEP_NS) / 1e9:.1f}" for i in range(FRAMES)]
    (folder / "timestamps.txt").write_text("\n".join(times) + "\n")
    return folder


def coco(**changes: Any) -> dict[str, Any]:
    """Return annotations of frames 1 and 3: a stop sign in frame 1 and a car in each."""
    tree: dict[str, Any] = {
        "images": [
            {"id": n, "file_name": f"{n:06d}.png", "width": WIDE, "height": HIGH} for n in (1, 3)
        ],
        "categories": [{"id": 13, "name": "stop sign"}, {"id": 3, "name": "car"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 13, "bbox": [5, 5, 10, 10], "visible": 0.5},
            {"id": 2, "image_id": 1, "category_id": 3, "bbox": [20, 5, 30.5, 10]},
            {"id": 3, "image_id": 3, "category_id": 3, "bbox": [20, 5, 30.5, 10]},
        ],
    }
    return tree | changes


def _write(path: Path, tree: object) -> Path:
    path.write_text(json.dumps(tree))
    return path


def _import(source: Path, log: Path, output: Path, *more: str) -> int:
    argv = ["truth", "import", str(source), "--log", str(log), "-o", str(output), *more, "-q"]
    return cli.run(argv)


def _refused(status: int, source: Path, log: Path, output: Path, *more: str) -> str:
    return refusal(status, "truth", "import", source, "--log", log, "-o", output, *more, "-q")


def test_coco_import_writes_present_and_absent_cues(tmp_path: Path, log: Path) -> None:
    assert _import(_write(tmp_path / "coco.json", coco()), log, tmp_path / "truth.json") == 0

    truth = read_truth(tmp_path / "truth.json")
    assert [(one.cue, one.t_ns, one.present, one.count, one.visible) for one in truth.cues] == [
        ("stop_sign", START_NS + STEP_NS, True, 1, 0.5),
        ("stop_sign", START_NS + 3 * STEP_NS, False, 0, None),
    ]
    objects = json.loads((tmp_path / "objects.json").read_text())
    assert [image["t_ns"] for image in objects["images"]] == [one.t_ns for one in truth.cues]
    assert objects["annotations"][1]["bbox"] == [20, 5, 30.5, 10]
    assert cli.run(["check", str(tmp_path), str(log), "-q"]) == 0


def pictures(*names: str, **more: object) -> list[dict[str, object]]:
    """Return rows of pictures of the log's size, numbered 1, 3, ..."""
    size = {"width": WIDE, "height": HIGH}
    return [{"id": 1 + 2 * k, "file_name": name, **size, **more} for k, name in enumerate(names)]


def one_box(image: object, category: int, bbox: list[float | None]) -> dict[str, Any]:
    return {"annotations": [{"image_id": image, "category_id": category, "bbox": bbox}]}


NO_BOX: dict[str, Any] = {"annotations": []}
CAR: dict[str, Any] = {"id": 3, "name": "car"}
# Changes of the annotations, the message and the exit status: 4 for faults of the file alone.
FAULTS: list[tuple[dict[str, Any], str, int]] = [
    ({"images": pictures("a.png")} | NO_BOX, "neither a time nor a frame", 1),
    ({"images": pictures("9.png")} | NO_BOX, "frame 9 of 6", 1),
    ({"images": pictures("1_1.png", "3_1.png")}, "belong to one frame", 1),
    ({"images": pictures("1.png", height=40)} | NO_BOX, "64 x 40 pixels", 1),
    ({"images": pictures("1.png", t_ns=5)} | NO_BOX, "near 5 ns", 1),
    ({"images": pictures("1.png", t_ns=1.5)} | NO_BOX, "expected whole nanoseconds", 4),
    ({"images": []}, "no such image", 4),
    ({"images": []} | NO_BOX, "no picture in it", 1),
    (one_box([1], 3, [1, 1, 1, 1]), "no such image", 4),
    (one_box(1, 4, [1, 1, 1, 1]), "no such category", 4),
    (one_box(1, 3, [60, 1, 9, 1]), "outside the picture", 1),
    (one_box(1, 3, [1, 1, 0, 1]), "has no area", 1),
    (one_box(1, 3, [1, 1, None, 1]), "four numbers", 4),
    ({"annotations": {}}, "expected a list", 4),
    ({"categories": [CAR, CAR | {"name": "b"}]} | NO_BOX, "expected a unique id", 4),
    ({"categories": [{"id": 13, "name": "stop sing"}, CAR]}, "--map 'stop sing=stop_sign'", 1),
    ({"categories": [{"id": 13, "name": "zebra"}, CAR]}, "'zebra' is neither", 1),
]


@pytest.mark.parametrize(("change", "message", "status"), FAULTS)
def test_invalid_or_mismatched_annotations_are_refused_in_one_line(
    tmp_path: Path, log: Path, change: dict[str, Any], message: str, status: int
) -> None:
    source = _write(tmp_path / "coco.json", coco(**change))

    assert message in _refused(status, source, log, tmp_path / "truth.json")
    assert not (tmp_path / "truth.json").exists()


def test_map_option_assigns_labels_to_cues(tmp_path: Path, log: Path) -> None:
    tree = coco(categories=[{"id": 13, "name": "halt = stop"}, {"id": 3, "name": "dog"}])
    source = _write(tmp_path / "coco.json", tree)

    assert _import(source, log, tmp_path / "t.json", "--map", "halt = stop=stop_sign", "dog=") == 0
    assert {one.cue for one in read_truth(tmp_path / "t.json").cues} == {"stop_sign"}
    assert cli.run(["check", str(tmp_path / "t.json"), str(log), "-q"]) == 0
    for own, message in (
        ("cat=stop_sign", "no such label"),
        ("dog=sing", "no such cue"),
        ("dog", "expected LABEL=NAME"),
    ):
        assert message in _refused(2, source, log, tmp_path / "u.json", "--map", own)


IMAGES_XML = f"""<?xml version="1.0" encoding="utf-8"?>
<annotations><version>1.1</version>
<meta><task><name>t</name><size>2</size><labels>
<label><name>stop sign</name>
<attributes><attribute><name>worn</name></attribute></attributes></label>
<label><name>road_left</name></label><label><name>car</name></label>
</labels></task></meta>
<image id="0" name="000001.png" width="{WIDE}" height="{HIGH}">
<box label="stop sign" occluded="0" xtl="5.00" ytl="5.00" xbr="15.00" ybr="15.00" z_order="0">
<attribute name="worn">false</attribute></box>
<polygon label="car" occluded="0" points="20,5;50.5,5;50.5,15" z_order="0"></polygon>
<polyline label="car" points="1,1;2,2"></polyline>
<tag label="road_left" source="manual"></tag>
</image>
<image id="1" name="000003.png" width="{WIDE}" height="{HIGH}">
<mask label="car" rle="3,5" left="2" top="3" width="4" height="2"></mask>
</image>
</annotations>"""


def test_cvat_for_images_is_imported(
    tmp_path: Path, log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.xml").write_text(IMAGES_XML)

    argv = ["truth", "import", str(tmp_path / "a.xml"), "--log", str(log), "-o", str(tmp_path)]
    assert cli.run(argv) == 0
    assert "ignored    1 polyline" in capsys.readouterr().out
    found = {(one.cue, one.t_ns): one.present for one in read_truth(tmp_path).cues}
    assert found == {
        ("stop_sign", START_NS + STEP_NS): True,
        ("road_left", START_NS + STEP_NS): True,
        ("stop_sign", START_NS + 3 * STEP_NS): False,
        ("road_left", START_NS + 3 * STEP_NS): False,
    }
    things = json.loads((tmp_path / "objects.json").read_text())["annotations"]
    assert [thing["bbox"] for thing in things] == [
        [5.0, 5.0, 10.0, 10.0],
        [20.0, 5.0, 30.5, 10.0],
        [2, 3, 4, 2],
    ]
    assert things[1]["segmentation"] == [[20.0, 5.0, 50.5, 5.0, 50.5, 15.0]]


BODY = IMAGES_XML.split("\n", 1)[1].replace("<name>t</name>", "<name>&z;&x;</name>")


def _video(boxes: str, meta: str = "<start_frame>1</start_frame><stop_frame>5</stop_frame>") -> str:
    return (
        f"<annotations><version>1.1</version><meta><task><size>3</size>{meta}"
        "<frame_filter>step=2</frame_filter><segments><segment><start>7</start></segment></segments>"
        f"<labels><label><name>stop_sign</name></label></labels><original_size><width>{WIDE}</width>"
        f"<height>{HIGH}</height></original_size></task></meta>"
        f'<track id="9" label="stop_sign">{boxes}</track></annotations>'
    )


def _track_box(frame: int, outside: int = 0) -> str:
    return (
        f'<box frame="{frame}" outside="{outside}" occluded="1" keyframe="1" xtl="1.5" '
        'ytl="2" xbr="9" ybr="8"></box>'
    )


def test_cvat_for_video_covers_every_frame_of_its_task(tmp_path: Path, log: Path) -> None:
    (tmp_path / "a.xml").write_text(_video(_track_box(1) + _track_box(3) + _track_box(5, 1)))

    assert _import(tmp_path / "a.xml", log, tmp_path / "truth.json") == 0
    # Frames 1, 3 and 5 of the video; the sign is no longer visible in 5.
    assert [(one.t_ns, one.present) for one in read_truth(tmp_path / "truth.json").cues] == [
        (START_NS + STEP_NS, True),
        (START_NS + 3 * STEP_NS, True),
        (START_NS + 5 * STEP_NS, False),
    ]
    things = json.loads((tmp_path / "objects.json").read_text())["annotations"]
    assert [thing["track_id"] for thing in things] == [9, 9]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not XML"),
        ("<annotations>", "not XML"),
        ("<svg></svg>", "expected <annotations>"),
        ("<annotations>" + "<a>" * 70 + "</a>" * 70 + "</annotations>", "over 64 levels deep"),
        (IMAGES_XML.replace('xtl="5.00"', 'xtl="nan"'), "expected a number"),
        (IMAGES_XML.replace('width="64"', 'width="x"'), "expected a whole number"),
        (IMAGES_XML.replace('width="64"', 'width="0"'), "expected pixels"),
        (IMAGES_XML.replace('label="car"', ""), "has no label"),
        (IMAGES_XML.replace("20,5;", "20;"), "expected x,y"),
        (_video(_track_box(2)), "frame 2: the task has 1 to 5 by 2"),
        (_video(_track_box(1)).replace("original_size", "o"), "original_size/width"),
        (_video(_track_box(1), "<stop_frame>999999999</stop_frame>"), "over 10000000"),
        (
            '<!DOCTYPE a [<!ENTITY x "y"><!ENTITY z "&x;&x;&x;&x;&x;">]>' + BODY,
            "document type decl",
        ),
        ('<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>' + BODY, "document type"),
        ('<!DOCTYPE a SYSTEM "http://127.0.0.1:9/a.dtd">' + BODY, "document type declaration"),
    ],
)
def test_invalid_cvat_xml_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.xml").write_text(text)

    with pytest.raises(SchemaError, match=message):
        read_cvat(tmp_path / "a.xml")


def _truth(**changes: Any) -> dict[str, Any]:
    end_ns = START_NS + FRAMES * STEP_NS
    return {"version": 1, "start_ns": START_NS, "end_ns": end_ns, **changes}


def _approach(first_s: float, last_s: float, number: int = 0) -> dict[str, Any]:
    return {
        "id": number,
        "intersection": "A",
        "control": "none",
        "start_ns": START_NS + int(first_s * 1e9),
        "enter_ns": START_NS + int(last_s * 1e9),
        "features": {"left": True, "right": True, "straight": True},
    }


LONG_DRIVE = {"end_ns": START_NS + 10**12}


def _cue(name: str, t_ns: int) -> list[dict[str, object]]:
    return [{"cue": name, "present": True, "t_ns": START_NS + t_ns}]


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        (_truth(start_ns=5, end_ns=9), "give the truth of this log"),
        (_truth(**LONG_DRIVE, approaches=[_approach(100, 200)]), "approach 0 from"),
        (_truth(approaches=[_approach(0, 0.3), _approach(0.2, 0.4, 1)]), "0 and 1 overlap"),
        (_truth(**LONG_DRIVE, cues=_cue("stop_sign", 10**11)), "cues.0 (stop_sign)"),
        (_truth(cues=_cue("stop_sing", 0)), "did you mean stop_s"),
        (_truth(cues=_cue("Zebra!", 0)), "cues.0.cue"),
        (_truth(cues=_cue("stop_sign", 7)), "no picture at their times, 1 in all"),
        (_truth(log_sha256={"a": "b"}), "by its hash"),
        (_truth(pose="../secret.tum"), "secret.tum"),
        (_truth(objects="gone.json"), "gone.json"),
    ],
)
def test_truth_that_contradicts_its_log_is_refused(
    tmp_path: Path, log: Path, tree: dict[str, Any], message: str
) -> None:
    assert message in refusal((1, 4), "check", _write(tmp_path / "truth.json", tree), log)


CUE: dict[str, Any] = {"cue": "stop_sign", "present": True}
MOMENT: dict[str, Any] = CUE | {"t_ns": START_NS}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"approaches": [_approach(0, 0.1), _approach(0.2, 0.3)]}, "duplicate id"),
        ({"approaches": [_approach(0, 1)]}, f"from {START_NS} to"),
        ({"approaches": [_approach(0, 0.1) | {"control": "yield"}]}, "approaches.0.control"),
        ({"cues": [CUE | {"t_ns": START_NS + FRAMES * STEP_NS}]}, f"from {START_NS} to"),
        ({"cues": [MOMENT | {"cue": "zebra"}]}, "no such cue"),
        ({"cues": [CUE]}, "either t_ns"),
        ({"cues": [MOMENT | {"start_ns": START_NS, "end_ns": START_NS + 1}]}, "either t_ns"),
        ({"cues": [CUE | {"start_ns": START_NS}]}, "either t_ns"),
        ({"cues": [MOMENT | {"approach": 3}]}, "no approach 3"),
    ],
)
def test_inconsistent_truth_is_refused(tmp_path: Path, more: dict[str, Any], message: str) -> None:
    with pytest.raises(SchemaError, match=message):
        read_truth(_write(tmp_path / "truth.json", _truth(**more)))


def test_every_missing_field_of_a_truth_is_named_in_one_line(tmp_path: Path) -> None:
    path = written(tmp_path / "truth.json", '{"version": 1, "approaches": [{"id": 1}, {"id": 2}]}')

    with pytest.raises(AnnotationError) as caught:
        read_truth(path)

    fields = ("intersection", "start_ns", "enter_ns", "control", "features")
    named = [f"approaches.0.{name}" for name in fields]
    assert str(caught.value) == (
        f"{path}: start_ns, end_ns, {', '.join(named)}, approaches.1.intersection: missing; "
        "add them (and 4 more)"
    )


NAME = "line-drive"
FUNCTION = "dummy_lines:truth"


def _install(monkeypatch: pytest.MonkeyPatch, function: Callable[[Path, Path], object]) -> None:
    module = ModuleType("dummy_lines")
    vars(module)["truth"] = function
    monkeypatch.setitem(sys.modules, "dummy_lines", module)
    data_set = DataSet(Format((), ("drive.lines",), "dummy_lines:open_drive", "folder"), FUNCTION)
    monkeypatch.setattr(truth_file, "data_sets", lambda: {NAME: data_set})


def test_plugin_error_about_log_is_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def truth(log: Path, folder: Path) -> Path:
        raise AnnotationError(f"{log}: no times; record it again")

    _install(monkeypatch, truth)

    with pytest.raises(AnnotationError, match=r"no times; record it again$"):
        truth_file.write_carried(NAME, tmp_path, tmp_path / "out")
