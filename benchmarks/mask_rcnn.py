"""Mask R-CNN: our detector next to a plain torchvision loop, with equal weights and pictures.

Times are medians on one thread, alternating: CPU seconds per picture, and the ratio to the plain
loop by CPU and by wall time. The plain loop is torchvision's: 1000 proposals, scores from 0.05,
every mask pasted into the picture. The script then counts which of its detections above a score
ours also has (same class, every side within half a pixel). As the pictures are simulated, it
also counts correct, duplicate and false detections.

The ResNet-50 has random weights, because COCO's are not available here. Its scores follow from a
proposal's rank (5 are certain, 60 compete, 20 detections remain). Its equal detections show that
levels, proposals and boxes agree, and not what fewer proposals cost. Average precision against
proposals: crosscue train mask-rcnn --measure embedded --proposals 100 1000.
"""

from __future__ import annotations

import argparse
import copy
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor, nn
from torchvision.models.detection.transform import GeneralizedRCNNTransform

from crosscue.datasets.scenes.rendering.render import Renderer
from crosscue.datasets.scenes.settings import SceneSettings, world_of
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.networks.mask_rcnn.checkpoint import Calibration, Checkpoint, Facts
from crosscue.detectors.networks.mask_rcnn.detector import (
    MaskRcnnDetector,
    MaskRcnnSettings,
    checkpoint_named,
    detector_of,
    place_picture,
    raw_score,
)
from crosscue.detectors.networks.mask_rcnn.network import (
    MEAN,
    SPREAD,
    NetworkPlan,
    build_network,
    set_limits,
)
from crosscue.replay.columns import Floats
from crosscue.replay.errors import VehicleError

LAYOUTS: Final = ("L991", "L992", "L993", "L994", "L995", "L996")
TIMES_S: Final = (4.0, 7.0)
CPU: Final = torch.device("cpu")
PLAIN: Final = "torchvision, 1000 proposals, pasted"
SAME_PX: Final = 0.5
RIGHT_OVERLAP: Final = 0.3
# Calibrated scores above which the cues use a detection.
CUE_SCORES: Final = {"car": 0.95, "stop sign": 0.9, "traffic light": 0.9}
SURE, COMPETING, REMAINING = 5, 60, 20

Way = Callable[[Frame], Any]
# Map from a class to the min raw score of its detections.
Least = Callable[[str], float]


@dataclass(frozen=True, slots=True)
class Scene:
    """A simulated picture and the objects in it."""

    frame: Frame
    truth: tuple[tuple[str, Floats], ...]


def scenes() -> list[Scene]:
    """Render simulated pictures of intersections that no network was trained on."""
    taken = []
    for layout in LAYOUTS:
        _, _, world = world_of(SceneSettings(layout=layout))
        renderer = Renderer(world)
        for t_s in TIMES_S:
            picture = renderer.picture(t_s)
            bgr = np.ascontiguousarray(picture.rgb[:, :, ::-1])
            truth = tuple(
                (one.thing.category.replace("_", " "), np.array(one.box_px, np.float64))
                for one in picture.seen
            )
            taken.append(Scene(Frame(round(t_s * 1e9), "", bgr, (1280, 720)), truth))
    return taken


@dataclass(frozen=True, slots=True)
class PlainLoop:
    """Torchvision's inference on the part of the picture that ours uses."""

    network: Any
    plan: NetworkPlan

    def __call__(self, frame: Frame) -> dict[str, Tensor]:
        """Return the detections with pasted masks."""
        placed = place_picture(frame.pixels, self.plan).pixels
        height, width = placed.shape[:2]
        # The size equals the picture's, so that torchvision's transform does not scale it.
        self.network.transform = GeneralizedRCNNTransform(height, width, list(MEAN), list(SPREAD))
        rgb = np.ascontiguousarray(placed[:, :, ::-1].transpose(2, 0, 1))
        with torch.inference_mode():
            (found,) = self.network([torch.from_numpy(rgb).float() / 255.0])
        return dict(found)

    def detections(self, frame: Frame) -> Detections:
        """Return the detections in the frame's pixels, without masks."""
        found = self(frame)
        placed = place_picture(frame.pixels, self.plan)
        boxes = found["boxes"].double().numpy() + np.tile(placed.corner_px, 2)
        labels = tuple(str(self.plan.classes[i - 1]) for i in found["labels"].tolist())
        return Detections(
            frame.t_ns,
            frame.size_px,
            boxes / np.tile(placed.scale, 2),
            found["scores"].double().numpy(),
            labels,
            (b"",) * len(labels),
        )


