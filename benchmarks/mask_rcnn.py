"""Mask R-CNN: our detector beside a plain torchvision loop, with the same weights and pictures.

Times are CPU seconds of one thread, in rotation, medians. The plain loop is torchvision's own:
1000 proposals, scores from 0.05, every mask pasted into the picture. The embedded network must find
the same things above a score; the ResNet-50 has random weights, so only its time counts. With
--coco and --images (see crosscue train frames) it also tells what fewer proposals cost.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import torch
from torchvision.models.detection.transform import GeneralizedRCNNTransform

from crosscue.datasets.scenes.drive import SceneSettings, world_of
from crosscue.datasets.scenes.render import Renderer
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.mask_rcnn import (
    MaskRcnnDetector,
    MaskRcnnSettings,
    checkpoint_named,
    detector_of,
    place,
)
from crosscue.detectors.mask_rcnn_checkpoint import Checkpoint, Facts
from crosscue.detectors.mask_rcnn_network import MEAN, SPREAD, Plan, build_network, set_limits
from crosscue.detectors.model_detector import overlaps
from crosscue.detectors.training.annotations import read_coco
from crosscue.detectors.training.scores import average_precisions, detections_on

LAYOUTS = ("L991", "L992", "L993", "L994", "L995", "L996")
TIMES_S = (4.0, 7.0)
CPU = torch.device("cpu")
SCORE = 0.5
RESNET_ROUNDS = 3


def frames() -> list[Frame]:
    """Simulated pictures of intersections that nothing was trained on."""
    taken = []
    for layout in LAYOUTS:
        _, _, world = world_of(SceneSettings(layout=layout))
        renderer = Renderer(world)
        for t_s in TIMES_S:
            rgb = renderer.picture(t_s).rgb
            bgr = np.ascontiguousarray(rgb[:, :, ::-1])
            taken.append(Frame(round(t_s * 1e9), "", bgr, (1280, 720)))
    return taken


def plain_loop(checkpoint: Checkpoint) -> Callable[[Frame], dict[str, Any]]:
    """Torchvision's own way, on the part of the picture that ours looks at."""
    plan = checkpoint.facts.plan
    network = build_network(plan)
    network.load_state_dict(checkpoint.network.state_dict())
    set_limits(network, 1000, 0.05)
    network.rpn._pre_nms_top_n["testing"] = 1000
    network.eval()

    def detect(frame: Frame) -> dict[str, Any]:
        placed = place(frame.pixels, plan).pixels
        height, width = placed.shape[:2]
        # A size equal to the picture's: torchvision's transform then scales nothing.
        network.transform = GeneralizedRCNNTransform(height, width, list(MEAN), list(SPREAD))
        rgb = np.ascontiguousarray(placed[:, :, ::-1].transpose(2, 0, 1))
        with torch.inference_mode():
            (found,) = network([torch.from_numpy(rgb).float() / 255.0])
        return dict(found)

    return detect


def raw_detector(checkpoint: Checkpoint, proposals: int) -> MaskRcnnDetector:
    """Ours without calibration, so that scores can be compared."""
    bare = replace(checkpoint, facts=Facts(plan=checkpoint.facts.plan))
    return detector_of(bare, MaskRcnnSettings(score=SCORE, proposals=proposals), CPU)


def cpu_s(call: Callable[[], Any]) -> float:
    """Processor time of one call."""
    began = time.process_time()
    call()
    return time.process_time() - began


def in_rotation(ways: dict[str, Callable[[Frame], Any]], pictures: list[Frame]) -> None:
    """Print each way's median time and its ratio to the first, picture by picture."""
    for way in ways.values():
        way(pictures[0])
    taken = {name: [0.0] * len(pictures) for name in ways}
    for i, frame in enumerate(pictures):
        for name, way in ways.items():
            taken[name][i] = cpu_s(lambda way=way, frame=frame: way(frame))  # type: ignore[misc]
    first = next(iter(taken.values()))
    for name, each in taken.items():
        ratio = median(a / b for a, b in zip(first, each, strict=True))
        print(f"  {name:42} {median(each):8.3f} CPU s a picture   x {ratio:5.2f}")


