"""Accuracy, recall and false boxes of a catalog model through crosscue and as a bare network.

    python benchmarks/ap_equality.py DATA [MODEL ...] [--sizes 416x416 1280x736] [--evidence]

DATA holds ``sequences/pandaset_002``, whose 3-D boxes are projected into its 80 pictures, and
``signs/stop_vs_nostop_us_streets``, whose pictures are labelled with a stop sign or none. Bare is
ONNX Runtime with YOLOX's published pre- and postprocessing, implemented here independently of
crosscue. Both are measured with fully decoded pictures, and with JPEGs decoded at the reduced
resolution that the network needs (``decode = "reduced"`` in the card). pycocotools evaluates both.
Only YOLOX has a bare implementation here; for other models, only crosscue's numbers are printed.
CPU times are measured alternating, on the same pictures in one run. ``--evidence`` prints tables
for the model's card.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from io import StringIO
from itertools import product
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import onnx
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from scipy.spatial.transform import Rotation
from scipy.stats import beta

from crosscue.detectors.base import Detections, DetectorChoice, Frame, View
from crosscue.detectors.catalog.entries import entry, weights_path
from crosscue.detectors.catalog.fetch import fetch_weights
from crosscue.detectors.catalog.places import card_path
from crosscue.detectors.images import decode, read_file
from crosscue.detectors.registry import make

Floats = NDArray[np.float64]
Size = tuple[int, int]
# Vehicle classes by their number among COCO's 80 classes.
VEHICLES = {2: "car", 5: "bus", 7: "truck"}
STOP_SIGN = 11
VEHICLE_WORDS = ("Car", "Truck", "Bus", "Vehicle", "Van", "Towed")
NEAR_M, FAR_M = 30.0, 80.0
MIN_VISIBLE = 0.5
# Lowest score of detections that count towards the average precision.
MIN_SCORE = 0.01
RECALL_SCORE, FALSE_SCORE, SIGN_SCORE = 0.3, 0.5, 0.9
# Fraction of a false box that may overlap a vehicle's box at most.
MAX_FALSE_FRACTION = 0.1
# Successive pictures (1 s) that are resampled together, because their errors correlate.
BLOCK = 10
DRAWS = 300
# Timings of each picture; the minimum is the least disturbed by other work.
ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Detections in one picture: boxes (N, 4), scores (N,) and COCO class numbers (N,)."""

    boxes: Floats
    scores: Floats
    classes: NDArray[np.int64]

    def of(self, numbers: Sequence[int]) -> Found:
        """Return the detections of the given classes."""
        keep = np.isin(self.classes, list(numbers))
        return Found(self.boxes[keep], self.scores[keep], self.classes[keep])


@dataclass(frozen=True, slots=True, eq=False)
class Labelled:
    """A picture with boxes (N, 4), ranges (N,) and visible fractions (N,) of its vehicles."""

    path: Path
    boxes: Floats
    range_m: Floats
    visible: Floats

    def is_counted(self, reach_m: float) -> NDArray[np.bool_]:
        """Return the mask of the vehicles to detect; others are ignored."""
        return (self.range_m <= reach_m) & (self.visible >= MIN_VISIBLE)


def pandaset(folder: Path) -> list[Labelled]:
    """Return the pictures of a sequence with its 3-D boxes projected."""
    camera = folder / "camera" / "front_camera"
    lens = json.loads((camera / "intrinsics.json").read_text())
    poses = json.loads((camera / "poses.json").read_text())
    size = (1920, 1080)
    rows: dict[int, list[tuple[float, Floats, bool]]] = {i: [] for i in range(len(poses))}
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.5
    for row in pq.read_table(folder / "annotations" / "cuboids.parquet").to_pylist():
        pose = poses[row["frame"]]
        turn = Rotation.from_quat([pose["heading"][k] for k in "xyzw"])
        corners = signs * [row["width_m"], row["length_m"], row["height_m"]]
        corners = Rotation.from_euler("z", row["yaw_rad"]).apply(corners)
        corners += [row["x_m"], row["y_m"], row["z_m"]]
        seen = turn.inv().apply(corners - [pose["position"][k] for k in "xyz"])
        if (seen[:, 2] < 0.5).any():
            continue
        at = seen[:, :2] / seen[:, 2:] * [lens["fx"], lens["fy"]] + [lens["cx"], lens["cy"]]
        is_vehicle = any(word in row["label"] for word in VEHICLE_WORDS)
        distance = float(np.linalg.norm(seen.mean(axis=0)))
        rows[row["frame"]].append((distance, np.concatenate([at.min(0), at.max(0)]), is_vehicle))
    return [
        _labelled(camera / f"{frame:02}.jpg", sorted(some, key=lambda row: row[0]), size)
        for frame, some in rows.items()
    ]


