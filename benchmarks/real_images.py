"""Count the detections of runs of crosscue detect, for docs/explanation/real_images.md.

For each run, it prints the number of frames and boxes of each label at a score, and the number of
frames with each positive cue. With --road, it prints the agreement of the other runs' road masks
with that run's.

    python benchmarks/real_images.py embedded_stop yolox_stop --scores 0.5 0.9
    python benchmarks/real_images.py embedded_dashcam twinlitenet_dashcam --road adas_dashcam
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.eval.runs.folder import RunFolder, open_run

LABELS: Final = (
    "car", "stop sign", "traffic light", "one way left", "one way right", "do not enter",
)  # fmt: skip


def print_found(run: RunFolder, scores: list[float]) -> None:
    """Print the number of frames and boxes of each label."""
    frames = run.table("frames", ["frame"]).num_rows
    table = run.table("detections", ["frame", "label", "score"]).to_pylist()
    print(f"{run.path}: {frames} frames")
    for label in LABELS:
        reported = []
        for score in scores:
            rows = [row for row in table if row["label"] == label and row["score"] >= score]
            seen = {row["frame"] for row in rows}
            reported.append(f"from {score:g}: {len(seen)} frames, {len(rows)} boxes")
        if any(row["label"] == label for row in table):
            print(f"  {label:14} {'; '.join(reported)}")


def print_cues(run: RunFolder) -> None:
    """Print the number of frames with each positive cue."""
    positive: dict[str, int] = defaultdict(int)
    for row in run.table("cues", ["cue", "count"]).to_pylist():
        positive[row["cue"]] += row["count"] > 0
    reported = ", ".join(f"{cue} {count}" for cue, count in sorted(positive.items()))
    print(f"  cues positive in frames: {reported or 'none looked for'}")


def road_masks(run: RunFolder, size_px: tuple[int, int]) -> Iterator[NDArray[np.bool_]]:
    """Yield the road mask of each frame in order, shape (height, width)."""
    table = run.table("road", ["mask", "mask_width_px", "mask_height_px"]).to_pylist()
    for row in table:
        mask = rle.decode_mask(row["mask"], (row["mask_width_px"], row["mask_height_px"]))
        whole = cv2.resize(mask.astype(np.uint8), size_px, interpolation=cv2.INTER_NEAREST)
        yield np.asarray(whole, np.bool_)


def print_road(run: RunFolder, other: RunFolder) -> None:
    """Print the agreement of road masks over the pixels of all frames."""
    row = run.table("frames", ["width_px", "height_px"]).slice(0, 1).to_pylist()[0]
    size = (row["width_px"], row["height_px"])
    if run.table("road", ["t_ns"]) != other.table("road", ["t_ns"]):
        raise SystemExit(f"--road {other.path}: not of the same pictures as {run.path}")
    both = own = its = 0
    for a, b in zip(road_masks(run, size), road_masks(other, size), strict=True):
        both += int((a & b).sum())
        own += int(a.sum())
        its += int(b.sum())
    print(
        f"  road beside {other.path}: IoU {both / (own + its - both):.2f}, of its road also found "
        f"{both / its:.2f}, of what is found outside its road {1.0 - both / own:.2f}"
    )


def main() -> None:
    """Print the counts of each run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--scores", type=float, nargs="+", default=[0.3, 0.5, 0.9, 0.95])
    parser.add_argument("--road", type=Path, metavar="RUN", help="compare roads with this one's")
    args = parser.parse_args()
    for path in args.runs:
        run = open_run(path)
        print_found(run, args.scores)
        print_cues(run)
        if args.road is not None:
            print_road(run, open_run(args.road))


if __name__ == "__main__":
    main()
