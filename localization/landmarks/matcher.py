"""ORB features, compared by ratio test and the geometry of one scene.

E. Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011. Points of two
pictures that look alike (nearest neighbour in Hamming distance, well ahead of the second, and
mutual) are held against one homography (a plane, or a camera that only turned) or one essential
matrix (any rigid scene, seen by one known camera). Both estimates are OpenCV's, drawn with a fixed
seed, so that the answer is the same every time. The score is the number of agreeing points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import Bytes, UsageError

from .features import CameraGeometry, Features, Match

_MIN_SIDE_PX: Final = 32
"""ORB examines patches of this size."""
_MIN_PAIRS: Final = {"homography": 6, "essential": 8}
"""Below these a fit says nothing: four or five points fit one by making."""


@dataclass(frozen=True, slots=True)
class OrbSettings:
    """How ORB features are made and compared.

    Attributes:
        features: Most points kept of one picture.
        side_px: Pictures with a longer side are made smaller first.
        ratio: The nearest neighbour's distance by the second's must be below.
        tolerance_px: How far an agreeing point may be off.
        geometry: What agreeing points share.
        camera: Needed for ``essential``; the same camera for database and drive.
    """

    features: int = 500
    side_px: int = 1280
    ratio: float = 0.8
    tolerance_px: float = 4.0
    geometry: Literal["homography", "essential"] = "homography"
    camera: CameraGeometry = field(default_factory=CameraGeometry)

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ValueError: Naming the field and the value.
        """
        if not 0.0 < self.ratio <= 1.0:
            raise ValueError(f"ratio: expected 0 to 1, got {self.ratio}")
        for name in ("features", "side_px", "tolerance_px"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected > 0, got {getattr(self, name)}")


class OrbMatcher:
    """The ``Matcher`` of ORB features."""

    kind: Final = "orb"

    def __init__(self, settings: OrbSettings) -> None:
        """Compare as ``settings`` say."""
        self.settings: Final = settings

    def describe(self, grey: Bytes, /) -> Features:
        """The picture's ORB features; see ``Matcher``."""
        import cv2

        height, width = grey.shape
        scale = min(1.0, self.settings.side_px / max(width, height))
        if scale < 1.0:
            size = (max(round(width * scale), 1), max(round(height * scale), 1))
            grey = np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)
        if min(grey.shape) < _MIN_SIDE_PX:
            return Features(width, height, *_nothing())
        orb_features = cv2.ORB.create(nfeatures=self.settings.features)
        points, descriptors = orb_features.detectAndCompute(grey, None)
        if descriptors is None or not len(points):
            return Features(width, height, *_nothing())
        at = np.array([point.pt for point in points], np.float32) / np.float32(scale)
        return Features(width, height, at, np.asarray(descriptors, np.uint8))

    def match(self, seen: Features, known: Features, /) -> Match:
        """Count the points that agree; see ``Matcher``."""
        if (
            len(seen) < 2
            or len(known) < 2
            or seen.descriptors.shape[1] != known.descriptors.shape[1]
        ):
            return Match(0.0, 0, 0)
        here, there = self._pairs(seen, known)
        if len(here) < _MIN_PAIRS[self.settings.geometry]:
            return Match(0.0, len(here), 0)
        agreeing = self._agreeing(seen, here, there)
        return Match(float(agreeing), len(here), agreeing)

    def _pairs(
        self, seen: Features, known: Features
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Points that look alike, each shape (N, 2)."""
        import cv2

        found = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(seen.descriptors, known.descriptors, k=2)
        good = [
            first
            for first, second in found
            if first.distance < self.settings.ratio * second.distance
        ]
        # Of several points that chose the same one, the nearest has it.
        best: dict[int, tuple[float, int]] = {}
        for one in good:
            rank = (one.distance, one.queryIdx)
            best[one.trainIdx] = min(best.get(one.trainIdx, rank), rank)
        pairs = np.array([(i, j) for j, (_, i) in sorted(best.items())], np.intp).reshape(-1, 2)
        return seen.points_px[pairs[:, 0]], known.points_px[pairs[:, 1]]

    def _agreeing(
        self, seen: Features, here: NDArray[np.float32], there: NDArray[np.float32]
    ) -> int:
        import cv2

        params = cv2.UsacParams()
        params.randomGeneratorState = 5
        params.confidence = 0.999
        params.maxIterations = 2000
        params.threshold = self.settings.tolerance_px
        try:
            if self.settings.geometry == "homography":
                _, mask = cv2.findHomography(here, there, params)
            else:
                focal, (cx, cy) = self._camera_of(seen)
                params.threshold = self.settings.tolerance_px / focal
                centre = np.array([cx, cy], np.float32)
                same = np.eye(3)
                _, mask = cv2.findEssentialMat(
                    (here - centre) / np.float32(focal),
                    (there - centre) / np.float32(focal),
                    same,
                    same,
                    np.zeros(4),
                    np.zeros(4),
                    params,
                )
        except cv2.error:
            # Points on one spot or line: no such geometry, hence nothing that agrees.
            return 0
        return 0 if mask is None else int(np.count_nonzero(mask))

    def _camera_of(self, seen: Features) -> tuple[float, tuple[float, float]]:
        focal, centre = self.settings.camera
        assert focal is not None
        return focal, centre or (seen.width_px / 2.0, seen.height_px / 2.0)


def _nothing() -> tuple[NDArray[np.float32], Bytes]:
    return np.empty((0, 2), np.float32), np.empty((0, 32), np.uint8)


def orb(camera: CameraGeometry) -> OrbMatcher:
    """ORB and one homography."""
    return OrbMatcher(OrbSettings(camera=camera))


def orb_essential(camera: CameraGeometry) -> OrbMatcher:
    """ORB and one essential matrix.

    Raises:
        UsageError: The camera's focal length is not known.
    """
    if camera.focal_px is None or not math.isfinite(camera.focal_px):
        raise UsageError(
            "matcher 'orb-essential': needs camera.focal_px in the vehicle file; give it with "
            "--vehicle, or use orb"
        )
    return OrbMatcher(OrbSettings(geometry="essential", camera=camera))
