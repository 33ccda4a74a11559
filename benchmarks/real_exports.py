"""Export real networks with their projects' own exporters, and require that crosscue reads them.

For each export, with random weights: ``model init`` recognises the layout without options, its
class names are right, and the detections in a picture of the input's size equal those that the
project's own code finds with the exported network's weights. Prints one line for each, and exits
with 1 if any is wrong. Exports of projects that are not installed are left out, and named.

    pip install ultralytics torchvision transformers timm segmentation-models-pytorch
    python benchmarks/real_exports.py [NAME ...]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import crosscue
from crosscue.detectors.base import Detections, Frame, RoadMask
from crosscue.detectors.networks.model_detector import build
from crosscue.replay.errors import CrosscueError, one_line

# Width and height of the inputs: neither square nor equal.
SIZE: Final = (320, 192)
# Number of detections to compare.
COUNT: Final = 30
# Maximum differences of equal detections, of scores as a fraction: the same weights run in two
# back ends.
BOX_PX: Final = 0.05
SCORE: Final = 1e-3
NAMES: Final = ("car", "stop sign", "traffic light", "person", "bus", "truck")


@dataclass(frozen=True)
class Own:
    """What the project's own code finds.

    Attributes:
        boxes: Shape (N, 4), pixels.
        scores: Shape (N,).
        labels: Class names; a road network has none.
        road: Road pixels, of a road network.
    """

    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]
    labels: tuple[str, ...]
    road: NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class Export:
    """An exported file.

    Attributes:
        path: The file.
        kind: Layout that is to be recognised.
        find: Runs the project's own code on a picture, (H, W, 3), blue green red.
        names: Class names that the user has to give; none if the file has them.
        expected: Class names of the card.
        first_class: Number of the first class, where the user has to know it.
    """

    path: Path
    kind: str
    find: Callable[[NDArray[np.uint8]], Own]
    names: tuple[str, ...] = ()
    expected: tuple[str, ...] = NAMES
    first_class: int | None = None


def spread(network: Any, run: Callable[[], object], *, is_last: bool = True) -> None:
    """Scale the random weights of convolutions, so that their outputs have deviation 1.

    Otherwise nearly all scores of a random network are equal, and rounding decides which are the
    best. Biases remain, so that the scores are as low as those of an untrained network.

    Args:
        network: The network.
        run: Runs it on a picture.
        is_last: Scale only those with a bias, which are the last ones.
    """
    torch = import_module("torch")
    done: set[int] = set()

    def hook(layer: Any, _: object, output: Any) -> Any:
        # Distances to the sides of a box (YOLO26) are positive only as untrained or trained.
        is_other = (is_last and layer.bias is None) or layer.weight.shape[0] == 4
        if id(layer) in done or is_other or not layer.weight.requires_grad:
            return output
        done.add(id(layer))
        bias = 0.0 if layer.bias is None else layer.bias.reshape(1, -1, 1, 1)
        deviation = (output - bias).std()
        layer.weight /= deviation
        return (output - bias) / deviation + bias

    hooks = [
        one.register_forward_hook(hook)
        for one in network.modules()
        if isinstance(one, torch.nn.Conv2d)
    ]
    with torch.no_grad():
        run()
    for one in hooks:
        one.remove()


def blocks() -> NDArray[np.uint8]:
    """A picture of coloured blocks of 16 pixels, (H, W, 3), blue green red."""
    noise = np.random.default_rng(0).integers(0, 256, (SIZE[1] // 16, SIZE[0] // 16, 3))
    return np.asarray(np.kron(noise, np.ones((16, 16, 1))), np.uint8)


def tensor(torch: Any, picture: NDArray[np.uint8]) -> Any:
    """A picture as networks get it, (3, H, W), red green blue, from 0 to 1."""
    return torch.from_numpy(picture[..., ::-1].copy()).permute(2, 0, 1) / 255


def ultralytics(config: str, kind: str, folder: Path, **settings: Any) -> Export:
    """Export a network of Ultralytics; its own predictor runs the weights in torch."""
    os.environ |= {
        "YOLO_CONFIG_DIR": str(folder),
        "YOLO_AUTOINSTALL": "false",
        "YOLO_VERBOSE": "false",
    }
    library, torch = import_module("ultralytics"), import_module("torch")
    torch.manual_seed(0)
    yolo = (library.RTDETR if "rtdetr" in config else library.YOLO)(config)
    head = yolo.model.model[-1]
    yolo.model.names = dict(enumerate(NAMES)) | {i: f"other {i}" for i in range(6, head.nc)}
    own: dict[str, Any] = {"imgsz": [SIZE[1], SIZE[0]], "conf": 1e-9, "iou": 0.45, "max_det": 3000}
    if "rtdetr" in config:
        # Its predictor fits pictures into a square.
        own["imgsz"] = [SIZE[1], SIZE[1]]

    size = (own["imgsz"][1], own["imgsz"][0])
    yolo.model.eval()
    given = tensor(torch, blocks()[:, : size[0]])[None]
    spread(yolo.model, lambda: yolo.model(given), is_last="rtdetr" in config)

    def find(picture: NDArray[np.uint8]) -> Own:
        (result,) = yolo.predict(picture, verbose=False, **own)
        boxes = result.boxes
        labels = tuple(yolo.model.names[int(i)] for i in boxes.cls)
        return Own(boxes.xyxy.numpy().astype(float), boxes.conf.numpy().astype(float), labels)

    path = yolo.export(format="onnx", imgsz=own["imgsz"], verbose=False, simplify=False, **settings)
    return Export(Path(path), kind, find, expected=tuple(yolo.model.names.values()))


def torchvision(name: str, folder: Path) -> Export:
    """Export a network of torchvision."""
    torch, models = import_module("torch"), import_module("torchvision.models.detection")
    torch.manual_seed(0)
    # Of the networks without a background class, untrained ones also return class 0.
    first = 0 if name.startswith(("retinanet", "fcos")) else 1
    network = getattr(models, name)(
        weights=None, weights_backbone=None, num_classes=first + len(NAMES)
    ).eval()
    spread(network, lambda: network([tensor(torch, blocks())]))
    path, image = folder / f"{name}.onnx", torch.zeros(3, SIZE[1], SIZE[0])
    torch.onnx.export(
        network, ([image],), str(path), dynamo=False, output_names=["boxes", "scores", "labels"]
        if name.startswith(("retinanet", "fcos", "ssd")) else ["boxes", "labels", "scores"]
    )  # fmt: skip

    def find(picture: NDArray[np.uint8]) -> Own:
        with torch.no_grad():
            (found,) = network([tensor(torch, picture)])
        labels = tuple(NAMES[i - first] for i in found["labels"].tolist())
        return Own(found["boxes"].double().numpy(), found["scores"].double().numpy(), labels)

    return Export(path, "torchvision", find, NAMES, first_class=first)


def transformers(name: str, kind: str, folder: Path) -> Export:
    """Export RT-DETR or YOLOS of Transformers, with COCO's number of classes."""
    torch, library = import_module("torch"), import_module("transformers")
    torch.manual_seed(0)
    labels: tuple[str, ...] = NAMES
    if name == "RTDetr":
        backbone = library.RTDetrResNetConfig(
            embedding_size=16, hidden_sizes=[16, 16, 32, 32], depths=[1, 1, 1, 1],
            layer_type="basic", out_features=["stage2", "stage3", "stage4"],
        )  # fmt: skip
        config = library.RTDetrConfig(
            backbone_config=backbone, num_labels=len(labels), num_queries=50, decoder_layers=2,
            encoder_in_channels=[16, 32, 32], anchor_image_size=[SIZE[1], SIZE[0]],
        )  # fmt: skip
    else:
        labels = tuple(f"class {i}" for i in range(91))
        config = library.YolosConfig(
            num_labels=91, hidden_size=48, num_hidden_layers=2, num_attention_heads=2,
            intermediate_size=48, image_size=[SIZE[1], SIZE[0]], num_detection_tokens=50,
        )  # fmt: skip
    network = getattr(library, f"{name}ForObjectDetection")(config).eval()
    if name == "Yolos":
        # Untrained, all its queries are equal.
        torch.nn.init.normal_(network.vit.embeddings.detection_tokens)
    spread(network, lambda: network(tensor(torch, blocks())[None]))
    processor = getattr(library, f"{name}ImageProcessor")()

    module: Any = torch.nn.Module

    class Plain(module):  # type: ignore[misc]
        """The two outputs as a tuple."""

        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, pixel_values: Any) -> Any:
            found = self.network(pixel_values)
            return found.logits, found.pred_boxes

    path = folder / f"{name}.onnx"
    image = torch.zeros(1, 3, SIZE[1], SIZE[0])
    torch.onnx.export(
        Plain().eval(), (image,), str(path), dynamo=False, opset_version=17,
        input_names=["pixel_values"], output_names=["logits", "pred_boxes"],
    )  # fmt: skip
    # YOLOS has an unused class 0, as COCO's numbers start at 1.
    listed = labels if name == "RTDetr" else labels[1:]

    def find(picture: NDArray[np.uint8]) -> Own:
        given = tensor(torch, picture)[None]
        if name == "Yolos":
            mean, deviation = (
                torch.tensor(values)[None, :, None, None]
                for values in (processor.image_mean, processor.image_std)
            )
            given = (given - mean) / deviation
        # The exported file with the project's own decoding: traced, RT-DETR differs by 5e-4.
        session = import_module("onnxruntime").InferenceSession(str(path))
        outputs = session.run(None, {"pixel_values": given.numpy()})
        logits, boxes = map(torch.from_numpy, outputs)
        raw = SimpleNamespace(logits=logits, pred_boxes=boxes)
        (found,) = processor.post_process_object_detection(
            raw, threshold=0.0, target_sizes=[(SIZE[1], SIZE[0])]
        )
        kept = (found["labels"] > 0).numpy()
        if name == "RTDetr":
            # Its code also returns further classes of one box; crosscue returns the best.
            _, first = np.unique(found["boxes"].numpy(), axis=0, return_index=True)
            kept = np.isin(np.arange(len(kept)), first)
        kept = torch.from_numpy(kept)
        return Own(
            found["boxes"][kept].double().numpy(),
            found["scores"][kept].double().numpy(),
            tuple(labels[i] for i in found["labels"][kept].tolist()),
        )

    return Export(path, kind, find, listed, listed)


