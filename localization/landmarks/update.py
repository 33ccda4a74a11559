"""Update the pose with landmarks: search in the ellipse, match, gate, update.

A picture is compared only with landmarks inside the 2-sigma ellipse of the camera's estimated
position. A match measures that position: the landmark's coordinates, with the landmark's
covariance.

A car that passes a landmark matches it many times, at first from a distance. It is used once, at
the best match: when the score has fallen from its peak, the position at the peak is moved to the
current time by the estimated motion and used as measurement. A landmark's error is the same every
time, so it is used again only after ``revisit_m``.
"""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np

from crosscue.localization.angles import wrap
from crosscue.localization.ekf import PoseBelief, pack_belief, update_point
from crosscue.localization.pose_filter import HEADING, SPEED, at_point
from crosscue.localization.pose_track import ACCEPTED, REJECTED
from crosscue.replay.columns import Floats

from .database import LandmarkDatabase, LandmarkPosition, Nearby
from .features import Keypoints, Match, Matcher
from .sighting import Sighting

# Fraction of the peak score below which the peak is over.
FALLEN_FRACTION: Final = 0.8


@dataclass(frozen=True, slots=True)
class LandmarkSettings:
    """Settings of the search for landmarks and of their use.

    Attributes:
        min_score: Minimum score of a match; ``crosscue fit landmarks`` fits it.
        sigmas: Size of the search ellipse.
        max_candidates: Maximum number of landmarks to compare, the nearest first.
        gate_nis: Normalised innovation squared above which a match is rejected; None accepts all.
        interval_m: Distance between two frames that are examined.
        revisit_m: Distance after which the same landmark can be used again.
        lever_m: Position of the camera, ahead of and to the left of the rear axle.
    """

    min_score: float = 20.0
    sigmas: float = 2.0
    max_candidates: int = 50
    gate_nis: float | None = 13.8
    interval_m: float = 1.0
    revisit_m: float = 100.0
    lever_m: tuple[float, float] = (0.0, 0.0)


@dataclass(slots=True)
class LandmarkCounts:
    """Account of the frames, for the manifest.

    Attributes:
        frames: Number of pictures processed.
        thinned: Pictures skipped because they are too soon after the last examined one.
        late: Pictures skipped because they are before the belief's time.
        undecodable: Pictures skipped because they do not decode.
        without_candidate: Pictures not decoded because no landmark is inside the ellipse.
        candidates: Number of landmarks compared, over all frames.
        matched: Frames whose best score was high enough.
        repeated: Peaks of landmarks that had been used within ``revisit_m``.
        accepted: Landmarks used.
        gated: Landmarks rejected by the gate.
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


class Best(NamedTuple):
    """Best candidate of one frame."""

    place: LandmarkPosition
    match: Match


def best_candidate(
    seen: Keypoints, candidates: tuple[Nearby, ...], database: LandmarkDatabase, matcher: Matcher
) -> Best | None:
    """Find the best matching candidate, the nearest of equal ones; None without candidates.

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
    place: LandmarkPosition
    score: float
    travelled_m: float
    heading_rad: float


@dataclass(slots=True)
class LandmarkSearch:
    """Search for landmarks in a sequence of frames.

    Attributes:
        database: An open database.
        matcher: A matcher of the database's kind.
        settings: Settings of search and use.
        counts: Account of the frames.
        sightings: Landmarks that reached the filter since ``take_sightings`` was last called.
    """

    database: LandmarkDatabase
    matcher: Matcher
    settings: LandmarkSettings
    counts: LandmarkCounts = field(default_factory=LandmarkCounts)
    sightings: list[Sighting] = field(default_factory=list)
    _looked_m: float | None = None
    _peak: _Peak | None = None
    _counted_m: dict[str, float] = field(default_factory=dict)

    def process(
        self, belief: PoseBelief, travelled_m: float, describe: Callable[[], Keypoints | None]
    ) -> PoseBelief | None:
        """Process one frame.

        Args:
            belief: Belief at the frame's time.
            travelled_m: Distance driven so far.
            describe: Returns the frame's features, or None if it does not decode; called only if
                there are candidates.

        Returns:
            The posterior, or None without an update.
        """
        self.counts.frames += 1
        gone_m = math.inf if self._looked_m is None else travelled_m - self._looked_m
        if gone_m < self.settings.interval_m:
            self.counts.thinned += 1
            return None
        self._looked_m = travelled_m
        camera = at_point(pack_belief(belief), *self.settings.lever_m)
        cov_m2 = np.array([[camera.xx, camera.xy], [camera.xy, camera.yy]])
        best = self._best(np.array([camera.x_m, camera.y_m]), cov_m2, describe)
        passed = self._passed(best, belief, travelled_m)
        return None if passed is None else self._weigh(belief, travelled_m, passed)

    def cross_gap(self) -> None:
        """Forget the landmark in view, because the distance since its peak is unknown."""
        self._peak = None

    def take_sightings(self) -> list[Sighting]:
        """Return the sightings since the last call."""
        taken, self.sightings = self.sightings, []
        return taken

    def _best(
        self, camera_m: Floats, cov_m2: Floats, describe: Callable[[], Keypoints | None]
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
        best = best_candidate(seen, candidates, self.database, self.matcher)
        if best is None or best.match.score < settings.min_score:
            return None
        self.counts.matched += 1
        return best

    def _passed(self, best: Best | None, belief: PoseBelief, travelled_m: float) -> _Peak | None:
        """Return the peak that is over with this frame; None if there is no such peak."""
        peak = self._peak
        here = None
        if best is not None:
            heading = float(belief.mean[HEADING])
            here = _Peak(best.place, best.match.score, travelled_m, heading)
        if peak is not None and here is not None and here.place.name == peak.place.name:
            if here.score >= peak.score:
                self._peak = here
                return None
            if here.score >= FALLEN_FRACTION * peak.score:
                return None
            # The remaining matches of this landmark are not a new peak.
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
        done = update_point(
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

    def _moved(self, belief: PoseBelief, travelled_m: float, peak: _Peak) -> Floats:
        """Displacement of the camera since the peak.

        It is computed from distance and heading, not from the two estimated positions, because the
        filter's corrections since then are not motion.
        """
        heading = float(belief.mean[HEADING])
        turned = wrap(heading - peak.heading_rad)
        way_m = math.copysign(travelled_m - peak.travelled_m, belief.mean[SPEED])
        middle = heading - 0.5 * turned
        lever = complex(*self.settings.lever_m)
        swung = lever * (cmath.exp(1j * heading) - cmath.exp(1j * peak.heading_rad))
        moved = way_m * cmath.exp(1j * middle) + swung
        return np.array([moved.real, moved.imag])
