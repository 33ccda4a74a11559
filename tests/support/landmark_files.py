"""Landmarks: pictures and databases of places, and drives along them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from crosscue.localization.ekf import PoseBelief
from crosscue.localization.landmarks.database import (
    LandmarkDatabase,
    LandmarkPosition,
    LandmarkWriter,
)
from crosscue.localization.landmarks.features import CameraGeometry, Keypoints, Match
from crosscue.localization.landmarks.update import LandmarkSearch, LandmarkSettings
from crosscue.replay.columns import Bytes, Floats
from support.simulated_drive import Truth


def some_features(seed: int, count: int = 20) -> Keypoints:
    """Random descriptors of the size of ORB's."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, 640.0, (count, 2)).astype(np.float32)
    return Keypoints(640, 480, points, rng.integers(0, 256, (count, 32), dtype=np.uint8))


def place_at(
    x_m: float, y_m: float, name: str | None = None, sd_m: float = 2.0
) -> LandmarkPosition:
    """A landmark with an isotropic covariance."""
    return LandmarkPosition(
        name or f"at {x_m} {y_m}", np.array([x_m, y_m]), sd_m**2 * np.eye(2), 0.5, "made"
    )


def database_of(path: Path, xy_m: Floats, sd_m: float = 2.0, kind: str = "orb") -> Path:
    """Write a database with random features at positions of shape (N, 2), named ``0``, ``1``..."""
    with LandmarkWriter(path, kind) as writer:
        for i, (x, y) in enumerate(xy_m.tolist()):
            writer.add(place_at(x, y, str(i), sd_m), some_features(i))
    return path


def empty_database(path: Path) -> Path:
    return database_of(path, np.zeros((0, 2)))


def wall(seed: int, width_px: int = 640, height_px: int = 480) -> Bytes:
    """A simulated textured wall: grey, with random patches of all sizes."""
    rng = np.random.default_rng(seed)
    picture = np.full((height_px, width_px), 128, np.uint8)
    for _ in range(400):
        x, y = int(rng.integers(0, width_px)), int(rng.integers(0, height_px))
        w, h = (int(v) for v in rng.integers(4, 60, 2))
        shade = int(rng.integers(0, 256))
        cv2.rectangle(picture, (x, y), (x + w, y + h), shade, -1)
    return picture


def seen_from(picture: Bytes, turn_deg: float, scale: float, noise: float, seed: int) -> Bytes:
    """Simulate the same wall from another position: warped, darker and noisy."""
    height, width = picture.shape
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), turn_deg, scale)
    warp = np.vstack([turn, [1e-5 * turn_deg, 5e-6 * turn_deg, 1.0]])
    moved = cv2.warpPerspective(picture, warp, (width, height), borderMode=cv2.BORDER_REFLECT)
    rng = np.random.default_rng(seed)
    grey = 0.8 * moved.astype(np.float64) + rng.normal(10.0, noise, moved.shape)
    return np.clip(grey, 0, 255).astype(np.uint8)


def encoded(picture: Bytes, suffix: str = ".png") -> bytes:
    """The picture as the bytes of an image file."""
    ok, found = cv2.imencode(suffix, picture)
    assert ok
    return found.tobytes()


def write_walls(folder: Path, count: int = 4, size: tuple[int, int] = (640, 480)) -> None:
    """Write ``0.png``..., the same walls again as ``seen0.png``..., and all pairs of them."""
    pairs = ["query,known,same"]
    for k in range(count):
        known = wall(k, *size)
        (folder / f"{k}.png").write_bytes(encoded(known))
        (folder / f"seen{k}.png").write_bytes(encoded(seen_from(known, 3.0, 1.05, 4.0, k)))
        pairs += [f"seen{k}.png,{other}.png,{int(k == other)}" for other in range(count)]
    (folder / "pairs.csv").write_text("\n".join(pairs) + "\n")


