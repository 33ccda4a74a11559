"""Network outputs of every layout that encode one known box, in a wide or a tall input."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np

from crosscue.detectors.decoders.base import Array, Size, cell_count, cell_grid
from support.onnx_models import constant_model

SIZE: Final[Size] = (640, 320)
TALL: Final[Size] = (320, 640)
BOX = np.array([100.0, 40.0, 220.0, 140.0])
CLASSES = ("person", "car", "stop sign")
SCORE = 0.75
CLASS = 2


@dataclass(frozen=True)
class Sample:
    """Outputs that encode ``BOX`` of class ``CLASS`` with ``SCORE``; all other scores are lower."""

    settings: dict[str, Any]
    outputs: dict[str, Array]
    is_masked: bool = False
    layout: str = "nchw"
    inputs: Mapping[str, tuple[int, ...]] = field(default_factory=lambda: {"images": ()})
    """Names of the inputs; the first is the picture, whose shape comes from the layout."""


def input_shape(sample: Sample, size: Size = SIZE) -> tuple[int, ...]:
    """Shape of the input for a picture of this width and height."""
    width, height = size
    nchw, nhwc = (1, 3, height, width), (1, height, width, 3)
    return {"nchw": nchw, "chw": nchw[1:], "nhwc": nhwc}[sample.layout]


def _centered(size: Size | None = None) -> list[float]:
    x0, y0, x1, y1 = BOX / (1.0 if size is None else np.tile(size, 2))
    return [(x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0]


def _scores() -> list[float]:
    return [0.1, 0.2, SCORE]


def _logit(p: float) -> float:
    return float(np.log(p / (1 - p)))


def _yolox(size: Size) -> Sample:
    rows = np.zeros((1, cell_count(size, (8, 16, 32)), 8))
    # The cell of stride 16 in column 10 and row 5, after the cells of stride 8.
    cell = cell_count(size, (8,)) + 5 * (size[0] // 16) + 10
    x, y, w, h = _centered()
    rows[0, cell] = [x / 16 - 10, y / 16 - 5, np.log(w / 16), np.log(h / 16), 1.0, *_scores()]
    return Sample({"kind": "yolox"}, {"output": rows})


def _yolov5(size: Size) -> Sample:
    # Three anchors in each cell of strides 8, 16 and 32.
    rows = np.zeros((1, 3 * cell_count(size, (8, 16, 32)), 8))
    rows[0, 7] = [*_centered(), 0.5, 0.0, 0.1, SCORE * 2]
    return Sample({"kind": "yolov5", "name": "output0"}, {"output0": rows})


def _yolov8(size: Size) -> Sample:
    columns = np.zeros((1, 7, 50))
    columns[0, :, 30] = [*_centered(), *_scores()]
    return Sample({"kind": "yolov8", "name": "output0"}, {"output0": columns})


def _prototypes(size: Size) -> Array:
    """32 masks at a quarter of the input's size; the first covers the box's left half."""
    masks = np.full((1, 32, size[1] // 4, size[0] // 4), -9.0)
    masks[0, 0, :, : int(BOX[[0, 2]].mean()) // 4] = 9.0
    return masks


def _yolov8_seg(size: Size) -> Sample:
    columns = np.zeros((1, 7 + 32, 50))
    columns[0, :8, 30] = [*_centered(), *_scores(), 1.0]
    return Sample(
        {"kind": "yolov8-seg", "name": "output0", "prototypes": "output1"},
        {"output0": columns, "output1": _prototypes(size)},
        is_masked=True,
    )


def _end_to_end(size: Size) -> Sample:
    rows = np.zeros((1, 300, 6))
    rows[0, 0] = [*BOX, SCORE, CLASS]
    return Sample({"kind": "end-to-end", "name": "output0"}, {"output0": rows})


def _detr(size: Size) -> Sample:
    boxes, logits = np.zeros((1, 100, 4)), np.full((1, 100, 3), -9.0)
    boxes[0, 3] = _centered(size)
    logits[0, 3] = [_logit(p) for p in _scores()]
    return Sample(
        {"kind": "detr", "boxes": "dets", "logits": "labels"}, {"dets": boxes, "labels": logits}
    )


def _yolo_nas(size: Size) -> Sample:
    boxes, scores = _pair(size)
    return Sample(
        {"kind": "yolo-nas", "boxes": "904", "scores": "913"}, {"904": boxes, "913": scores}
    )


def _torchvision(size: Size) -> Sample:
    masks = np.zeros((2, 1, size[1], size[0]))
    masks[0, 0, :, : int(BOX[[0, 2]].mean())] = 0.9
    return Sample(
        {"kind": "torchvision", "masks": "masks"},
        {
            "boxes": np.array([BOX, BOX + 1]),
            "labels": np.array([CLASS + 1, 1]),
            "scores": np.array([SCORE, 0.05]),
            "masks": masks,
        },
        is_masked=True,
        layout="chw",
    )


def _logits(stride: int, sides_px: list[float]) -> Array:
    """Logits of eight bins for each side whose means are these distances."""
    found = []
    for distance in np.array(sides_px) / stride:
        low = int(distance)
        weights = np.full(8, 1e-12)
        weights[low], weights[low + 1] = low + 1 - distance, max(distance - low, 1e-12)
        found.append(np.log(weights))
    return np.concatenate(found)


def _picodet(size: Size, strides: tuple[int, ...] = (8, 16, 32, 64)) -> Sample:
    scores, distances = "cls_pred_stride_", "dis_pred_stride_"
    outputs: dict[str, Array] = {}
    for s in strides:
        count = cell_count(size, (s,), round_up=True)
        outputs[f"{scores}{s}"] = np.zeros((1, count, 3))
        outputs[f"{distances}{s}"] = np.zeros((1, count, 32))
    # Cell (7, 4) of stride 16 has its middle at (120, 72): 20, 32, 100 and 68 px to the sides.
    cell = 4 * (size[0] // 16) + 7
    outputs[f"{scores}16"][0, cell] = _scores()
    outputs[f"{distances}16"][0, cell] = _logits(16, [20.0, 32.0, 100.0, 68.0])
    if len(strides) == 4:
        outputs = {name.replace("_pred_stride", ""): values for name, values in outputs.items()}
        scores, distances = "cls_", "dis_"
    settings = {
        "kind": "picodet",
        "strides": strides,
        "scores": tuple(f"{scores}{s}" for s in strides),
        "distances": tuple(f"{distances}{s}" for s in strides),
    }
    return Sample(settings, outputs)


def _nanodet_m(size: Size) -> Sample:
    return _picodet(size, (8, 16, 32))


def _nanodet_m_old(size: Size) -> Sample:
    """Tables without an axis for the picture, under the names of each other's tables."""
    sample = _picodet(size, (8, 16, 32))
    settings, names = sample.settings, (*sample.settings["scores"], *sample.settings["distances"])
    renamed = dict(zip(names, "abcdef", strict=True))
    changed = {key: tuple(map(renamed.get, settings[key])) for key in ("scores", "distances")}
    return Sample(
        {**settings, **changed},
        {renamed[name]: values[0] for name, values in sample.outputs.items()},
    )