def segmentation(name: str, folder: Path) -> Export:
    """Export a network of segmentation-models, whose encoder is torchvision's or timm's."""
    torch, library = import_module("torch"), import_module("segmentation_models_pytorch")
    torch.manual_seed(0)
    architecture, encoder = name.split()
    network = getattr(library, architecture)(encoder, encoder_weights=None, classes=4).eval()
    spread(network, lambda: network(tensor(torch, blocks())[None]))
    path = folder / "road.onnx"
    image = torch.zeros(1, 3, SIZE[1], SIZE[0])
    torch.onnx.export(network, (image,), str(path), dynamo=False)
    names = ("background", "road", "curb", "mark")

    def find(picture: NDArray[np.uint8]) -> Own:
        given = tensor(torch, picture)[None]
        with torch.no_grad():
            best = network(given)[0].argmax(0).numpy()
        return Own(np.empty((0, 4)), np.empty(0), (), np.isin(best, (1, 3)))

    return Export(path, "segmentation", find, names, names)


EXPORTS: Final[Mapping[str, Callable[[Path], Export]]] = {
    "YOLOv5nu": partial(ultralytics, "yolov5n.yaml", "yolov8"),
    "YOLOv8n": partial(ultralytics, "yolov8n.yaml", "yolov8"),
    "YOLOv8n, variable size": partial(ultralytics, "yolov8n.yaml", "yolov8", dynamic=True),
    "YOLOv8n-seg": partial(ultralytics, "yolov8n-seg.yaml", "yolov8-seg"),
    "YOLO11n": partial(ultralytics, "yolo11n.yaml", "yolov8"),
    "YOLO12n": partial(ultralytics, "yolo12n.yaml", "yolov8"),
    "YOLOv10n": partial(ultralytics, "yolov10n.yaml", "yolov8"),
    "YOLO26n": partial(ultralytics, "yolo26n.yaml", "yolov8"),
    "YOLOv8n with suppression": partial(
        ultralytics, "yolov8n.yaml", "end-to-end", nms=True, conf=1e-9, iou=0.45
    ),
    "RT-DETR-l of Ultralytics": partial(ultralytics, "rtdetr-l.yaml", "detr"),
    "Faster R-CNN": partial(torchvision, "fasterrcnn_mobilenet_v3_large_320_fpn"),
    "RetinaNet": partial(torchvision, "retinanet_resnet50_fpn"),
    "SSDlite": partial(torchvision, "ssdlite320_mobilenet_v3_large"),
    "FCOS": partial(torchvision, "fcos_resnet50_fpn"),
    "RT-DETR of Transformers": partial(transformers, "RTDetr", "detr"),
    "YOLOS": partial(transformers, "Yolos", "detr"),
    "Unet of segmentation-models": partial(segmentation, "Unet resnet18"),
    "FPN of segmentation-models with timm": partial(segmentation, "FPN timm-mobilenetv3_small_100"),
}


