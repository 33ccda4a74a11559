"""Our sign search next to one ORB run per window and level, on the same simulated scenes.

Both search for the same templates on the same pyramid levels, with the same kind of features and
the same ratio test. The peer slides a window of each template size in steps of 16 pixels, and runs
ORB once per window for all templates of that size; a window's score is the fraction of a template's
features that it contains. "one size" uses a single window as large as the largest template, which
is the min number of ORB runs.

On small pictures (templates over clutter), both search everywhere, and the signs found are counted.
In simulated streets of a typical camera's size, the peer examines every 40th window on all levels,
and its time is scaled up. The time for resizing the picture is not counted for the peer.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from statistics import median
from typing import NamedTuple

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from crosscue.datasets.scenes.rendering.render import Renderer
from crosscue.datasets.scenes.settings import SceneSettings, world_of
from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.signs.detector import POINTS_DRAWN, SignSettings, build, orb_points
from crosscue.detectors.signs.templates import AMERICAN, Kind, drawings
from crosscue.replay.columns import Bytes, Floats
from support.sign_scenes import scene

STRIDE_PX = 16
ROUNDS = 5
SCENES = 6
ONE_IN = 40
RULES = SignSettings(crop_bottom=0.0)
MIN_SHARE = 0.1
Size = tuple[int, int]
Found = list[tuple[str, Floats]]


class Drawn(NamedTuple):
    """A template in the peer's form."""

    kind: Kind
    size_px: Size
    described: Bytes


class Window(NamedTuple):
    """A window of the peer: a view of a level with its position in the picture."""

    pixels: Bytes
    box: Floats


class WindowSearch:
    """The dissertation's search, which runs ORB and the matcher in every window of each level."""

    def __init__(self, has_one_size: bool) -> None:
        """Compute the descriptors of the templates once."""
        self._orb = cv2.ORB.create(
            nfeatures=POINTS_DRAWN,
            nlevels=1,
            edgeThreshold=8,
            patchSize=16,
            fastThreshold=RULES.fast,
        )
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        drawn = drawings(AMERICAN, RULES.heights_px)
        shapes = [(one.grey.shape[1], one.grey.shape[0]) for one in drawn]
        largest = (max(w for w, _ in shapes), max(h for _, h in shapes))
        self._by_size: dict[Size, list[Drawn]] = {}
        for one, shape in zip(drawn, shapes, strict=True):
            words = orb_points(one.grey, POINTS_DRAWN, RULES.drawing_fast).words
            of_size = self._by_size.setdefault(largest if has_one_size else shape, [])
            of_size.append(Drawn(one.kind, one.size_px, words.view(np.uint8)))

    def __call__(self, grey: Bytes) -> Found:
        """Return the best window if it contains a tenth of a template's points."""
        best: tuple[float, str, Floats] = (MIN_SHARE, "", np.zeros(4))
        for size, of_size in self._by_size.items():
            for window in self._windows(grey, size):
                best = max(best, *self._fractions(window, of_size), key=lambda one: one[0])
        return [(best[1], best[2])] if best[1] else []

    def seconds(self, grey: Bytes, first: int) -> float:
        """Return the scaled seconds of a search of every ``ONE_IN``-th window of each level."""
        taken, looked, there = 0.0, 0, 0
        for size, of_size in self._by_size.items():
            for number, window in enumerate(self._windows(grey, size)):
                there += 1
                if number % ONE_IN == first:
                    looked += 1
                    began = time.perf_counter()
                    self._fractions(window, of_size)
                    taken += time.perf_counter() - began
        return taken / looked * there

    def _windows(self, grey: Bytes, size: Size) -> Iterator[Window]:
        width, height = size
        for level in range(RULES.levels):
            scale = RULES.enlarge / RULES.factor**level
            small = np.asarray(cv2.resize(grey, None, fx=scale, fy=scale), np.uint8)
            for y in range(0, small.shape[0] - height + 1, STRIDE_PX):
                for x in range(0, small.shape[1] - width + 1, STRIDE_PX):
                    box = np.array([x, y, x + width, y + height], np.float64) / scale
                    yield Window(small[y : y + height, x : x + width], box)

    def _fractions(self, window: Window, drawn: list[Drawn]) -> list[tuple[float, str, Floats]]:
        points = self._described(window.pixels)
        if len(points) < RULES.min_votes:
            return [(0.0, "", window.box)]
        found: list[tuple[float, str, Floats]] = []
        for one in drawn:
            pairs = self._matcher.knnMatch(points, one.described, k=2)
            alike = {
                a.trainIdx
                for a, b in pairs
                if a.distance < RULES.ratio * b.distance and a.distance <= RULES.max_bits
            }
            found.append((len(alike) / len(one.described), one.kind, _about(window, one.size_px)))
        return found

    def _described(self, grey: Bytes) -> Bytes:
        # As fast as OpenCV's combined call; upright, because rotated one-way arrows are alike.
        keypoints = self._orb.detect(grey, None)
        for keypoint in keypoints:
            keypoint.angle = 0.0
        _, descriptors = self._orb.compute(grey, keypoints)
        return np.empty((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors)


def _about(window: Window, size_px: Size) -> Floats:
    """Return the box of the sign in the middle of a window."""
    scale = window.pixels.shape[1] / (window.box[2] - window.box[0])
    middle = (window.box[:2] + window.box[2:]) / 2.0
    half = np.array(size_px) / (2.0 * scale)
    return np.concatenate([middle - half, middle + half])


def ours(grey: Bytes) -> Found:
    """Return the boxes of our detector."""
    found = DETECTOR([Frame(0, "", grey, (grey.shape[1], grey.shape[0]))])[0]
    assert isinstance(found, Detections)
    return list(zip(found.labels, found.boxes_px, strict=True))


def is_right(found: Found, kind: str, box: Floats) -> bool:
    """Return whether the sign is among the detections, with its label."""
    return any(label == kind and box_ious(box, b[None])[0] > 0.25 for label, b in found)


def streets() -> list[Bytes]:
    """Return pictures of simulated approaches to intersections."""
    found = []
    for i in range(ROUNDS):
        settings = SceneSettings(f"L{800 + i}", i + 1)
        _, _, world = world_of(settings)
        t_s = float(np.argmax(world.approach.motion.x_m >= -20.0)) / 100.0
        rgb = Renderer(world, settings.camera, settings.picture).picture(t_s).rgb
        found.append(np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8))
    return found


