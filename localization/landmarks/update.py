"""Landmarks weighed into the pose: search in the ellipse, match, gate, update.

A picture is compared only with landmarks inside the 2-sigma ellipse of the camera's estimated
position. A match measures that position: the landmark's coordinates, with the landmark's own
covariance. The camera sits ``lever_m`` before the rear axle, so that heading takes part:

    z = p + R(heading) lever,    H = [I, dR/dheading lever, 0]

with the update in Joseph form (Bar-Shalom, Li, Kirubarajan, eq. 5.2.3-18).

A car that drives by a landmark matches it many times, from far off at first. It counts once, at its
best: when the score has fallen from its peak, the position at the peak is weighed in, carried to
the present by the motion estimated since. A landmark's error is the same every time, so it counts
again only after ``revisit_m``.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.localization.angles import wrap
from crosscue.localization.ekf import PoseBelief, Updated
from crosscue.localization.pose_filter import HEADING, SPEED
from crosscue.localization.pose_track import ACCEPTED, REJECTED

from .database import REACH_SIGMAS, LandmarkDatabase, Nearby, Place
from .features import Features, Match, Matcher
from .sighting import Sighting

FALLEN_SHARE: Final = 0.8
"""A score below this fraction of its peak has passed it."""


@dataclass(frozen=True, slots=True)
class LandmarkSettings:
    """How landmarks are searched for and weighed.

    Attributes:
        min_score: Matches with a lower score are ignored; ``crosscue fit landmarks`` chooses it.
        sigmas: Size of the search ellipse.
        max_candidates: Compare with no more landmarks than these, the nearest.
        gate_nis: Refuse a match whose normalised innovation squared is larger; None accepts all.
        interval_m: Look again once the car has gone this far.
        revisit_m: A landmark counts again once the car has gone this far since it counted.
        lever_m: The camera's place ahead of and to the left of the rear axle.
    """

    min_score: float = 20.0
    sigmas: float = 2.0
    max_candidates: int = 50
    gate_nis: float | None = 13.8
    interval_m: float = 1.0
    revisit_m: float = 100.0
    lever_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Refuse values that mean nothing.

        Raises:
            ValueError: Naming the field and the value.
        """
        if not 0.0 < self.sigmas <= REACH_SIGMAS:
            raise ValueError(f"sigmas: expected 0 to {REACH_SIGMAS}, got {self.sigmas}")
        for name in ("min_score", "max_candidates", "interval_m", "revisit_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name}: expected >= 0, got {value}")


@dataclass(slots=True)
class LandmarkCounts:
    """What became of the frames, for the manifest.

    Attributes:
        frames: Pictures that came up.
        thinned: Not examined: too soon after the last one.
        late: Not examined: before the belief's time.
        undecodable: Not examined: the picture does not decode.
        without_candidate: No landmark inside the ellipse, so that nothing was decoded.
        candidates: Landmarks compared, over all frames.
        matched: Frames whose best score was high enough.
        repeated: Peaks of a landmark that had counted a short while before.
        accepted: Landmarks weighed in.
        gated: Landmarks refused by the gate.
    """

    frames: int = 0
    thinned: int = 0
    late: int = 0
    undecodable: int = 0
    without_candidate: int = 0
    candidates: int = 0
    matched: int = 0
    repeated: int = 0
    accepted: int = 0
    gated: int = 0

    def as_dict(self) -> dict[str, int]:
        """Plain numbers by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


class Best(NamedTuple):
    """The best of one frame's candidates."""

    place: Place
    match: Match