def check(export: Export, picture: NDArray[np.uint8]) -> str:
    """Return what agrees, in words.

    Raises:
        AssertionError: Something differs; the message says what.
    """
    drafted = crosscue.draft_card(
        export.path,
        class_names=export.names or None,
        first_class=export.first_class,
        overwrite=True,
    )
    assert drafted.draft.kind == export.kind, f"recognised as {drafted.draft.kind}"
    card = crosscue.model(drafted.path).card
    assert card.output.classes == export.expected, f"classes {card.output.classes[:3]} and so on"
    height, width = picture.shape[:2]
    frame = Frame(0, "", picture, (width, height))
    own = export.find(picture)
    if own.road is not None:
        (mask,) = build(card=str(drafted.path))([frame])
        assert isinstance(mask, RoadMask)
        equal = float((mask.pixels() == own.road).mean())
        assert equal > 0.9999, f"{equal:.4%} of the pixels are equal"
        return f"{own.road.mean():.1%} road, {equal:.2%} of the pixels equal"
    # Detections are clipped to the picture.
    clipped = np.clip(own.boxes, 0.0, [width, height, width, height])
    order = np.argsort(-own.scores, kind="stable")[: COUNT + 1]
    assert len(order), "the project's own code finds nothing to compare"
    # Between two scores, so that rounding decides nothing.
    last = len(order) - 1
    least = own.scores[order].min() * 0.999
    if last == COUNT:
        least, order = float(own.scores[order[last - 1 :]].mean()), order[:last]
    (found,) = build(card=str(drafted.path), score=float(least))([frame])
    assert isinstance(found, Detections)
    equal_count = sum(
        any(
            own.labels[i] == label
            and np.abs(clipped[i] - box).max() < BOX_PX
            and abs(own.scores[i] - score) < SCORE * score
            for label, box, score in zip(found.labels, found.boxes_px, found.scores, strict=True)
        )
        for i in order.tolist()
    )
    said = f"{equal_count} of {len(order)} boxes equal, {len(found)} found"
    assert equal_count == len(order) == len(found), said
    return said


def main() -> int:
    """Check the named exports, or all; return 1 if any is wrong."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="exports (default: all)")
    given = parser.parse_args().names
    warnings.simplefilter("ignore")
    picture = blocks()
    wrong, left_out = 0, []
    for name in given or EXPORTS:
        with tempfile.TemporaryDirectory() as place:
            before = Path.cwd()
            os.chdir(place)
            try:
                export = EXPORTS[name](Path(place))
                side = SIZE[1] if "RT-DETR-l" in name else SIZE[0]
                said = check(export, np.ascontiguousarray(picture[:, :side]))
                print(f"right      {name}: {export.kind}, {said}", flush=True)
            except ModuleNotFoundError as error:
                left_out.append(f"{name} ({error.name})")
            except (AssertionError, CrosscueError) as error:
                wrong += 1
                print(f"wrong      {name}: {one_line(error, 300)}", flush=True)
            except Exception as error:
                # An exporter that fails says nothing about crosscue, but must not pass unseen.
                wrong += 1
                print(
                    f"not exported {name}: {type(error).__name__}: {one_line(error, 300)}",
                    flush=True,
                )
            finally:
                os.chdir(before)
    for name in left_out:
        print(f"left out   {name} is not installed")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