def plain_loop(checkpoint: Checkpoint) -> PlainLoop:
    """Return a copy of the network with torchvision's default limits."""
    network = copy.deepcopy(checkpoint.network)
    set_limits(network, 1000, 0.05)
    network.rpn._pre_nms_top_n["testing"] = 1000
    return PlainLoop(network.eval(), checkpoint.facts.plan)


def raw_detector(checkpoint: Checkpoint, **changes: Any) -> MaskRcnnDetector:
    """Return our detector without calibration, so that scores can be compared."""
    network = copy.deepcopy(checkpoint.network)
    bare = replace(checkpoint, network=network, facts=Facts(plan=checkpoint.facts.plan))
    return detector_of(bare, MaskRcnnSettings.model_validate({"score": 0.5, **changes}), CPU)


def one_result(detector: MaskRcnnDetector, frame: Frame) -> Detections:
    """Return a detector's detections in one frame."""
    (found,) = detector([frame])
    assert isinstance(found, Detections)
    return found


class WholeOnnx:
    """The network of the plain loop, exported completely, in onnxruntime on one thread."""

    def __init__(self, checkpoint: Checkpoint, proposals: int, example: Frame) -> None:
        """Export for the size of the example, with the same minimum score as ours."""
        onnxruntime: Any = import_module("onnxruntime")
        self.plan = checkpoint.facts.plan
        network = copy.deepcopy(checkpoint.network)
        set_limits(network, proposals, 0.5)
        network.rpn._pre_nms_top_n["testing"] = 1000
        pixels = self._input(example)
        network.transform = GeneralizedRCNNTransform(*pixels.shape[1:], list(MEAN), list(SPREAD))
        with TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            path = Path(folder) / "whole.onnx"
            torch.onnx.export(network.eval(), ([pixels],), path, opset_version=17, dynamo=False)
            content = path.read_bytes()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        self.session = onnxruntime.InferenceSession(
            content, options, providers=["CPUExecutionProvider"]
        )

    def _input(self, frame: Frame) -> Tensor:
        rgb = place_picture(frame.pixels, self.plan).pixels[:, :, ::-1].transpose(2, 0, 1)
        return torch.from_numpy(np.ascontiguousarray(rgb)).float() / 255.0

    def __call__(self, frame: Frame) -> Detections:
        """Return the detections without the masks, which it nevertheless pastes."""
        name = self.session.get_inputs()[0].name
        found, labels, scores, _ = self.session.run(None, {name: self._input(frame).numpy()})
        placed = place_picture(frame.pixels, self.plan)
        boxes = (found.astype(np.float64) + np.tile(placed.corner_px, 2)) / np.tile(placed.scale, 2)
        names = tuple(str(self.plan.classes[i - 1]) for i in labels.tolist())
        return Detections(
            frame.t_ns, frame.size_px, boxes, scores.astype(np.float64), names, (b"",) * len(names)
        )


def whole_onnx(checkpoint: Checkpoint, counts: Sequence[int], seen: Sequence[Scene]) -> None:
    """Print CPU times of ours and the exported network, and the equality of detections."""
    for count in (min(counts), max(counts)):
        ours = raw_detector(checkpoint, proposals=count)
        theirs = WholeOnnx(checkpoint, count, seen[0].frame)
        print(f"  {count} proposals, score 0.5")
        in_rotation(
            {
                "whole network in onnxruntime": theirs,
                "ours, torch": lambda frame, d=ours: d([frame]),  # type: ignore[misc]
            },
            [scene.frame for scene in seen],
        )
        same = sum(
            (
                matches(theirs(scene.frame), one_result(ours, scene.frame), lambda name: 0.5)
                for scene in seen
            ),
            Counter[str](),
        )
        print(f"    {dict(same)}")