def camera_position(
    belief: PoseBelief, lever_m: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The camera's estimated position, shape (2,), and its covariance, shape (2, 2)."""
    expected, observe = _observed(belief, lever_m)
    cov = observe @ belief.cov @ observe.T
    return expected, 0.5 * (cov + cov.T)


def update_camera_position(
    belief: PoseBelief,
    xy_m: NDArray[np.float64],
    cov_m2: NDArray[np.float64],
    lever_m: tuple[float, float] = (0.0, 0.0),
    gate_nis: float | None = None,
) -> Updated:
    """Weigh in a measured position of the camera; with no lever, ``ekf.update_position``.

    Raises:
        ValueError: Wrong shape, not finite, or ``cov_m2`` not positive definite.
    """
    if xy_m.shape != (2,) or not np.isfinite(xy_m).all():
        raise ValueError(f"xy_m: expected two finite numbers, got {xy_m}")
    if cov_m2.shape != (2, 2) or not np.isfinite(cov_m2).all():
        raise ValueError(f"cov_m2: expected finite (2, 2), got {cov_m2.tolist()}")
    if (np.linalg.eigvalsh(cov_m2) <= 0.0).any() or not np.allclose(cov_m2, cov_m2.T):
        raise ValueError(f"cov_m2: expected positive definite, got {cov_m2.tolist()}")
    expected, observe = _observed(belief, lever_m)
    innovation = xy_m - expected
    spread = observe @ belief.cov @ observe.T + cov_m2
    nis = float(innovation @ np.linalg.solve(spread, innovation))
    if gate_nis is not None and nis > gate_nis:
        return Updated(belief, False, innovation, nis)
    gain = np.linalg.solve(spread, observe @ belief.cov).T
    keep = np.eye(4) - gain @ observe
    cov = keep @ belief.cov @ keep.T + gain @ cov_m2 @ gain.T
    mean = belief.mean + gain @ innovation
    mean[HEADING] = wrap(mean[HEADING])
    return Updated(PoseBelief(belief.t_ns, mean, 0.5 * (cov + cov.T)), True, innovation, nis)


def _observed(
    belief: PoseBelief, lever_m: tuple[float, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The camera's expected position and its Jacobian by the state."""
    c, s = math.cos(belief.mean[HEADING]), math.sin(belief.mean[HEADING])
    ahead, left = lever_m
    offset = np.array([c * ahead - s * left, s * ahead + c * left])
    observe = np.eye(2, 4)
    observe[:, HEADING] = -offset[1], offset[0]
    return belief.mean[:2] + offset, observe


def best_of(
    seen: Features, candidates: tuple[Nearby, ...], database: LandmarkDatabase, matcher: Matcher
) -> Best | None:
    """The candidate that matches best; of equals the nearest. None without a candidate.

    Raises:
        LogFormatError: The database is damaged.
    """
    best: Best | None = None
    for candidate in candidates:
        match = matcher.match(seen, database.features(candidate.key))
        if best is None or match.score > best.match.score:
            best = Best(candidate.place, match)
    return best


class _Peak(NamedTuple):
    place: Place
    score: float
    travelled_m: float
    heading_rad: float


@dataclass(slots=True)
class LandmarkSearch:
    """Keeps what one frame's look needs of the frames before it.

    Attributes:
        database: Open.
        matcher: Of the database's kind.
        settings: How.
        counts: What became of the frames.
        sightings: Landmarks that reached the filter since they were last taken.
    """

    database: LandmarkDatabase
    matcher: Matcher
    settings: LandmarkSettings
    counts: LandmarkCounts = field(default_factory=LandmarkCounts)
    sightings: list[Sighting] = field(default_factory=list)
    _looked_m: float | None = None
    _peak: _Peak | None = None
    _counted_m: dict[str, float] = field(default_factory=dict)

    def look(
        self, belief: PoseBelief, travelled_m: float, describe: Callable[[], Features | None]
    ) -> PoseBelief | None:
        """Look at one frame.

        Args:
            belief: At the frame's time.
            travelled_m: Distance driven so far.
            describe: Returns the frame's features, or None if it does not decode; asked only where
                there is something to compare with.

        Returns:
            The posterior, or None where nothing was weighed in.
        """
        self.counts.frames += 1
        gone_m = math.inf if self._looked_m is None else travelled_m - self._looked_m
        if gone_m < self.settings.interval_m:
            self.counts.thinned += 1
            return None
        self._looked_m = travelled_m
        camera_m, cov_m2 = camera_position(belief, self.settings.lever_m)
        best = self._best(camera_m, cov_m2, describe)
        passed = self._passed(best, belief, travelled_m)
        return None if passed is None else self._weigh(belief, travelled_m, passed)

    def cross_gap(self) -> None:
        """Forget the landmark in view: nobody measured how far it has been left behind."""
        self._peak = None

    def take_sightings(self) -> list[Sighting]:
        """The sightings since the last call."""
        taken, self.sightings = self.sightings, []
        return taken

    def _best(
        self,
        camera_m: NDArray[np.float64],
        cov_m2: NDArray[np.float64],
        describe: Callable[[], Features | None],
    ) -> Best | None:
        settings = self.settings
        candidates = self.database.near(camera_m, cov_m2, settings.sigmas, settings.max_candidates)
        if not candidates:
            self.counts.without_candidate += 1
            return None
        seen = describe()
        if seen is None:
            self.counts.undecodable += 1
            return None
        self.counts.candidates += len(candidates)
        best = best_of(seen, candidates, self.database, self.matcher)
        if best is None or best.match.score < settings.min_score:
            return None
        self.counts.matched += 1
        return best

    def _passed(self, best: Best | None, belief: PoseBelief, travelled_m: float) -> _Peak | None:
        """The peak that this frame shows to be over."""
        peak = self._peak
        here = None
        if best is not None:
            heading = float(belief.mean[HEADING])
            here = _Peak(best.place, best.match.score, travelled_m, heading)
        if peak is not None and here is not None and here.place.name == peak.place.name:
            if here.score >= peak.score:
                self._peak = here
                return None
            if here.score >= FALLEN_SHARE * peak.score:
                return None
            # What is left of this landmark leaves the view and is not a new peak.
            here = here._replace(score=math.inf)
        self._peak = here
        return None if peak is None or math.isinf(peak.score) else peak

    def _weigh(self, belief: PoseBelief, travelled_m: float, peak: _Peak) -> PoseBelief | None:
        place = peak.place
        counted_m = self._counted_m.get(place.name)
        if counted_m is not None and travelled_m - counted_m < self.settings.revisit_m:
            self.counts.repeated += 1
            return None
        carried_m = place.xy_m + self._moved(belief, travelled_m, peak)
        done = update_camera_position(
            belief, carried_m, place.cov_m2, self.settings.lever_m, self.settings.gate_nis
        )
        outcome = ACCEPTED if done.is_accepted else REJECTED
        self.sightings.append(
            Sighting(
                belief.t_ns, place.name, carried_m, place.cov_m2, peak.score, done.nis, outcome
            )
        )
        if not done.is_accepted:
            self.counts.gated += 1
            return None
        self.counts.accepted += 1
        self._counted_m[place.name] = travelled_m
        return done.belief

    def _moved(self, belief: PoseBelief, travelled_m: float, peak: _Peak) -> NDArray[np.float64]:
        """How far the camera has moved since the peak.

        From way and heading, not from the two estimated positions: what the filter corrected
        meanwhile is not motion.
        """
        heading = float(belief.mean[HEADING])
        turned = wrap(heading - peak.heading_rad)
        way_m = math.copysign(travelled_m - peak.travelled_m, belief.mean[SPEED])
        middle = heading - 0.5 * turned
        lever = complex(*self.settings.lever_m)
        swung = lever * (cmath.exp(1j * heading) - cmath.exp(1j * peak.heading_rad))
        moved = way_m * cmath.exp(1j * middle) + swung
        return np.array([moved.real, moved.imag])
