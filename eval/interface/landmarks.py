"""Landmark databases: add, list and match landmarks."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.fit.landmarks.database import (
    AddCounts,
    Frame,
    add_from_images,
    add_from_log,
    camera_frames,
    near_of,
    read_poses,
)
from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.localization.landmarks.database import LandmarkDatabase, LandmarkWriter, Place
from crosscue.localization.landmarks.images import grey_of, read_picture
from crosscue.replay.base import EmptyResultError, Floats, Ledger, UsageError, visible, warn_of
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

if TYPE_CHECKING:
    from crosscue.localization.landmarks.features import Match, Matcher


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class AddedLandmarks:
    """Result of adding landmarks; its repr is one line.

    Attributes:
        path: The database.
        counts: Numbers of pictures that were added or left out, by reason.
        is_whole: True if nothing of the log was dropped.
    """

    path: Path
    counts: AddCounts
    is_whole: bool = True

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue landmarks add``."""
        return {"database": str(self.path), **asdict(self.counts)}

    def __repr__(self) -> str:
        counts = self.counts
        left_out = [
            f"{count} {why}"
            for count, why in (
                (counts.too_near, "too near the last"),
                (counts.without_pose, "without a pose at their time"),
                (counts.undecodable, "cannot be decoded"),
                (counts.blank, "with too few features"),
            )
            if count
        ]
        rest = f"; left out: {', '.join(left_out)}" if left_out else ""
        return f"{self.path}: {counts.added} landmarks added from {counts.pictures} pictures{rest}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkList:
    """Landmarks of a database; its repr has one line per landmark.

    Attributes:
        path: The database.
        kind: Name of the matcher that its features belong to.
        total: Number of landmarks in the database.
        places: The selected landmarks.
    """

    path: Path
    kind: str
    total: int
    places: tuple[Place, ...]

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue landmarks list``."""
        listed = [
            {
                "name": place.name,
                "source": place.source,
                "xy_m": place.xy_m.tolist(),
                "cov_m2": place.cov_m2.tolist(),
                "heading_rad": place.heading_rad,
            }
            for place in self.places
        ]
        return {"matcher": self.kind, "landmarks": self.total, "listed": listed}

    def __repr__(self) -> str:
        head = f"{self.path}: {self.total} landmarks of matcher {self.kind}; "
        return "\n".join([f"{head}listed: {len(self.places)}", *map(_place_line, self.places)])


def _place_line(place: Place) -> str:
    sd_x, sd_y = math.sqrt(place.cov_m2[0, 0]), math.sqrt(place.cov_m2[1, 1])
    turn = "      -" if place.heading_rad is None else f"{math.degrees(place.heading_rad):7.1f}"
    x, y = place.xy_m
    return (
        f"{x:12.2f} {y:12.2f} m  +- {sd_x:6.2f} {sd_y:6.2f} m  heading {turn} deg  "
        f"{visible(place.name)}"
    )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkMatches:
    """The landmarks that are most similar to a picture; its repr has one line per landmark.

    Attributes:
        points: Number of feature points found in the picture.
        compared: Number of landmarks that it was compared with.
        min_score: Lowest score of a match.
        best: Names and matches, best first.
    """

    points: int
    compared: int
    min_score: float
    best: tuple[tuple[str, Match], ...]

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue landmarks match``."""
        rows = [
            {
                "name": name,
                "score": match.score,
                "pairs": match.pairs,
                "agreeing": match.agreeing,
                "is_match": match.score >= self.min_score,
            }
            for name, match in self.best
        ]
        return {
            "points": self.points,
            "compared": self.compared,
            "min_score": self.min_score,
            "best": rows,
        }

    def __repr__(self) -> str:
        lines = [
            f"{self.points} points; {self.compared} landmarks compared; min score of a match "
            f"{self.min_score:g}"
        ]
        for name, match in self.best:
            word = "match" if match.score >= self.min_score else "no"
            lines.append(
                f"{match.score:8.1f}  {word:5}  {match.agreeing:4} of {match.pairs:4} agree  "
                f"{visible(name)}"
            )
        return "\n".join(lines)


def add_landmarks(
    database: Path | str,
    log: Log | UnopenedLog | Path | str,
    poses: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    *,
    every_m: float = 10.0,
    sd_m: float = 3.0,
    source: str | None = None,
    matcher: str | None = None,
) -> AddedLandmarks:
    """Add landmarks of a drive with known poses to a database, either all of them or none.

    Args:
        database: The database; created if it does not exist.
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        poses: A run, or a truth file.
        vehicle: Vehicle file with the camera and the matcher; None for the defaults.
        every_m: Distance between landmarks.
        sd_m: Standard deviation of the vehicle's position at a match, added to the error of the
            poses.
        source: Name of the drive; default: the log's name.
        matcher: ``orb``, or ``module:factory``; default: the vehicle file's.

    Raises:
        EmptyResultError: No picture became a landmark; the database is unchanged.
        VehicleError: The drive has no camera, or several.
    """
    settings = vehicle_given(vehicle)
    describing = matcher_for(settings, matcher)
    known = read_poses(Path(poses), settings)
    with opened(log) as drive:
        name = source or drive.logs[0].path.resolve().stem

        def add(writer: LandmarkWriter) -> tuple[AddCounts, bool]:
            with frames_of(drive, settings) as (frames, ledgers):
                counts = add_from_log(
                    writer, describing, frames, known, every_m, sd_m, visible(name), ledgers
                )
            return counts, all(ledger.is_whole for ledger in ledgers)

        return _added(Path(database), describing, add)