def our_ways(checkpoint: Checkpoint, counts: Sequence[int]) -> dict[str, MaskRcnnDetector]:
    """Return ours for each number of proposals; in OpenVINO for the lowest and the highest."""
    ways = {}
    for backend, of_backend in (("torch", counts), ("openvino", (min(counts), max(counts)))):
        try:
            for count in of_backend:
                ways[f"ours, {backend}, {count} proposals"] = raw_detector(
                    checkpoint, proposals=count, backend=backend
                )
        except VehicleError as error:
            print(f"  {error}")
    return ways


def in_rotation(ways: Mapping[str, Way], frames: Sequence[Frame]) -> None:
    """Print the median time of each way, and the median ratio to the first by frame."""
    for way in ways.values():
        way(frames[0])
    cpu_s: dict[str, list[float]] = {name: [] for name in ways}
    wall_s: dict[str, list[float]] = {name: [] for name in ways}
    for frame in frames:
        for name, way in ways.items():
            began_cpu, began_wall = time.process_time(), time.perf_counter()
            way(frame)
            cpu_s[name].append(time.process_time() - began_cpu)
            wall_s[name].append(time.perf_counter() - began_wall)
    first = next(iter(ways))
    for name in ways:
        print(
            f"  {name:36} {median(cpu_s[name]):7.3f} CPU s a picture   "
            f"x {_faster(cpu_s[first], cpu_s[name]):5.2f} CPU   "
            f"x {_faster(wall_s[first], wall_s[name]):5.2f} wall"
        )


def _faster(first: Sequence[float], other: Sequence[float]) -> float:
    return median(a / b for a, b in zip(first, other, strict=True))


def above(found: Detections, min_score: Least) -> list[int]:
    """Return the indices of detections from the minimum score of their class, best first."""
    kept = [i for i, label in enumerate(found.labels) if found.scores[i] >= min_score(label)]
    return sorted(kept, key=lambda i: -float(found.scores[i]))


def matches(theirs: Detections, ours: Detections, min_score: Least) -> Counter[str]:
    """Return the number of detections in both, and in only one of them."""
    free, counts = set(above(ours, min_score)), Counter[str]()
    for i in above(theirs, min_score):
        apart_px = {
            j: float(np.abs(ours.boxes_px[j] - theirs.boxes_px[i]).max())
            for j in free
            if ours.labels[j] == theirs.labels[i]
        }
        nearest = min(apart_px, key=apart_px.__getitem__, default=None)
        if nearest is None or apart_px[nearest] > SAME_PX:
            counts["only plain"] += 1
        else:
            free.remove(nearest)
            counts["the same"] += 1
    counts["only ours"] = len(free)
    return counts


def judged(found: Detections, scene: Scene, min_score: Least) -> Counter[str]:
    """Return the numbers of correct, duplicate and false detections."""
    counts, met = Counter[str](), set[int]()
    for i in above(found, min_score):
        fractions = [
            float(box_ious(box, found.boxes_px[i : i + 1])[0]) if name == found.labels[i] else 0.0
            for name, box in scene.truth
        ]
        best = max(range(len(fractions)), key=fractions.__getitem__, default=None)
        if best is None or fractions[best] < RIGHT_OVERLAP:
            counts["false"] += 1
        else:
            counts["doubles" if best in met else "right"] += 1
            met.add(best)
    return counts


def reported_equality(
    plain: PlainLoop,
    ours: Mapping[str, MaskRcnnDetector],
    seen: Sequence[Scene],
    levels: Mapping[str, Least],
    is_true: bool,
) -> None:
    """Print the plain loop's detections that ours finds and, with truth, the correct ones."""
    theirs = [plain.detections(scene.frame) for scene in seen]
    found = {name: [one_result(d, s.frame) for s in seen] for name, d in ours.items()}
    for level, min_score in levels.items():
        print(f"  {level}")
        for name, results in {PLAIN: theirs, **found}.items():
            same = sum(
                (matches(a, b, min_score) for a, b in zip(theirs, results, strict=True)),
                Counter[str](),
            )
            true = sum(
                (judged(a, s, min_score) for a, s in zip(results, seen, strict=True)),
                Counter[str](),
            )
            reported = (
                f"    {name:36} {same['the same']:4} the same, {same['only plain']} only plain, "
            )
            reported += f"{same['only ours']} only ours"
            if is_true:
                reported += (
                    f"; {true['right']} right, {true['doubles']} doubles, {true['false']} false"
                )
            print(reported)


