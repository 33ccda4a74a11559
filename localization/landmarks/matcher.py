"""Matcher of ORB features, by ratio test and scene geometry.

See E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011. Two points match
if they are mutual nearest neighbours in Hamming distance, much nearer than the second neighbour.
The matches are verified with a homography (a plane, or a camera that only rotates). OpenCV
estimates it with a fixed seed, so the result is deterministic. The score is the number of
consistent points.
"""

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes

from .features import CameraGeometry, Keypoints, Match

# Minimum side of a picture: the size of ORB's patches.
_MIN_SIDE_PX: Final = 32
# Minimum number of pairs for a homography, which four points always fit.
_MIN_PAIRS: Final = 6
# Maximum length of a picture's longer side; larger pictures are scaled down.
_SIDE_PX: Final = 1280
# Upper bound of the nearest neighbour's distance over the second's.
_RATIO: Final = 0.8
# Maximum error of a consistent point.
_TOLERANCE_PX: Final = 4.0


class OrbMatcher:
    """The ``Matcher`` of ORB features."""

    kind: Final = "orb"

    def __init__(self, features: int = 500) -> None:
        """Create the matcher of at most this number of points per picture."""
        self._features = features

    def describe(self, grey: Bytes, /) -> Keypoints:
        """Extract the picture's ORB features; see ``Matcher``."""
        height, width = grey.shape
        scale = min(1.0, _SIDE_PX / max(width, height))
        if scale < 1.0:
            size = (max(round(width * scale), 1), max(round(height * scale), 1))
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        if min(grey.shape) < _MIN_SIDE_PX:
            return Keypoints(width, height, *_nothing())
        orb_features = cv2.ORB.create(nfeatures=self._features)
        points, descriptors = orb_features.detectAndCompute(grey, None)
        if descriptors is None or not len(points):
            return Keypoints(width, height, *_nothing())
        at = np.array([point.pt for point in points], np.float32) / np.float32(scale)
        return Keypoints(width, height, at, np.asarray(descriptors, np.uint8))

    def match(self, seen: Keypoints, known: Keypoints, /) -> Match:
        """Count the consistent points; see ``Matcher``."""
        if (
            len(seen) < 2
            or len(known) < 2
            or seen.descriptors.shape[1] != known.descriptors.shape[1]
        ):
            return Match(0.0, 0, 0)
        here, there = self._pairs(seen, known)
        if len(here) < _MIN_PAIRS:
            return Match(0.0, len(here), 0)
        agreeing = self._agreeing(here, there)
        return Match(float(agreeing), len(here), agreeing)

    def _pairs(
        self, seen: Keypoints, known: Keypoints
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Matching points of both pictures, shape (N, 2) each."""
        found = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(seen.descriptors, known.descriptors, k=2)
        good = [first for first, second in found if first.distance < _RATIO * second.distance]
        # If several points have the same neighbour, only the nearest is kept.
        best: dict[int, tuple[float, int]] = {}
        for one in good:
            rank = (one.distance, one.queryIdx)
            best[one.trainIdx] = min(best.get(one.trainIdx, rank), rank)
        pairs = np.array([(i, j) for j, (_, i) in sorted(best.items())], np.intp).reshape(-1, 2)
        return seen.points_px[pairs[:, 0]], known.points_px[pairs[:, 1]]

    def _agreeing(self, here: NDArray[np.float32], there: NDArray[np.float32]) -> int:
        params = cv2.UsacParams()
        params.randomGeneratorState = 5
        params.confidence = 0.999
        params.maxIterations = 2000
        params.threshold = _TOLERANCE_PX
        try:
            _, mask = cv2.findHomography(here, there, params)
        except cv2.error:
            # All points coincide or are on one line, so the geometry is undefined.
            return 0
        return 0 if mask is None else int(np.count_nonzero(mask))


def _nothing() -> tuple[NDArray[np.float32], Bytes]:
    return np.empty((0, 2), np.float32), np.empty((0, 32), np.uint8)


def orb(camera: CameraGeometry) -> OrbMatcher:
    """Build a matcher of ORB features; it needs nothing of the camera."""
    return OrbMatcher()