def _labelled(path: Path, nearest_first: list[tuple[float, Floats, bool]], size: Size) -> Labelled:
    """Return the vehicles with the fraction of each in the picture and not hidden."""
    is_hidden = np.zeros((size[1] // 2, size[0] // 2), bool)
    kept = []
    for distance, whole, is_vehicle in nearest_first:
        box = np.clip(whole, 0.0, np.tile(size, 2))
        x0, y0, x1, y1 = np.round(box / 2).astype(int)
        area = float(np.prod(whole[2:] - whole[:2])) / 4
        free = float((~is_hidden[y0:y1, x0:x1]).sum())
        is_hidden[y0:y1, x0:x1] = True
        if is_vehicle and (box[2:] - box[:2] > 1.0).all():
            kept.append([*box, distance, free / max(area, 1.0)])
    table = np.array(kept, np.float64).reshape(-1, 6)
    return Labelled(path, table[:, :4], table[:, 4], table[:, 5])


def streets(folder: Path) -> list[tuple[Path, bool]]:
    """Return pictures of streets; True for those with a stop sign."""
    lines = (folder / "labels.tsv").read_text().splitlines()
    with_sign = {name for name, _, said in (line.partition("\t") for line in lines) if said == "1"}
    files = sorted(path for path in folder.iterdir() if path.suffix != ".tsv")
    return [(path, path.name in with_sign) for path in files]


class Bare:
    """The published network with the published pre- and postprocessing only."""

    def __init__(self, weights: Path, size: Size) -> None:
        self.min_score = MIN_SCORE
        model = onnx.load(str(weights))
        sides = model.graph.input[0].type.tensor_type.shape.dim
        sides[2].dim_value, sides[3].dim_value = size[1], size[0]
        for output in model.graph.output:
            output.type.tensor_type.ClearField("shape")
        del model.graph.value_info[:]
        onnxruntime: Any = import_module("onnxruntime")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 4
        self.session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
        self.name = self.session.get_inputs()[0].name
        self.size = size
        grids = []
        for stride in (8, 16, 32):
            ys, xs = np.mgrid[: size[1] // stride, : size[0] // stride]
            grids += [(x, y, stride) for x, y in zip(xs.ravel(), ys.ravel(), strict=True)]
        self.cells = np.array(grids, np.float32)
        self.network_s = 0.0

    def __call__(self, path: Path, view: View | None = None) -> tuple[Found, float]:
        """Return the detections, and the CPU seconds after the picture is decoded.

        Args:
            path: The picture.
            view: View to decode, as crosscue does for a detector; the full picture by default.
        """
        whole = cv2.imread(str(path))
        assert whole is not None
        picture: Any = whole if view is None else decode(read_file(path), view)[0]
        began = time.process_time()
        height, width = picture.shape[:2]
        to_camera = whole.shape[1] / width
        ratio = min(self.size[1] / height, self.size[0] / width)
        small = cv2.resize(picture, (int(width * ratio), int(height * ratio)))
        padded = np.full((self.size[1], self.size[0], 3), 114, np.uint8)
        padded[: small.shape[0], : small.shape[1]] = small
        given = np.ascontiguousarray(padded.transpose(2, 0, 1), dtype=np.float32)[None]
        before = time.process_time()
        (raw,) = self.session.run(None, {self.name: given})
        self.network_s = time.process_time() - before
        rows = raw[0]
        center = (rows[:, :2] + self.cells[:, :2]) * self.cells[:, 2:]
        half = np.exp(rows[:, 2:4]) * self.cells[:, 2:] / 2
        scores = rows[:, 4:5] * rows[:, 5:]
        classes = scores.argmax(1)
        best = scores[np.arange(len(scores)), classes]
        good = best >= self.min_score
        boxes = np.hstack([center - half, center + half])[good] / ratio
        keep = _suppressed(boxes, best[good], classes[good])
        found = Found(
            np.clip(boxes[keep].astype(float) * to_camera, 0, [*whole.shape[1::-1]] * 2),
            best[good][keep].astype(float),
            classes[good][keep].astype(np.int64),
        )
        return found, time.process_time() - began


def _suppressed(boxes: Any, scores: Any, classes: Any) -> list[int]:
    """Return the boxes kept by non-maximum suppression per class at IoU 0.45, as published."""
    kept: list[int] = []
    for number in np.unique(classes):
        order = [int(i) for i in np.argsort(-scores) if classes[i] == number]
        while order:
            first, rest = order[0], np.array(order[1:], int)
            kept.append(first)
            low = np.maximum(boxes[first, :2], boxes[rest, :2])
            high = np.minimum(boxes[first, 2:], boxes[rest, 2:])
            both = np.clip(high - low, 0, None).prod(1)
            areas = (boxes[:, 2:] - boxes[:, :2]).prod(1)
            overlap = both / (areas[first] + areas[rest] - both)
            order = rest[overlap <= 0.45].tolist()
    return kept


class Ours:
    """The catalog's model through crosscue, from the bytes of the file as in a run."""

    def __init__(
        self, model: str, size: Size, folder: Path, min_score: float, decode: str = "full"
    ) -> None:
        card = folder / f"{model}-{size[0]}x{size[1]}.toml"
        own = entry(model).input
        text = card_path(model).read_text(encoding="utf-8")
        text = text.replace(f"width_px = {own.width_px}", f"width_px = {size[0]}")
        text = text.replace(f"height_px = {own.height_px}", f"height_px = {size[1]}")
        text = re.sub(r"\ndecode = .*", "", text)
        card.write_text(text.replace("\n[input]\n", f'\n[input]\ndecode = "{decode}"\n'))
        self.detector = make(
            DetectorChoice(model, "model", {"card": str(card), "score": min_score})
        )
        self.numbers = {name: i for i, name in enumerate(entry(model).output.classes)}

    def __call__(self, path: Path) -> tuple[Found, float]:
        """Return the detections, and the CPU seconds after the picture is decoded."""
        pixels, size = decode(read_file(path), self.detector.view)
        began = time.process_time()
        (found,) = self.detector([Frame(0, "", pixels, size)])
        taken = time.process_time() - began
        assert isinstance(found, Detections)
        classes = np.array([self.numbers[label] for label in found.labels], np.int64)
        return Found(found.boxes_px, found.scores, classes), taken


class Judge:
    """Evaluation by pycocotools of the class vehicle, ignoring far and hidden vehicles."""

    def __init__(
        self, pictures: Sequence[Labelled], found: Sequence[Found], reach_m: float
    ) -> None:
        truth: list[dict[str, object]] = []
        answers: list[dict[str, object]] = []
        for i, (picture, one) in enumerate(zip(pictures, found, strict=True), 1):
            for box, is_counted in zip(picture.boxes, picture.is_counted(reach_m), strict=True):
                truth.append(
                    {
                        "id": len(truth) + 1,
                        "image_id": i,
                        "category_id": 1,
                        "bbox": _xywh(box),
                        "area": float(np.prod(box[2:] - box[:2])),
                        "iscrowd": int(not is_counted),
                    }
                )
            answers += [
                {"image_id": i, "category_id": 1, "bbox": _xywh(box), "score": float(score)}
                for box, score in zip(one.boxes, one.scores, strict=True)
            ]
        known = COCO()
        known.dataset = {
            "images": [{"id": i + 1} for i in range(len(pictures))],
            "categories": [{"id": 1, "name": "vehicle"}],
            "annotations": truth,
        }
        with redirect_stdout(StringIO()):
            known.createIndex()
            self.judge = COCOeval(known, known.loadRes(answers), "bbox")
            self.judge.evaluate()
            self.judge.accumulate()
        self.images = self.judge.evalImgs[: len(pictures)]

    def average_precision(self) -> tuple[float, float]:
        """Return the average precision in % at IoU 0.5, and its mean over IoU 0.5 to 0.95."""
        precision = self.judge.eval["precision"][:, :, 0, 0, 2]
        return 100 * float(precision[0].mean()), 100 * float(precision.mean())

    def interval(self) -> tuple[float, float]:
        """Return the 95 % bootstrap interval of AP at IoU 0.5, resampled by seconds."""
        rng = np.random.default_rng(1)
        count = len(self.images) // BLOCK
        drawn = []
        for _ in range(DRAWS):
            blocks = rng.integers(0, count, count)
            some = [self.images[int(b) * BLOCK + i] for b, i in product(blocks, range(BLOCK))]
            drawn.append(100 * _area(some))
        low, high = np.quantile(drawn, [0.025, 0.975])
        return float(low), float(high)


def _area(images: Sequence[Any]) -> float:
    """Return AP at IoU 0.5, computed as in pycocotools, of pictures that it evaluated."""
    some = [one for one in images if one is not None]
    scores = np.concatenate([one["dtScores"] for one in some])
    is_right = np.concatenate([one["dtMatches"][0] > 0 for one in some])
    is_ignored = np.concatenate([one["dtIgnore"][0] > 0 for one in some])
    total = sum(int((1 - one["gtIgnore"]).sum()) for one in some)
    order = np.argsort(-np.array(scores), kind="mergesort")
    right = np.cumsum((is_right & ~is_ignored)[order])
    wrong = np.cumsum((~is_right & ~is_ignored)[order])
    precision = np.maximum.accumulate((right / np.maximum(right + wrong, 1e-9))[::-1])[::-1]
    places = np.searchsorted(right / total, np.linspace(0, 1, 101), side="left")
    return float(np.append(precision, 0.0)[np.minimum(places, len(precision))].mean())


def _xywh(box: Floats) -> list[float]:
    return [float(box[0]), float(box[1]), float(box[2] - box[0]), float(box[3] - box[1])]


def recall(pictures: Sequence[Labelled], found: Sequence[Found]) -> tuple[int, int]:
    """Return the numbers of vehicles with a box of IoU and score above limits, and of all."""
    hits = total = 0
    for picture, one in zip(pictures, found, strict=True):
        boxes = one.boxes[one.scores >= RECALL_SCORE]
        for box in picture.boxes[picture.is_counted(NEAR_M)]:
            total += 1
            both = _both(box, boxes)
            areas = (boxes[:, 2:] - boxes[:, :2]).prod(1) + np.prod(box[2:] - box[:2])
            hits += bool((both / np.maximum(areas - both, 1e-9) >= 0.5).any())
    return hits, total


def on_nothing(pictures: Sequence[Labelled], found: Sequence[Found]) -> tuple[int, int]:
    """Return the numbers of boxes above 0.5 that overlap no vehicle, and of all boxes."""
    alone = total = 0
    for picture, one in zip(pictures, found, strict=True):
        for box in one.boxes[one.scores > FALSE_SCORE]:
            total += 1
            part = _both(box, picture.boxes) / max(float(np.prod(box[2:] - box[:2])), 1e-9)
            alone += not (part > MAX_FALSE_FRACTION).any()
    return alone, total


def _both(box: Floats, others: Floats) -> Floats:
    low, high = np.maximum(box[:2], others[:, :2]), np.minimum(box[2:], others[:, 2:])
    return np.asarray(np.clip(high - low, 0.0, None).prod(axis=1))


def proportion(hits: int, total: int) -> tuple[float, float, float]:
    """Return a fraction in % with its 95 % Clopper-Pearson interval."""
    low = beta.ppf(0.025, hits, total - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, total - hits) if hits < total else 1.0
    return 100 * hits / total, 100 * float(low), 100 * float(high)


@dataclass(frozen=True, slots=True)
class Result:
    """One metric: number of labelled objects, value and 95 % interval in %."""

    pictures: str
    boxes: int
    metric: str
    value: float
    low: float | None
    high: float | None


def measured(
    run: Callable[[Path], tuple[Found, float]],
    drive: Sequence[Labelled],
    signs: Sequence[tuple[Path, bool]],
) -> list[Result]:
    """Return all metrics of a pipeline."""
    found = [run(picture.path)[0].of([*VEHICLES]) for picture in drive]
    where = f"PandaSet sequence 002, {len(drive)} pictures, 3-D boxes projected"
    results = []
    for reach_m in (NEAR_M, FAR_M):
        judge = Judge(drive, found, reach_m)
        half, mean = judge.average_precision()
        assert abs(100 * _area(judge.images) - half) < 1e-6
        what = f"vehicles to {reach_m:.0f} m, half visible"
        total = sum(int(picture.is_counted(reach_m).sum()) for picture in drive)
        results += [
            Result(where, total, f"AP50 of {what}, %", half, *judge.interval()),
            Result(where, total, f"AP of {what}, %", mean, None, None),
        ]
    hits, total = recall(drive, found)
    alone, boxes = on_nothing(drive, found)
    best = [
        (max(run(path)[0].of([STOP_SIGN]).scores, default=0.0), has_sign)
        for path, has_sign in signs
    ]
    shown = [score > SIGN_SCORE for score, has_sign in best if has_sign]
    false = [score > SIGN_SCORE for score, has_sign in best if not has_sign]
    street = f"{len(signs)} US street pictures labelled with a stop sign or none"
    near = f"vehicles to {NEAR_M:.0f} m, half visible"
    return [
        *results,
        Result(where, total, f"recall of {near}, at {RECALL_SCORE}, %", *proportion(hits, total)),
        Result(where, boxes, "boxes above 0.5 on no vehicle, %", *proportion(alone, boxes)),
        Result(
            street, len(shown), "stop sign found above 0.9, %", *proportion(sum(shown), len(shown))
        ),
        Result(
            street,
            len(false),
            "stop sign above 0.9 without one, %",
            *proportion(sum(false), len(false)),
        ),
    ]


def cpu_times(bare: Bare, ours: Ours, pictures: Sequence[Labelled]) -> str:
    """Return medians over pictures of minimum CPU times, alternating, and of their ratios."""
    rows = []
    for picture in pictures:
        seconds = []
        for _ in range(ROUNDS):
            _, theirs_s = bare(picture.path)
            _, own_s = ours(picture.path)
            seconds.append((bare.network_s, theirs_s, own_s))
        rows.append(tuple(min(column) for column in zip(*seconds, strict=True)))
    network, whole, own = (1e3 * median(column) for column in zip(*rows, strict=True))
    to_network = median(own_s / network_s for network_s, _, own_s in rows)
    to_bare = median(own_s / theirs_s for _, theirs_s, own_s in rows)
    return (
        f"  CPU ms a picture without decoding its JPEG: network alone {network:.1f}, bare with "
        f"its own steps {whole:.1f}, crosscue {own:.1f}; ratio to the network {to_network:.3f}, to "
        f"bare {to_bare:.3f}"
    )


def main() -> None:
    """Print metrics and CPU times of each model and input size."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("models", nargs="*", default=["yolox-nano"])
    parser.add_argument("--sizes", nargs="+", default=["416x416", "1280x736"])
    parser.add_argument("--evidence", action="store_true", help="print it for the card")
    parser.add_argument("--times-only", action="store_true", help="measure CPU times alone")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    drive = pandaset(args.data / "sequences" / "pandaset_002")
    signs = streets(args.data / "signs" / "stop_vs_nostop_us_streets")
    for model, text in product(args.models, args.sizes):
        size = (int(text.split("x")[0]), int(text.split("x")[1]))
        card = entry(model)
        own_size = (card.input.width_px, card.input.height_px)
        if size != own_size and not card.input.is_resizable:
            continue
        fetch_weights(model)
        print(f"{model} at {text}")
        with tempfile.TemporaryDirectory() as name:
            ours = Ours(model, size, Path(name), MIN_SCORE)
            bare = None
            if card.output.kind == "yolox" and card.input.colour == "bgr":
                bare = Bare(weights_path(card, card.files[0]), size)
            if not args.times_only:
                reduced = Ours(model, size, Path(name), MIN_SCORE, "reduced")
                compare(bare, ours, reduced, drive, signs, args.evidence, text)
            if bare is not None:
                bare.min_score = RECALL_SCORE
                print(cpu_times(bare, Ours(model, size, Path(name), RECALL_SCORE), drive))


def compare(
    bare: Bare | None,
    ours: Ours,
    reduced: Ours,
    drive: Sequence[Labelled],
    signs: Sequence[tuple[Path, bool]],
    is_for_card: bool,
    size: str,
) -> None:
    """Print crosscue's numbers beside those of the bare network and of reduced decoding."""
    columns = [measured(ours, drive, signs), measured(reduced, drive, signs)]
    names = ["reduced", "bare", "bare, reduced"]
    if bare is not None:
        view = reduced.detector.view
        columns.append(measured(bare, drive, signs))
        columns.append(measured(lambda path: bare(path, view), drive, signs))
    heads = "".join(f" {name:>15}" for name in names[: len(columns) - 1])
    print(f"  {'':48} {'crosscue':>8} {'95 %':>16}{heads}")
    for own, *others in zip(*columns, strict=True):
        interval = "" if own.low is None else f"{own.low:.1f} to {own.high:.1f}"
        beside = "".join(f" {one.value:15.1f}" for one in others)
        print(f"  {own.metric:48} {own.value:8.1f} {interval:>16}{beside}  n = {own.boxes}")
    for own in columns[0] if is_for_card else []:
        bounds = "" if own.low is None else f"\nlow = {own.low:.1f}\nhigh = {own.high:.1f}"
        print(
            f'\n[[evidence]]\npictures = "{own.pictures}"\nboxes = {own.boxes}\n'
            f'input = "{size.replace("x", " x ")}"\nmetric = "{own.metric}"\n'
            f"value = {own.value:.1f}{bounds}"
        )


if __name__ == "__main__":
    main()