def score_levels(checkpoint: Checkpoint) -> dict[str, Least]:
    """Return the minimum raw scores: one half, and those above which cues use detections."""
    by = checkpoint.facts.calibration
    cues = {
        name: raw_score(min_score, by.get(name, Calibration()))
        for name, min_score in CUE_SCORES.items()
    }
    return {
        "raw score of 0.5 and more": lambda name: 0.5,
        "calibrated 0.9 and more, cars 0.95 (what the cues take)": lambda name: cues.get(name, 2.0),
    }


class Ranked(nn.Module):
    """A box predictor that keeps its boxes and scores them by the rank of their proposal."""

    def __init__(self, plain: Any, classes: int) -> None:
        """Rows of the score table are ranks: certain, then competing, then background."""
        super().__init__()
        self.plain = plain
        logits = torch.full((2000, classes), -12.0)
        logits[:, 0] = 0.0
        logits[:COMPETING, 1] = -1.5
        logits[:SURE, 1] = 4.0 - 0.1 * torch.arange(SURE)
        self.logits = nn.Parameter(logits, requires_grad=False)

    def forward(self, pooled: Tensor) -> tuple[Tensor, Tensor]:
        """Return the logits of the classes and the shifts of the boxes."""
        own, shifts = self.plain(pooled)
        return self.logits[: own.shape[0]] + 0.0 * own, shifts


def random_resnet() -> Checkpoint:
    """Return a ResNet-50 with random weights and scores by rank."""
    torch.manual_seed(0)
    names = ("car", *(f"class {i}" for i in range(89)))
    plan = NetworkPlan(architecture="resnet50", classes=names, width_px=800)
    network = build_network(plan)
    heads = network.roi_heads
    with torch.no_grad():
        # Shifts of a tenth of a box, as in trained networks; larger ones amplify rounding.
        network.rpn.head.bbox_pred.weight.mul_(0.05)
        heads.box_predictor.bbox_pred.weight.mul_(0.05)
    heads.box_predictor = Ranked(heads.box_predictor, len(names) + 1)
    heads.detections_per_img = REMAINING
    return Checkpoint(Facts(plan=plan), network.eval(), "")


def compare(
    checkpoint: Checkpoint,
    counts: Sequence[int],
    seen: Sequence[Scene],
    levels: Mapping[str, Least],
    is_true: bool,
) -> None:
    """Print times and equality of one network."""
    plain, ours = plain_loop(checkpoint), our_ways(checkpoint, counts)
    ways: dict[str, Way] = {PLAIN: plain}
    for name, detector in ours.items():
        ways[name] = lambda frame, d=detector: d([frame])  # type: ignore[misc]
    in_rotation(ways, [scene.frame for scene in seen])
    reported_equality(plain, ours, seen, levels, is_true)


def main() -> None:
    """Print the comparisons for each network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", default="embedded", help="a checkpoint instead")
    parser.add_argument(
        "--onnx", action="store_true", help="only: the whole network as ONNX beside ours"
    )
    parser.add_argument("--resnet-pictures", type=int, default=4, help="how many; it is slow")
    args = parser.parse_args()
    torch.set_num_threads(1)
    seen = scenes()
    own = checkpoint_named(args.network)
    print(f"{args.network}, {own.facts.plan.width_px} pixels wide, {len(seen)} pictures")
    if args.onnx:
        whole_onnx(own, (100, 1000), seen)
        return
    compare(own, (100, 200, 300, 1000), seen, score_levels(own), is_true=True)
    few = seen[: args.resnet_pictures]
    if few:
        resnet = random_resnet()
        print(f"ResNet-50, random, {resnet.facts.plan.width_px} pixels wide, {len(few)} pictures")
        half: dict[str, Least] = {"raw score of 0.5 and more": lambda name: 0.5}
        compare(resnet, (100, 1000), few, half, is_true=False)


if __name__ == "__main__":
    main()