def nanodet_of_coco(size: Size) -> Sample:
    """NanoDet before Plus, with one output; its 80 classes are COCO's."""
    rows = np.zeros((1, cell_count(size, (8, 16, 32)), 80 + 32))
    # Cell (7, 4) of stride 16 has its middle at (120, 72).
    cell = cell_count(size, (8,)) + 4 * (size[0] // 16) + 7
    rows[0, cell, :3], rows[0, cell, 80:] = _scores(), _logits(16, [20.0, 32.0, 100.0, 68.0])
    return Sample({"kind": "nanodet", "strides": (8, 16, 32), "center": 0.5}, {"Identity": rows})


def _yolo_heads(size: Size) -> Sample:
    """YOLOv3-tiny with an output for each of its strides, 32 and 16."""
    counts = {"outputs0": 3 * cell_count(size, (32,)), "outputs1": 3 * cell_count(size, (16,))}
    heads = {name: np.zeros((1, 1, count, 8)) for name, count in counts.items()}
    heads["outputs1"][0, 0, 7] = [*_centered(), 0.5, 0.0, 0.1, SCORE * 2]
    return Sample({"kind": "yolov5", "heads": tuple(heads)}, dict(heads))


def _yolov5_large(size: Size) -> Sample:
    """YOLOv5's networks for large inputs have a fourth stride."""
    rows = np.zeros((1, 3 * cell_count(size, (8, 16, 32, 64)), 8))
    rows[0, 7] = [*_centered(), 0.5, 0.0, 0.1, SCORE * 2]
    return Sample({"kind": "yolov5", "name": "output0"}, {"output0": rows})


def _yolo_fastestv2_joined(size: Size) -> Sample:
    grids = _yolo_fastestv2(size).outputs
    rows = np.vstack([grids[name].reshape(-1, 18) for name in _FASTEST])
    return Sample({"kind": "yolo-fastestv2", "names": ("845",)}, {"845": rows})


def _nanodet(size: Size) -> Sample:
    strides = (8, 16, 32, 64)
    rows = np.zeros((1, cell_count(size, strides, round_up=True), 3 + 32))
    # Cell (7, 4) of stride 16 counts from (112, 64): 12, 24, 108 and 76 px to the sides.
    cell = cell_count(size, (8,)) + 4 * (size[0] // 16) + 7
    rows[0, cell] = [*_scores(), *_logits(16, [12.0, 24.0, 108.0, 76.0])]
    return Sample({"kind": "nanodet"}, {"output": rows})


def _fastestdet(size: Size) -> Sample:
    grid = np.zeros((1, 8, size[1] // 16, size[0] // 16))
    grid[:, 1:5] = -9.0
    x, y, w, h = _centered()
    sides = [_logit(w / size[0]), _logit(h / size[1])]
    grid[0, :, 5, 10] = [SCORE, x / 16 - 10, np.arctanh(y / 16 - 5), *sides, *_scores()]
    return Sample({"kind": "fastestdet"}, {"794": grid})


def _yolo_fastestv2(size: Size) -> Sample:
    grids = {name: np.zeros((1, size[1] // s, size[0] // s, 18)) for name, s in _FASTEST.items()}
    for grid in grids.values():
        grid[..., :12] = 0.25
    # Row 2, column 5 of stride 32; the anchor is 126.91 x 78.23.
    x, y, w, h = _centered()
    t = [(x / 32 - 4.5) / 2, (y / 32 - 1.5) / 2, np.sqrt(w / 126.91) / 2, np.sqrt(h / 78.23) / 2]
    grids["798"][0, 2, 5] = [*t, *np.full(8, 0.25), 1.0, 0.0, 0.0, *_scores()]
    return Sample({"kind": "yolo-fastestv2", "names": ("794", "798")}, dict(grids))


_FASTEST: Final = {"794": 16, "798": 32}


def _pair(size: Size) -> tuple[Array, Array]:
    """Boxes around all cells of strides 8, 16 and 32, with one of them replaced; and scores."""
    corner, stride = cell_grid(size, (8, 16, 32))
    middle = (corner + 0.5) * stride
    boxes = np.hstack([middle - stride, middle + stride])[None]
    scores = np.full((1, len(corner), 3), 0.01)
    boxes[0, 3], scores[0, 3] = BOX, _scores()
    return boxes, scores


def _damo_yolo(size: Size) -> Sample:
    boxes, scores = _pair(size)
    return Sample(
        {"kind": "yolo-nas", "boxes": "1123", "scores": "output"}, {"output": scores, "1123": boxes}
    )


_PADDLE: Final = {"im_shape": (1, 2), "image": (), "scale_factor": (1, 2)}


def _pp_yoloe(size: Size) -> Sample:
    boxes, scores = _pair(size)
    names = ("tmp_17", "concat_14.tmp_0")
    return Sample(
        {"kind": "pp-yoloe", "boxes": names[0], "scores": names[1]},
        dict(zip(names, (boxes, scores.transpose(0, 2, 1)), strict=True)),
        inputs={"image": (), "scale_factor": (1, 2)},
    )


def _pp_yoloe_joined(size: Size) -> Sample:
    joined = np.concatenate(_pair(size), axis=2)
    name = "concat_15.tmp_0"
    return Sample(
        {"kind": "pp-yoloe", "boxes": name, "scores": name}, {name: joined}, inputs={"image": ()}
    )


def _yolov8_corners(size: Size) -> Sample:
    """LibreYOLO's YOLOv9 and SSD: columns of boxes as corners."""
    columns = np.concatenate(_pair(size), axis=2).transpose(0, 2, 1)
    settings = {"kind": "yolov8", "name": "output", "are_corners": True}
    return Sample(settings, {"output": columns})


def _paddle_nms(size: Size) -> Sample:
    names = ("multiclass_nms3_0.tmp_0", "multiclass_nms3_0.tmp_2")
    rows = np.array([[CLASS, SCORE, *BOX], [-1.0] * 6, [99.0, 0.9, 7.0, 7.0, 9.0, 9.0]])
    return Sample(
        {"kind": "paddle-nms", "name": names[0], "count": names[1]},
        dict(zip(names, (rows, np.array([2], np.int32)), strict=True)),
        inputs=_PADDLE,
    )


def _yolov7_nms(size: Size) -> Sample:
    return Sample({"kind": "yolov7-nms"}, {"output": np.array([[0.0, *BOX, CLASS, SCORE]])})


def _mmdeploy(size: Size) -> Sample:
    rows = np.zeros((1, 100, 5))
    rows[0, 0] = [*BOX, SCORE]
    labels = np.zeros((1, 100), np.int64)
    labels[0, 0] = CLASS
    return Sample({"kind": "mmdeploy"}, {"dets": rows, "labels": labels}, inputs={"input": ()})


def _efficient_nms(size: Size) -> Sample:
    boxes, scores = np.full((1, 100, 4), 7.0), np.full((1, 100), 0.9)
    classes = np.full((1, 100), 99, np.int32)
    boxes[0, 0], scores[0, 0], classes[0, 0] = BOX, SCORE, CLASS
    return Sample(
        {"kind": "efficient-nms"},
        {
            "num_dets": np.array([[1]], np.int32),
            "det_boxes": boxes,
            "det_scores": scores,
            "det_classes": classes,
        },
    )


def _efficient_nms_plugin(size: Size) -> Sample:
    """The names that TensorRT's documentation gives to the outputs."""
    names = ("num_detections", "detection_boxes", "detection_scores", "detection_classes")
    outputs = dict(zip(names, _efficient_nms(size).outputs.values(), strict=True))
    keys = ("count", "boxes", "scores", "labels")
    return Sample({"kind": "efficient-nms", **dict(zip(keys, names, strict=True))}, outputs)


def _darknet(size: Size) -> Sample:
    boxes, confs = np.zeros((1, 50, 1, 4)), np.zeros((1, 50, 3))
    boxes[0, 7, 0], confs[0, 7] = BOX / np.tile(size, 2), _scores()
    return Sample({"kind": "darknet"}, {"confs": confs, "boxes": boxes}, inputs={"frame": ()})


def _ssd_tensorflow(size: Size) -> Sample:
    x0, y0, x1, y1 = BOX / np.tile(size, 2)
    return Sample(
        {"kind": "ssd-tensorflow"},
        {
            "detection_boxes": np.array([[[y0, x0, y1, x1], [0.0, 0.0, 0.0, 0.0]]]),
            "detection_classes": np.array([[CLASS + 1.0, 0.0]]),
            "detection_scores": np.array([[SCORE, 0.0]]),
        },
        layout="nhwc",
    )


def _ssd(size: Size) -> Sample:
    rows = np.full((1, 1, 200, 7), -1.0)
    rows[0, 0, 0] = [0, CLASS + 1, SCORE, *(BOX / np.tile(size, 2))]
    return Sample({"kind": "ssd", "name": "detection_out"}, {"detection_out": rows})


def _ssd_scores(size: Size) -> Sample:
    """UltraFace and pytorch-ssd: the first score is of the background."""
    boxes, scores = _pair(size)
    fractions = np.tile(boxes / np.tile(size, 2), (1, 2, 1))[:, :1500]
    some = np.tile(np.insert(scores, 0, 0.9, axis=2), (1, 2, 1))[:, :1500]
    some[:, scores.shape[1] :] = 0.0
    return Sample({"kind": "ssd-scores"}, {"scores": some, "boxes": fractions})


def _boxes_and_labels(size: Size) -> Sample:
    """Open Model Zoo's ATSS: as mmdeploy, with other names and without the axis of pictures."""
    dets, labels = _mmdeploy(size).outputs.values()
    return Sample({"kind": "mmdeploy", "boxes": "boxes"}, {"boxes": dets[0], "labels": labels[0]})


def _yolov9_heads(size: Size) -> Sample:
    """YOLOv9's own export: an auxiliary head, then the one that counts."""
    columns = _yolov8(size).outputs["output0"]
    settings = {"kind": "yolov8", "name": "3377"}
    return Sample(settings, {"output0": np.zeros_like(columns), "3377": columns})


def _yolop(size: Size) -> Sample:
    """YOLOP: boxes, and two maps of the whole input."""
    rows = _yolov5(size).outputs["output0"]
    road, lanes = np.zeros((2, 1, 2, size[1], size[0]))
    return Sample(
        {"kind": "yolov5", "name": "det_out"},
        {"det_out": rows, "drive_area_seg": road, "lane_line_seg": lanes},
    )


_FAMILIES: Final[dict[str, Callable[[Size], Sample]]] = {
    "yolox": _yolox,
    "yolov5": _yolov5,
    "yolov8": _yolov8,
    "yolov8-seg": _yolov8_seg,
    "end-to-end": _end_to_end,
    "detr": _detr,
    "yolo-nas": _yolo_nas,
    "torchvision": _torchvision,
    "picodet": _picodet,
    "nanodet": _nanodet,
    "fastestdet": _fastestdet,
    "yolo-fastestv2": _yolo_fastestv2,
    "pp-yoloe": _pp_yoloe,
    "paddle-nms": _paddle_nms,
    "yolov7-nms": _yolov7_nms,
    "mmdeploy": _mmdeploy,
    "efficient-nms": _efficient_nms,
    "darknet": _darknet,
    "ssd-tensorflow": _ssd_tensorflow,
    "ssd": _ssd,
    "ssd-scores": _ssd_scores,
}
# Other exports of these families.
VARIANTS: Final[dict[str, Callable[[Size], Sample]]] = {
    "nanodet-m": _nanodet_m,
    "nanodet-m, without the axis of pictures": _nanodet_m_old,
    "yolov3-tiny, an output a stride": _yolo_heads,
    "yolov5, four strides": _yolov5_large,
    "yolo-fastestv2, one output": _yolo_fastestv2_joined,
    "damo-yolo": _damo_yolo,
    "pp-yoloe, one output": _pp_yoloe_joined,
    "yolov8, corners": _yolov8_corners,
    "efficient-nms, names of the plugin": _efficient_nms_plugin,
    "mmdeploy, names of Open Model Zoo": _boxes_and_labels,
    "yolov9, two heads": _yolov9_heads,
    "yolop": _yolop,
}
SAMPLES: Final[dict[str, Callable[[], Sample]]] = {
    kind: partial(make, SIZE) for kind, make in _FAMILIES.items()
}
EVERY: Final[dict[str, Callable[[Size], Sample]]] = {**_FAMILIES, **VARIANTS}


def export(sample: Sample, size: Size = SIZE, metadata: Mapping[str, str] | None = None) -> bytes:
    """An ONNX file with these outputs."""
    outputs = {
        name: values if values.dtype.kind == "i" else values.astype(np.float32)
        for name, values in sample.outputs.items()
    }
    shapes = {name: shape or input_shape(sample, size) for name, shape in sample.inputs.items()}
    shape, is_bytes = input_shape(sample, size), sample.layout == "nhwc"
    return constant_model(shape, outputs, shapes, is_bytes=is_bytes, metadata=metadata)