def add_landmark_images(
    database: Path | str,
    images: Path | str,
    coordinates: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    *,
    source: str | None = None,
    matcher: str | None = None,
) -> AddedLandmarks:
    """Add pictures with known positions to a database, either all of them or none.

    Args:
        database: The database; created if it does not exist.
        images: Folder of the pictures.
        coordinates: CSV file ``image,x_m,y_m,sd_m``, or with a covariance instead of ``sd_m``.
        vehicle: Vehicle file with the camera and the matcher; None for the defaults.
        source: Name of the pictures; default: the folder's name.
        matcher: ``orb``, or ``module:factory``; default: the vehicle file's.

    Raises:
        SchemaError: The coordinates are not valid; the message names the line.
        EmptyResultError: No picture became a landmark; the database is unchanged.
    """
    describing, folder = matcher_for(vehicle_given(vehicle), matcher), Path(images)
    name = visible(source or folder.resolve().name)
    return _added(
        Path(database),
        describing,
        lambda writer: (
            add_from_images(writer, describing, folder, Path(coordinates), name),
            True,
        ),
    )


def _added(
    path: Path, matcher: Matcher, add: Callable[[LandmarkWriter], tuple[AddCounts, bool]]
) -> AddedLandmarks:
    with LandmarkWriter(path, matcher.kind) as writer:
        found = AddedLandmarks(path, *add(writer))
        if not found.counts.added:
            # Raised inside the writer's block, so that the writer undoes all changes.
            raise EmptyResultError(f"{found}; give other pictures or poses")
    return found


@contextmanager
def frames_of(drive: Log, vehicle: Vehicle) -> Iterator[tuple[Iterator[Frame], list[Ledger]]]:
    """Yield the camera's pictures; warn about missing ones at the end."""
    ledgers = [Ledger(str(log.path)) for log in drive.logs]
    yield camera_frames(drive.logs, vehicle, drive.selection, ledgers), ledgers
    for ledger in ledgers:
        warn_of(ledger)


def list_landmarks(
    database: Path | str, near: tuple[float, float, float] | str | None = None, limit: int = 100
) -> LandmarkList:
    """Return all landmarks of a database, or those near a place.

    Args:
        database: The file.
        near: East, north and radius in metres, also as text, ``-12.5,80,50``; None for all.
        limit: Max number of landmarks to return.

    Raises:
        UsageError: ``near`` is not a place, or ``limit`` is below 0.
        LogError: The file cannot be read.
    """
    place = _near(near)
    if limit < 0:
        raise UsageError(f"--limit {limit}: expected 0 or more")
    with LandmarkDatabase(Path(database)) as known:
        found = iter(known) if place is None else known.within(*place)
        places = tuple(one.place for one in islice(found, limit))
        return LandmarkList(Path(database), known.kind, len(known), places)


def _near(near: tuple[float, float, float] | str | None) -> tuple[Floats, float] | None:
    return near_of(near if near is None or isinstance(near, str) else ",".join(map(repr, near)))


def match_landmarks(
    database: Path | str,
    image: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    *,
    near: tuple[float, float, float] | str | None = None,
    best: int = 5,
    matcher: str | None = None,
) -> LandmarkMatches:
    """Match one picture against all landmarks of a database, or those near a place.

    Args:
        database: The file.
        image: PNG, JPEG or WebP.
        vehicle: Vehicle file with the camera and the matcher; None for the defaults.
        near: As in ``list_landmarks``.
        best: Number of matches to return.
        matcher: ``orb``, or ``module:factory``; default: the vehicle file's.

    Raises:
        UsageError: ``near`` is not a place, or the database has features of another matcher.
        LogError: The picture or the file cannot be read.
    """
    place = _near(near)
    if best < 1:
        raise UsageError(f"--best {best}: expected 1 or more")
    settings = vehicle_given(vehicle)
    comparing = matcher_for(settings, matcher)
    seen = comparing.describe(grey_of(read_picture(Path(image))))
    compared = 0
    found: list[tuple[float, int, Match, str]] = []
    with open_for(Path(database), comparing) as known:
        for one in iter(known) if place is None else known.within(*place):
            match = comparing.match(seen, known.features(one.key))
            compared += 1
            # Equal scores are in the order in which landmarks were added.
            found.append((match.score, -one.key, match, one.place.name))
            if len(found) > 2 * best:
                found = heapq.nlargest(best, found, key=lambda row: row[:2])
    kept = heapq.nlargest(best, found, key=lambda row: row[:2])
    matches = tuple((name, match) for _, _, match, name in kept)
    return LandmarkMatches(len(seen), compared, settings.landmarks.min_score, matches)
