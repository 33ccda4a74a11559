"""A simulated drive past landmarks whose 'pictures' encode the position of the camera."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from crosscue.localization.ekf import PoseBelief
from crosscue.localization.landmarks.database import (
    LandmarkDatabase,
    LandmarkPosition,
    LandmarkWriter,
)
from crosscue.localization.landmarks.features import Keypoints, Match
from crosscue.localization.landmarks.update import LandmarkSearch, LandmarkSettings
from crosscue.replay.columns import Bytes, Floats
from support.simulated_drive import Truth


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
