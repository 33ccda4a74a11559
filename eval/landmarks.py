"""Landmark databases: add, list and match landmarks."""

import heapq
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, ClassVar, TypeAlias

from crosscue.eval.fit.landmarks.database import (
    AddCounts,
    add_from_images,
    add_from_log,
    metres,
    near_of,
    place_at,
    read_poses,
)
from crosscue.eval.logs.log import DriveIfGiven, opened
from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.localization.landmarks.database import (
    LandmarkDatabase,
    LandmarkPosition,
    LandmarkWriter,
)
from crosscue.localization.landmarks.features import Match, Matcher
from crosscue.localization.landmarks.images import grey_of, read_encoded
from crosscue.replay.columns import Floats
from crosscue.replay.errors import EmptyResultError, UsageError
from crosscue.replay.safe_text import counted, visible
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import HIDDEN, Result, json_key
from crosscue.verb import Option, keywords

NearGiven: TypeAlias = Annotated[
    tuple[float, float, float] | str | None,
    Option("--near", metavar="X,Y,R", is_one_word=True),
]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class AddedLandmarks(Result):
    """Result of adding landmarks; its repr is one line.

    Attributes:
        path: The database.
        counts: Numbers of pictures that were added or left out, by reason.
        is_whole: True if nothing of the log was dropped.
    """

    path: Path = field(metadata=json_key("database"))
    counts: AddCounts = field(metadata=HIDDEN)
    is_whole: bool = field(metadata=HIDDEN, default=True)
    also: ClassVar = {one.name: f"counts.{one.name}" for one in fields(AddCounts)}

    def lines(self) -> Iterator[str]:
        """Yield the numbers of pictures."""
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
        pictures = counted(counts.pictures, "picture")
        yield f"{self.path}: {counted(counts.added, 'landmark')} added from {pictures}{rest}"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkList(Result):
    """Landmarks of a database; its repr has one line per landmark.

    Attributes:
        path: The database.
        kind: Name of the matcher that its features belong to.
        total: Number of landmarks in the database.
        places: The selected landmarks.
    """

    path: Path = field(metadata=HIDDEN)
    kind: str = field(metadata=json_key("matcher"))
    total: int = field(metadata=json_key("landmarks"))
    places: tuple[LandmarkPosition, ...] = field(metadata=json_key("listed"))

    def lines(self) -> Iterator[str]:
        """Yield a line for the database, and one for each landmark."""
        head = f"{self.path}: {counted(self.total, 'landmark')} of matcher {self.kind}; "
        yield f"{head}listed: {len(self.places)}"
        yield from map(_place_line, self.places)


def _place_line(place: LandmarkPosition) -> str:
    sd_x, sd_y = math.sqrt(place.cov_m2[0, 0]), math.sqrt(place.cov_m2[1, 1])
    turn = "      -" if place.heading_rad is None else f"{math.degrees(place.heading_rad):7.1f}"
    x, y = place.xy_m
    return (
        f"{x:12.2f} {y:12.2f} m  +- {sd_x:6.2f} {sd_y:6.2f} m  heading {turn} deg  "
        f"{visible(place.name)}"
    )


@dataclass(frozen=True, slots=True)
class LandmarkMatch:
    """Similarity of a picture to one landmark.

    Attributes:
        name: Name of the landmark.
        score: Score of the match, higher for a more certain one.
        pairs: Number of points with similar descriptors.
        agreeing: Number of those that are consistent with one rigid scene.
        is_match: True if the score is at least the lowest score of a match.
    """

    name: str
    score: float
    pairs: int
    agreeing: int
    is_match: bool


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkMatches(Result):
    """The landmarks that are most similar to a picture; its repr has one line per landmark.

    Attributes:
        points: Number of feature points found in the picture.
        compared: Number of landmarks that it was compared with.
        min_score: Lowest score of a match.
        best: The matches, best first.
    """

    points: int
    compared: int
    min_score: float
    best: tuple[LandmarkMatch, ...]

    def lines(self) -> Iterator[str]:
        """Yield a line for the picture, and one for each landmark."""
        yield (
            f"{counted(self.points, 'point')}; {counted(self.compared, 'landmark')} compared; "
            f"min score of a match "
            f"{self.min_score:g}"
        )
        for one in self.best:
            word = "match" if one.is_match else "no"
            yield (
                f"{one.score:8.1f}  {word:5}  {one.agreeing:4} of {one.pairs:4} agree  "
                f"{visible(one.name)}"
            )


@dataclass(frozen=True, slots=True)
class LandmarkSource:
    """Where landmarks come from: a log with poses, or pictures with coordinates.

    Attributes:
        poses: Poses of the vehicle: a run or a truth file.
        images: Folder of images.
        coordinates: Position of each image.
        every_m: Distance between landmarks from a log, in metres.
        sd_m: Standard deviation of the vehicle's position at a match, in metres, added to the error
            of the poses.
        source: Name of the source (default: the log's name).
        vehicle: Vehicle file: camera and matcher.
    """

    poses: Annotated[Path | str | None, Option(metavar="RUN|T.json")] = None
    images: Annotated[Path | str | None, Option(metavar="DIR")] = None
    coordinates: Annotated[Path | str | None, Option(metavar="FILE.csv")] = None
    every_m: Annotated[float, Option("--every", convert=metres)] = 10.0
    sd_m: Annotated[float, Option("--sd", convert=metres)] = 3.0
    source: str | None = None
    vehicle: Vehicle | Path | str | None = None


