"""Landmarks in a replay: frames are kept until the pose track reaches their time, then matched."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from crosscue.detectors.images import Encoded, lose
from crosscue.localization.ekf import PoseBelief
from crosscue.localization.landmarks.database import LandmarkDatabase
from crosscue.localization.landmarks.features import (
    CameraGeometry,
    Keypoints,
    Matcher,
    make_matcher,
)
from crosscue.localization.landmarks.images import copy_picture, grey_of
from crosscue.localization.landmarks.sighting import Sighting
from crosscue.localization.landmarks.update import LandmarkSearch, LandmarkSettings
from crosscue.localization.pose_track import ACCEPTED
from crosscue.replay.columns import Block, Images, Int64s
from crosscue.replay.errors import LogError, UsageError
from crosscue.replay.ledger import Ledger
from crosscue.replay.vehicle.vehicle import Vehicle


def landmark_settings(vehicle: Vehicle) -> LandmarkSettings:
    """Return the search settings from the [landmarks] section and the camera's mounting."""
    section, camera = vehicle.landmarks, vehicle.camera
    fields = section.model_dump(exclude={"matcher", "interval_s"})
    return LandmarkSettings(**fields, lever_m=(camera.x_m, camera.y_m))


def matcher_for(vehicle: Vehicle) -> Matcher:
    """Return the matcher named by the vehicle file.

    Raises:
        UsageError: The matcher does not exist.
    """
    camera = CameraGeometry(vehicle.camera.focal_px, vehicle.camera.center_px)
    return make_matcher(vehicle.landmarks.matcher, camera)


def open_for(path: Path, matcher: Matcher) -> LandmarkDatabase:
    """Open a database whose features ``matcher`` can compare.

    Raises:
        LogError: The database cannot be read.
        UsageError: The database holds another matcher's features.
    """
    database = LandmarkDatabase(path)
    if database.kind != matcher.kind:
        database.close()
        raise UsageError(
            f"{path}: holds features of matcher {database.kind!r}, not {matcher.kind!r}; set "
            "landmarks.matcher in the vehicle file, or choose another database"
        )
    return database


@dataclass(frozen=True, slots=True, order=True)
class _Frame:
    t_ns: int
    topic: str = field(compare=False)
    picture: Encoded = field(compare=False)


@dataclass(slots=True)
class LandmarkStage:
    """``MeasurementSource`` of a pose track that matches camera frames with a landmark database.

    Attributes:
        search: Search with database, matcher and counts.
        ledger: Ledger of the camera's log; pictures that do not decode are dropped in it.
        interval_ns: Min interval between frames that are kept.
        names: Accepted landmark by time, for the rows of the pose track.
    """

    search: LandmarkSearch
    ledger: Ledger
    interval_ns: int
    names: dict[int, str] = field(default_factory=dict)
    _frames: list[_Frame] = field(default_factory=list)
    _kept_ns: int | None = None

    def see(self, block: Block) -> None:
        """Keep the frames of a block, still encoded."""
        if not isinstance(block.rows, Images):
            return
        for row, t_ns in enumerate(block.log_ns.tolist()):
            if self._kept_ns is not None and abs(t_ns - self._kept_ns) < self.interval_ns:
                self.search.counts.frames += 1
                self.search.counts.thinned += 1
                continue
            self._kept_ns = t_ns
            insort(self._frames, _Frame(t_ns, block.topic, copy_picture(block.rows, row)))

    def times_ns(self) -> Sequence[int]:
        """Times of the waiting frames."""
        return [frame.t_ns for frame in self._frames]

    def update(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Match the frame at the belief's time; return the corrected belief, or None."""
        self.let_go(belief.t_ns)
        frame = self._frames.pop(0)
        found = self.search.process(belief, travelled_m, partial(self._describe, frame))
        for sighting in self.search.sightings:
            if sighting.outcome == ACCEPTED:
                self.names[sighting.t_ns] = sighting.name
        return found

    def cross_gap(self) -> None:
        """Forget matches before a gap in time, which do not show the position after it."""
        self.search.cross_gap()

    def take_sightings(self) -> list[Sighting]:
        """Return the sightings since the last call."""
        return self.search.take_sightings()

    def take_names(self, t_ns: Int64s) -> list[str | None]:
        """Return the accepted landmark, or None, at each row's time."""
        return [self.names.pop(t, None) for t in t_ns.tolist()]

    def let_go(self, before_ns: int) -> None:
        """Drop frames that are too old to be reached by odometry."""
        late = bisect_left(self._frames, before_ns, key=lambda frame: frame.t_ns)
        self.search.counts.frames += late
        self.search.counts.late += late
        del self._frames[:late]

    def counts(self) -> dict[str, int]:
        """Return the numbers of frames by outcome, for the manifest."""
        return asdict(self.search.counts)

    def _describe(self, frame: _Frame) -> Keypoints | None:
        try:
            return self.search.matcher.describe(grey_of(frame.picture))
        except LogError as error:
            lose(self.ledger, frame.topic, frame.t_ns, error)
            return None


def landmark_stage(database: LandmarkDatabase, vehicle: Vehicle, ledger: Ledger) -> LandmarkStage:
    """Return a stage that searches for the landmarks of a database, set up by the vehicle file."""
    search = LandmarkSearch(database, matcher_for(vehicle), landmark_settings(vehicle))
    return LandmarkStage(search, ledger, round(vehicle.landmarks.interval_s * 1e9))
