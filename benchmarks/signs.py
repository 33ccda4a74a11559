"""Our sign search beside one ORB for every window of every level, on the same simulated scenes.

Both look for the same three drawings at two sizes, on the same levels, with the same ratio test;
the peer's windows are 16 pixels apart. Prints median times a picture, the ratio, and signs found.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from statistics import median

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.model_detector import overlaps
from crosscue.detectors.sign_detector import SignSettings, build
from crosscue.detectors.sign_drawings import AMERICAN, Drawing, Kind, drawings
from crosscue.replay.columns import Bytes, Floats
from support.sign_scenes import Scene, clutter, scene

STRIDE_PX = 16
ROUNDS = 5
RULES = SignSettings(crop_bottom=0.0, least_score=0.1)
Found = list[tuple[str, Floats]]


class NaiveSearch:
    """The source's way: a window slides over each level; ORB and the matcher run in each."""

    def __init__(self) -> None:
        """Describe the drawings once."""
        self._orb = cv2.ORB.create(
            nfeatures=500, nlevels=1, edgeThreshold=8, patchSize=16, fastThreshold=RULES.fast
        )
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self._drawn = [
            (one, self._described(one.grey)) for one in drawings(AMERICAN, RULES.heights_px)
        ]

    def __call__(self, grey: Bytes) -> Found:
        """The best window, if a tenth of a drawing's points are in it."""
        best: tuple[float, str, Floats] = (0.1, "", np.zeros(4))
        for level in range(RULES.levels):
            scale = RULES.enlarge / RULES.factor**level
            small = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale), np.uint8)
            for one, described in self._drawn:
                best = max(best, self._level(small, one, described, scale), key=lambda b: b[0])
        return [(best[1], best[2])] if best[1] else []

    def _level(
        self, level: Bytes, one: Drawing, described: Bytes, scale: float
    ) -> tuple[float, str, Floats]:
        height, width = one.grey.shape
        best: tuple[float, str, Floats] = (0.0, "", np.zeros(4))
        for y in range(0, level.shape[0] - height, STRIDE_PX):
            for x in range(0, level.shape[1] - width, STRIDE_PX):
                share = self._share(level[y : y + height, x : x + width], described)
                if share > best[0]:
                    box = np.array([x, y, x + width, y + height], np.float64) / scale
                    best = (share, one.kind, box)
        return best

    def _share(self, window: Bytes, described: Bytes) -> float:
        points = self._described(window)
        if len(points) < 2:
            return 0.0
        pairs = self._matcher.knnMatch(points, described, k=2)
        alike = {a.trainIdx for a, b in pairs if a.distance < RULES.ratio * b.distance
                 and a.distance <= RULES.most_bits}  # fmt: skip
        return len(alike) / len(described)

    def _described(self, grey: Bytes) -> Bytes:
        keypoints = self._orb.detect(grey, None)
        for keypoint in keypoints:
            keypoint.angle = 0.0
        _, descriptors = self._orb.compute(grey, keypoints)
        return np.empty((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors)


def ours(grey: Bytes) -> Found:
    """Our detector's boxes."""
    found = DETECTOR([Frame(0, "", grey, (grey.shape[1], grey.shape[0]))])[0]
    assert isinstance(found, Detections)
    return list(zip(found.labels, found.boxes_px, strict=True))


def is_right(found: Found, kind: str, box: Floats) -> bool:
    """Is the sign among what was found, by its name?"""
    return any(label == kind and overlaps(box, b[None])[0] > 0.25 for label, b in found)


def large_scene(kind: Kind, seed: int) -> Scene:
    """A scene in the middle of a picture of a usual camera's size."""
    small, box = scene(kind, seed)
    grey = clutter(seed, (1280, 720))
    grey[180:540, 320:960] = small
    return Scene(grey, box + np.array([320, 180, 320, 180]))


DETECTOR = build(**RULES.model_dump())


def main() -> None:
    """Both in turn on each scene."""
    cv2.setNumThreads(1)
    naive = NaiveSearch()
    scenes = [(AMERICAN[i % 3], large_scene(AMERICAN[i % 3], 40 + i)) for i in range(ROUNDS + 1)]
    ours(scenes[0][1].grey)
    seconds: dict[str, list[float]] = {"ours": [], "one ORB per window": []}
    right = dict.fromkeys(seconds, 0)
    for kind, (grey, box) in scenes:
        for name, search in (("ours", ours), ("one ORB per window", naive)):
            began = time.perf_counter()
            found = search(grey)
            seconds[name].append(time.perf_counter() - began)
            right[name] += is_right(found, kind, box)
    base = median(seconds["ours"])
    print(f"{'1280 x 720, simulated':22} {'ms':>10} {'times ours':>11} {'signs found':>12}")
    for name, taken in seconds.items():
        middle = median(taken)
        share = f"{right[name]} of {len(scenes)}"
        print(f"{name:22} {middle * 1e3:10.1f} {middle / base:11.1f} {share:>12}")


if __name__ == "__main__":
    main()