def told_equality(
    plain: Callable[[Frame], dict[str, Any]], ours: MaskRcnnDetector, pictures: list[Frame]
) -> None:
    """How many of the plain loop's detections above the score are ours too, and the reverse."""
    plan = ours.checkpoint.facts.plan
    both = theirs_alone = ours_alone = 0
    for frame in pictures:
        theirs = plain(frame)
        keep = theirs["scores"] >= SCORE
        boxes = theirs["boxes"][keep].double().numpy()
        placed = place(frame.pixels, plan)
        boxes = (boxes + np.tile(placed.corner_px, 2)) / np.tile(placed.scale, 2)
        labels = [str(plan.classes[i - 1]) for i in theirs["labels"][keep].tolist()]
        found = one_result(ours, frame)
        free = set(range(len(found)))
        for box, label in zip(boxes, labels, strict=True):
            shares = overlaps(box, found.boxes_px)
            fits = [i for i in free if shares[i] > 0.9 and found.labels[i] == label]
            if fits:
                free.remove(max(fits, key=lambda i: float(shares[i])))
                both += 1
            else:
                theirs_alone += 1
        ours_alone += len(free)
    print(f"  above {SCORE}: {both} in both, {theirs_alone} only plain, {ours_alone} only ours")


def one_result(detector: MaskRcnnDetector, frame: Frame) -> Detections:
    """Its detections in one frame."""
    (found,) = detector([frame])
    assert isinstance(found, Detections)
    return found


def random_resnet() -> Checkpoint:
    """A ResNet-50 with random weights whose scores are spread, so that masks are made."""
    torch.manual_seed(0)
    names = ("car", *(f"class {i}" for i in range(89)))
    plan = Plan(architecture="resnet50", classes=names, width_px=800)
    network = build_network(plan)
    with torch.no_grad():
        network.roi_heads.box_predictor.cls_score.weight.mul_(60.0)
    return Checkpoint(Facts(plan=plan), network.eval(), "")


def proposal_costs(checkpoint: Checkpoint, coco: Path, images: Path) -> None:
    """Average precision and time with more and fewer proposals."""
    classes = [name for name in checkpoint.facts.plan.classes if name]
    labelled = read_coco(coco, images, classes)
    bare = replace(checkpoint, facts=Facts(plan=checkpoint.facts.plan))
    for proposals in (1000, 300, 100, 50, 25):
        settings = MaskRcnnSettings(score=0.02, proposals=proposals)
        detector = detector_of(bare, settings, CPU)
        began = time.process_time()
        found = list(detections_on(labelled, detector))
        taken = (time.process_time() - began) / len(found)
        ap = average_precisions(labelled, found)
        print(f"  {proposals:5} proposals: box AP {ap['box']:6.2f}  mask AP {ap['mask']:6.2f}  "
              f"{taken:.3f} CPU s a picture")  # fmt: skip


def main() -> None:
    """Print all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--network", default="embedded", help="a checkpoint instead")
    parser.add_argument("--coco", type=Path, help="held-out annotations")
    parser.add_argument("--images", type=Path, help="their pictures")
    args = parser.parse_args()
    torch.set_num_threads(1)
    pictures = frames()
    own = checkpoint_named(args.network)
    plain = plain_loop(own)
    print(f"compact network, {own.facts.plan.width_px} pixels wide, {len(pictures)} pictures")
    ways: dict[str, Callable[[Frame], Any]] = {"torchvision, 1000 proposals, pasted": plain}
    for count in (1000, 100):
        detector = raw_detector(own, count)
        ways[f"ours, {count} proposals"] = lambda frame, d=detector: d([frame])  # type: ignore[misc]
        told_equality(plain, detector, pictures)
    # The network is shared and the last detector made sets its limits, so ours are timed apart.
    del ways["ours, 1000 proposals"]
    in_rotation(ways, pictures)
    resnet = random_resnet()
    few = raw_detector(resnet, 100)
    print(f"ResNet-50 with random weights, {resnet.facts.plan.width_px} pixels wide")
    in_rotation(
        {"torchvision, 1000 proposals, pasted": plain_loop(resnet),
         "ours, 100 proposals": lambda frame: few([frame])},
        pictures[:RESNET_ROUNDS],
    )  # fmt: skip
    if args.coco is not None:
        proposal_costs(own, args.coco, args.images)


if __name__ == "__main__":
    main()