@keywords(LandmarkSource, 2)
def add_landmarks(
    database: Path | str, log: DriveIfGiven, settings: LandmarkSource
) -> AddedLandmarks:
    """Add landmarks from a log with poses, or from pictures with coordinates.

    Either all pictures of a call are added, or none. Coordinates are in metres in the map frame: x
    east, y north. The CSV file has the columns image,x_m,y_m,sd_m (or var_x_m2,cov_xy_m2,var_y_m2
    instead of sd_m) and, optionally, heading_rad.

    Examples:
        crosscue landmarks add town.sqlite drive.mcap --poses runs/drive --every 10
        crosscue landmarks add town.sqlite --images photos --coordinates photos.csv

    Args:
        database: Landmark database; created if missing.
        log: The drive; None with pictures.
        settings: Where they come from.

    Raises:
        UsageError: There are not exactly a log and poses, or images and coordinates.
        EmptyResultError: No picture became a landmark; the database is unchanged.
        SchemaError: The coordinates are not valid; the message names the line.
        VehicleError: The drive has no camera, or several.
    """
    poses, images, coordinates = settings.poses, settings.images, settings.coordinates
    car, source = vehicle_given(settings.vehicle), settings.source
    if log is not None and poses is not None and images is None and coordinates is None:
        describing = matcher_for(car)
        known = read_poses(Path(poses), car)
        with opened(log) as drive:
            name = visible(source or drive.logs[0].path.resolve().stem)
            place = partial(place_at, poses=known, sd_m=settings.sd_m, source=name)
            return _added(
                Path(database),
                describing,
                lambda writer: add_from_log(
                    writer, describing, drive, car, place, settings.every_m
                ),
            )
    if log is None and poses is None and images is not None and coordinates is not None:
        describing, folder = matcher_for(car), Path(images)
        table, name = Path(coordinates), visible(source or folder.resolve().name)
        return _added(
            Path(database),
            describing,
            lambda writer: (add_from_images(writer, describing, folder, table, name), True),
        )
    raise UsageError("landmarks add: expected LOG... with --poses, or --images with --coordinates")


def _added(
    path: Path, matcher: Matcher, add: Callable[[LandmarkWriter], tuple[AddCounts, bool]]
) -> AddedLandmarks:
    with LandmarkWriter(path, matcher.kind) as writer:
        found = AddedLandmarks(path, *add(writer))
        if not found.counts.added:
            # Raised inside the writer's block, so that the writer undoes all changes.
            raise EmptyResultError(f"{found}; give other pictures or poses")
    return found


def list_landmarks(
    database: Path | str, *, near: NearGiven = None, limit: int = 100
) -> LandmarkList:
    """List all landmarks of a database, or those near a place.

    Example:
        crosscue landmarks list town.sqlite --near=-12.5,80,50

    Args:
        database: Landmark database.
        near: Only landmarks within R metres of a place; --near=-5,3,10 for x < 0.
        limit: Max landmarks to list.

    Raises:
        UsageError: ``near`` is not a place, or ``limit`` is below 0.
        LogError: The file cannot be read.
    """
    place = _near(near)
    if limit < 0:
        raise UsageError(f"limit: {limit}, expected 0 or more")
    with LandmarkDatabase(Path(database)) as known:
        found = iter(known) if place is None else known.within(*place)
        places = tuple(one.place for one in islice(found, limit))
        return LandmarkList(Path(database), known.kind, len(known), places)


def _near(near: tuple[float, float, float] | str | None) -> tuple[Floats, float] | None:
    return near_of(near if near is None or isinstance(near, str) else ",".join(map(repr, near)))


def match_landmarks(
    database: Path | str,
    image: Annotated[Path | str, Option(metavar="IMAGE")],
    *,
    near: NearGiven = None,
    best: int = 5,
    vehicle: Vehicle | Path | str | None = None,
) -> LandmarkMatches:
    """Match one picture against a database's landmarks, or those near a place.

    Example:
        crosscue landmarks match town.sqlite photo.jpg --near 120,80,50

    Args:
        database: Landmark database.
        image: PNG, JPEG or WebP.
        near: Only landmarks within R metres of a place; --near=-5,3,10 for x < 0.
        best: Number of matches to show.
        vehicle: Vehicle file: camera and matcher.

    Raises:
        UsageError: ``near`` is not a place, or the database has features of another matcher.
        LogError: The picture or the file cannot be read.
    """
    place = _near(near)
    if best < 1:
        raise UsageError(f"best: {best}, expected 1 or more")
    settings = vehicle_given(vehicle)
    comparing = matcher_for(settings)
    seen = comparing.describe(grey_of(read_encoded(Path(image))))
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
    min_score = settings.landmarks.min_score
    matches = [
        LandmarkMatch(name, score, match.pairs, match.agreeing, score >= min_score)
        for score, _, match, name in kept
    ]
    return LandmarkMatches(len(seen), compared, min_score, tuple(matches))