class ShadeMatcher:
    """A custom matcher, which scores the similarity of mean brightness."""

    kind = "shade"

    def describe(self, grey: Bytes, /) -> Keypoints:
        """Return the mean brightness as 25 equal descriptors."""
        height, width = grey.shape
        shade = np.full((25, 1), round(float(grey.mean())), np.uint8)
        return Keypoints(width, height, np.zeros((25, 2), np.float32), shade)

    def match(self, seen: Keypoints, known: Keypoints, /) -> Match:
        """Return 100 minus the difference in brightness."""
        difference = abs(float(seen.descriptors[0, 0]) - float(known.descriptors[0, 0]))
        return Match(100.0 - difference, 25, 25)


def shade(camera: CameraGeometry) -> ShadeMatcher:
    """Build the matcher, for ``landmarks.matcher = "support.landmark_files:shade"``."""
    return ShadeMatcher()


def features_at(xy_m: Floats) -> Keypoints:
    """Features of the picture at a position, which encode the position itself."""
    where = np.ascontiguousarray(xy_m, np.float64).view(np.uint8).reshape(1, 16)
    return Keypoints(640, 480, np.zeros((1, 2), np.float32), where)


class NearnessMatcher:
    """A matcher with a score of 100 minus the distance of two pictures' positions in metres."""

    kind = "nearness"

    def __init__(self, range_m: float = 30.0) -> None:
        self.range_m = range_m
        self.compared = 0

    def describe(self, grey: Bytes, /) -> Keypoints:
        """Fail, because pictures are positions here."""
        raise AssertionError("pictures are places in this simulation")

    def match(self, seen: Keypoints, known: Keypoints, /) -> Match:
        """Score two pictures by their distance."""
        self.compared += 1
        here, other = (f.descriptors.reshape(-1).view(np.float64) for f in (seen, known))
        apart_m = float(np.hypot(*(here - other)))
        return Match(100.0 - apart_m if apart_m < self.range_m else 0.0, 1, 1)


def camera_path(truth: Truth, lever_m: tuple[float, float]) -> Floats:
    """True positions of the camera, shape (N, 2)."""
    lever = complex(*lever_m) * np.exp(1j * truth.xyh[:, 2])
    camera_m: Floats = truth.xyh[:, :2] + np.column_stack([lever.real, lever.imag])
    return camera_m


def landmarks_along(
    path: Path,
    truth: Truth,
    rng: np.random.Generator,
    every_m: float,
    cov_m2: Floats,
    lever_m: tuple[float, float] = (0.0, 0.0),
) -> Path:
    """Write landmarks along the camera's path, with errors drawn from ``cov_m2``."""
    camera_m = camera_path(truth, lever_m)
    way_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(camera_m, axis=0).T))])
    at = np.searchsorted(way_m, np.arange(every_m / 2, way_m[-1], every_m))
    with LandmarkWriter(path, NearnessMatcher.kind) as writer:
        for i, row in enumerate(at):
            xy = camera_m[row]
            off = rng.multivariate_normal([0.0, 0.0], cov_m2)
            writer.add(
                LandmarkPosition(str(i), xy + off, cov_m2, float(truth.xyh[row, 2])),
                features_at(xy),
            )
    return path


@dataclass(slots=True)
class PlaceMeasurements:
    """A ``MeasurementSource`` whose frames encode the true position of the camera."""

    search: LandmarkSearch
    truth: Truth
    every: int = 1
    lever_m: tuple[float, float] = (0.0, 0.0)
    times: list[int] = field(default_factory=list)

    def times_ns(self) -> Sequence[int]:
        """Times of every ``every``-th true sample."""
        times: list[int] = self.truth.t_ns[:: self.every].tolist()
        return times

    def update(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Match the picture at the true position."""
        row = int(np.searchsorted(self.truth.t_ns, belief.t_ns))
        camera_m = camera_path(self.truth, self.lever_m)[row]
        found = self.search.process(belief, travelled_m, lambda: features_at(camera_m))
        if found is not None:
            self.times.append(belief.t_ns)
        return found


def search_in(database: LandmarkDatabase, settings: LandmarkSettings) -> LandmarkSearch:
    """A search with ``NearnessMatcher``."""
    return LandmarkSearch(database, NearnessMatcher(), settings)
