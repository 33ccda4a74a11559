"""Compare the heights of masks and the noses of cars with the truth of labelled pictures.

Range follows from the height of a sign's or light's mask, and a parked car's direction from the
lower end of its mask. The input is what crosscue train frames writes:

    crosscue train frames L900-L959 L1000-L1059 --per-layout 5 -o held_out
    python benchmarks/mask_shapes.py held_out --after 300
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.detectors import rle
from crosscue.detectors.base import Detections
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.cues.observed import nose_of
from crosscue.detectors.networks.mask_rcnn.detector import build
from crosscue.detectors.training.annotations import LabelledPicture, LabelledSet, read_training_coco
from crosscue.detectors.training.measure import detections_on
from crosscue.replay.columns import Floats

CLASSES: Final = ("car", "stop sign", "traffic light")
SAME_OBJECT: Final = 0.5
# Min length over height of cars that the cues evaluate.
LONG: Final = 2.0

# Detected box, true box, detected mask, true mask and picture.
Pair = tuple[Floats, Floats, bytes, bytes, LabelledPicture]


def pairs(
    labelled: LabelledSet, found: Sequence[Detections], name: str, score: float
) -> Iterator[Pair]:
    """Yield detections of a class above a score that overlap an object of that class."""
    for picture, detections in zip(labelled.pictures, found, strict=True):
        truth = [one for one in picture.objects if CLASSES[one.label] == name]
        boxes = np.array([one.box_px for one in truth], np.float64).reshape(-1, 4)
        for i, label in enumerate(detections.labels):
            if label != name or detections.scores[i] <= score or not truth:
                continue
            fractions = box_ious(detections.boxes_px[i], boxes)
            best = int(fractions.argmax())
            mask = truth[best].mask
            if fractions[best] >= SAME_OBJECT and isinstance(mask, bytes):
                yield detections.boxes_px[i], boxes[best], detections.masks[i], mask, picture


def height_px(mask: bytes, size_px: tuple[int, int]) -> int:
    """Return the number of rows from the first to the last row of the object."""
    rows = np.flatnonzero(rle.decode_mask(mask, size_px).any(axis=1))
    return int(rows[-1] - rows[0]) + 1


def print_heights(labelled: LabelledSet, found: Sequence[Detections], name: str) -> None:
    """Print the ratio of detected to true height."""
    ratios = [
        height_px(own, picture.size_px) / height_px(true, picture.size_px)
        for _, _, own, true, picture in pairs(labelled, found, name, 0.9)
    ]
    print(
        f"{name}, score above 0.9: height over the true one: median {np.median(ratios):.2f}, "
        f"s.d. {np.std(ratios):.2f}, {len(ratios)} masks"
    )


def print_noses(labelled: LabelledSet, found: Sequence[Detections]) -> None:
    """Print the fraction of masks whose nose is at the same end as in the true mask."""
    agree: list[bool] = []
    for found_px, box, own, true, picture in pairs(labelled, found, "car", 0.95):
        is_whole = box[0] > 1.0 and box[2] < picture.size_px[0] - 1.0
        width, height = found_px[2:] - found_px[:2]
        if is_whole and width > LONG * height:
            noses = [nose_of(rle.column_heights_px(m, picture.size_px)) for m in (own, true)]
            agree.append(noses[0] == noses[1])
    print(
        f"cars from the side, score above 0.95: nose at the true mask's end for {sum(agree)} of "
        f"{len(agree)}"
    )


def main() -> None:
    """Print heights and noses of a labelled set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="with coco.json and images")
    parser.add_argument("--network", default="embedded")
    parser.add_argument(
        "--after", type=int, default=0, metavar="N", help="leave out the first N pictures"
    )
    args = parser.parse_args()
    whole = read_training_coco(args.folder / "coco.json", args.folder / "images", CLASSES)
    labelled = replace(whole, pictures=whole.pictures[args.after :])
    found = list(detections_on(labelled, build(network=args.network)))
    for name in CLASSES[1:]:
        print_heights(labelled, found, name)
    print_noses(labelled, found)


if __name__ == "__main__":
    main()
