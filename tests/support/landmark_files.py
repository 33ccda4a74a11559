"""Small landmark databases and simulated pictures of landmarks."""

from pathlib import Path

import cv2
import numpy as np

from crosscue.localization.landmarks.database import LandmarkPosition, LandmarkWriter
from crosscue.localization.landmarks.features import CameraGeometry, Keypoints, Match
from crosscue.replay.columns import Bytes, Floats


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