DETECTOR = build(**RULES.model_dump())
PEERS = {"one ORB a window": WindowSearch(False), "one size": WindowSearch(True)}


def timed(search: Callable[[], object]) -> float:
    """Return the wall seconds of a call."""
    began = time.perf_counter()
    search()
    return time.perf_counter() - began


def signs_found() -> None:
    """Print the signs found and the time of complete searches on small pictures."""
    searches: dict[str, Callable[[Bytes], Found]] = {"ours": ours, **PEERS}
    kinds = [AMERICAN[i % 3] for i in range(SCENES)]
    scenes = [scene(kind, 40 + i) for i, kind in enumerate(kinds)]
    seconds: dict[str, list[float]] = {name: [] for name in searches}
    right = dict.fromkeys(searches, 0)
    for kind, (grey, box) in zip(kinds, scenes, strict=True):
        for name, search in searches.items():
            began = time.perf_counter()
            found = search(grey)
            seconds[name].append(time.perf_counter() - began)
            right[name] += is_right(found, kind, box)
    print_table("640 x 360, all windows", seconds)
    for name, count in right.items():
        print(f"  {name}: {count} of {SCENES} signs found")


def speed() -> None:
    """Print times on pictures of a typical size; the peers search a part of the windows."""
    seconds: dict[str, list[float]] = {name: [] for name in ("ours", *PEERS)}
    for i, grey in enumerate(streets()):
        seconds["ours"].append(median(timed(partial(ours, grey)) for _ in range(5)))
        for name, peer in PEERS.items():
            seconds[name].append(peer.seconds(grey, 8 * i))
    print_table(f"1280 x 720, peers 1 window in {ONE_IN}", seconds)


def print_table(what: str, seconds: dict[str, list[float]]) -> None:
    """Print median times, and medians of the ratios on the same picture."""
    print(f"{what:34} {'ms':>10} {'times ours':>11}")
    for name, taken in seconds.items():
        ratio = median(a / b for a, b in zip(taken, seconds["ours"], strict=True))
        print(f"{name:34} {median(taken) * 1e3:10.1f} {ratio:11.1f}")


def main() -> None:
    """Print the signs found, then the speed."""
    cv2.setNumThreads(1)
    ours(scene(AMERICAN[0], 1).grey)
    signs_found()
    speed()


if __name__ == "__main__":
    main()
