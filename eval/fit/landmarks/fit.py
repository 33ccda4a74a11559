"""Fit the threshold of landmark matches to labelled pairs of pictures, or to a drive."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar, Final

import numpy as np

from crosscue.datasets.truth.csv_rows import csv_rows
from crosscue.eval.fit.landmarks.database import (
    PosedPictures,
    drop_picture,
    metres,
    pictures_with,
    place_at,
    read_poses,
)
from crosscue.eval.fit.landmarks.threshold import LandmarkFit, Rate, ScoredPairs, fit_threshold
from crosscue.eval.fit.vehicle_output import check_output, with_section, write_fit
from crosscue.eval.logs.log import DriveIfGiven, opened
from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.localization.angles import wrap
from crosscue.localization.landmarks.database import LandmarkDatabase, Nearby
from crosscue.localization.landmarks.features import Keypoints, Matcher
from crosscue.localization.landmarks.images import grey_of, read_encoded
from crosscue.replay.errors import AnnotationError, LogError, SchemaError, UsageError
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option, keywords

MAX_PAIRS: Final = 1_000_000
# Near pictures whose directions differ by more than this are not used as a pair.
SAME_TURN_RAD: Final = math.pi / 4
_LABELS: Final = {"1": True, "0": False, "true": True, "false": False}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedLandmarks(Result):
    """A fitted match threshold and its rates.

    Attributes:
        fitted: The threshold, and the rates on both halves of the pictures.
        matcher: Matcher that the threshold is for.
        path: Vehicle file that was written; None without one.
    """

    fitted: LandmarkFit = field(metadata=HIDDEN)
    matcher: str
    path: Path | None = field(metadata=HIDDEN)

    also: ClassVar = {
        name: f"fitted.{name}" for name in ("is_shown", *LandmarkFit.__dataclass_fields__)
    }

    def lines(self) -> Iterator[str]:
        """Yield the threshold, and the rates on both halves."""
        fitted = self.fitted
        yield (
            f"threshold   min_score = {fitted.min_score:g} for a false-match rate of "
            f"{fitted.wanted_rate:g}"
        )
        yield from ("", "                       fitted                        held out")
        for name, fit, held in (
            ("false matches", fitted.fitted_false, fitted.held_out_false),
            ("places found", fitted.fitted_found, fitted.held_out_found),
        ):
            yield f"{name:14} {_rate(fit):>29} {_rate(held):>31}"
        if not fitted.is_shown:
            yield ""
            yield (
                f"the {fitted.held_out_false.of} held-out pairs cannot show a rate of "
                f"{fitted.wanted_rate:g}: it may be up to {fitted.held_out_false.high:.2g}"
            )
        if self.path is not None:
            yield f"written to {self.path}"


def _rate(rate: Rate) -> str:
    return f"{rate.hits} of {rate.of} ({rate.low:.2g} to {rate.high:.2g})"


@dataclass(frozen=True, slots=True)
class LandmarkFitSettings:
    """Pairs of pictures that a match threshold is fitted to.

    Attributes:
        pairs: CSV file query,known,same of labelled pairs, instead of a drive.
        database: Landmark database made from another drive.
        poses: Poses of the vehicle: a run or a truth file.
        vehicle: Vehicle file: camera and matcher.
        output: Vehicle file to write: a copy of --vehicle with the fit; may be the same file.
        false_match_rate: Max fraction of pairs from different places that may match.
        every_m: Distance between the frames used, in metres.
        same_within_m: Max distance of a landmark of the same place, in metres.
        different_beyond_m: Min distance of a landmark of another place, in metres.
        max_landmarks: Max landmarks per frame.
        matcher: orb, or your own module:factory (default: the vehicle file's).
        overwrite: Replace another existing file.
    """

    pairs: Annotated[Path | str | None, Option(metavar="FILE.csv")] = None
    database: Path | str | None = None
    poses: Annotated[Path | str | None, Option(metavar="RUN|T.json")] = None
    vehicle: Vehicle | Path | str | None = None
    output: Annotated[Path | str | None, Option(metavar="V.toml")] = None
    _: KW_ONLY
    false_match_rate: Annotated[float, Option(metavar="P")] = 0.001
    every_m: Annotated[float, Option("--every", convert=metres)] = 5.0
    same_within_m: Annotated[float, Option("--same-within", convert=metres)] = 5.0
    different_beyond_m: Annotated[float, Option("--different-beyond", convert=metres)] = 50.0
    max_landmarks: int = 50
    matcher: str | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Check numbers.

        Raises:
            UsageError: A number is out of range, or numbers contradict each other.
        """
        if not 0.0 <= self.false_match_rate < 1.0:
            raise UsageError(
                f"false_match_rate: {self.false_match_rate:g}, expected 0 or more, below 1"
            )
        for name in ("every_m", "same_within_m", "different_beyond_m"):
            value: float = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise UsageError(f"{name}: {value:g}, expected metres, above 0")
        if self.max_landmarks < 1:
            raise UsageError(f"max_landmarks: {self.max_landmarks}, expected 1 or more")
        if self.same_within_m >= self.different_beyond_m:
            raise UsageError(
                f"same_within_m: {self.same_within_m:g}, expected less than "
                f"{self.different_beyond_m:g}, where places begin to be different"
            )


@keywords(LandmarkFitSettings)
def fit_landmarks(log: DriveIfGiven, settings: LandmarkFitSettings) -> FittedLandmarks:
    """Fit the match threshold to a required false-match rate.

    The threshold is chosen on half of the query pictures, and the rates are measured on the other
    half. Pairs are read from a CSV file with the columns query, known (paths relative to the file's
    folder) and same (1 or 0), or are made from a drive with known poses and a database from another
    drive.

    Examples:
        crosscue fit landmarks --pairs pairs.csv --false-match-rate 0.01
        crosscue fit landmarks b.mcap --database a.db --poses b.json --vehicle car.toml -o car.toml

    Args:
        log: The drive, or its path; None with pairs.
        settings: The pairs.

    Raises:
        UsageError: Neither pairs nor a drive are passed, or values contradict each other.
        SchemaError: There are too few pairs.
        OutputError: The output exists, or cannot be written.
    """
    vehicle, output = settings.vehicle, settings.output
    check_output(vehicle, output, overwrite=settings.overwrite)
    car = vehicle_given(vehicle)
    comparing = matcher_for(car, settings.matcher)
    pairs, database, poses = settings.pairs, settings.database, settings.poses
    if pairs is not None and log is None and database is None and poses is None:
        scored = landmark_pairs(Path(pairs), comparing)
    elif pairs is None and log is not None and database is not None and poses is not None:
        known = read_poses(Path(poses), car)
        with (
            open_for(Path(database), comparing) as marks,
            opened(log) as drive,
            pictures_with(known, drive, car) as pictures,
        ):
            scored = pairs_of_drive(pictures, marks, comparing, settings)
    else:
        raise UsageError("pairs: expected labelled pairs, or else a log with database and poses")
    try:
        fitted = fit_threshold(scored, settings.false_match_rate)
    except ValueError as error:
        raise SchemaError(f"fit landmarks: {error}; use more labelled pictures") from None
    path = write_fit(
        vehicle,
        output,
        lambda text: with_section(text, "landmarks", {"min_score": fitted.min_score}),
    )
    return FittedLandmarks(fitted, comparing.kind, path)


def landmark_pairs(path: Path, matcher: Matcher) -> ScoredPairs:
    """Score the pairs of a CSV file ``query,known,same``; picture names are relative to its folder.

    Raises:
        AnnotationError: The table is invalid; the message names the line.
        LogError: A picture cannot be read.
    """

    @lru_cache(maxsize=256)
    def features(name: str) -> Keypoints:
        try:
            return matcher.describe(grey_of(read_encoded(path.parent / name)))
        except LogError as error:
            raise type(error)(f"{path.parent / name}: {error}") from None

    numbers: dict[str, int] = {}
    rows: list[tuple[float, bool, int]] = []
    for query, known, is_same in _labelled(path):
        match = matcher.match(features(query), features(known))
        rows.append((match.score, is_same, numbers.setdefault(query, len(numbers))))
    return _columns(rows)


def _labelled(path: Path) -> Iterator[tuple[str, str, bool]]:
    for number, (where, row) in enumerate(csv_rows(path, "query,known,same"), 2):
        label = _LABELS.get(str(row["same"]).strip().lower())
        if label is None or number > MAX_PAIRS:
            raise AnnotationError(
                f"{where}: same: expected 1 or 0 (and at most "
                f"{MAX_PAIRS:,} lines), got {row['same']!r}; correct it"
            )
        yield str(row["query"]), str(row["known"]), label


def pairs_of_drive(
    pictures: PosedPictures,
    database: LandmarkDatabase,
    matcher: Matcher,
    settings: LandmarkFitSettings,
) -> ScoredPairs:
    """Score frames with known poses against landmarks; near ones are the same place, far ones not.

    Args:
        pictures: Pictures of another drive than the landmarks', else the rates are too good.
        database: The landmarks.
        matcher: Matcher that computes the scores.
        settings: Distances. Near landmarks are the same place if the directions also agree; of a
            frame, all near ones are compared first, then far ones drawn with a fixed seed.
    """
    marks = list(database)
    rng = np.random.default_rng(0)
    rows: list[tuple[float, bool, int]] = []
    last = None
    for number, frame in enumerate(pictures.frames):
        place = place_at(frame.t_ns, pictures.poses, 1.0, "frame")
        if place is None or (last is not None and math.dist(place.xy_m, last) < settings.every_m):
            continue
        last = place.xy_m
        try:
            seen = matcher.describe(grey_of(frame.picture))
        except LogError as error:
            drop_picture(pictures.ledgers, frame, error)
            continue
        apart = [math.dist(mark.place.xy_m, place.xy_m) for mark in marks]
        same = [
            i
            for i, metres in enumerate(apart)
            if metres <= settings.same_within_m and _looks_along(marks[i], place.heading_rad)
        ]
        other = [i for i, metres in enumerate(apart) if metres >= settings.different_beyond_m]
        drawn = rng.permutation(other)[: max(settings.max_landmarks - len(same), 0)].tolist()
        for i in (*same, *drawn):
            match = matcher.match(seen, database.features(marks[i].key))
            rows.append((match.score, i in same, number))
    return _columns(rows)


def _looks_along(mark: Nearby, heading_rad: float | None) -> bool:
    if mark.place.heading_rad is None or heading_rad is None:
        return True
    return abs(wrap(mark.place.heading_rad - heading_rad)) <= SAME_TURN_RAD


def _columns(rows: list[tuple[float, bool, int]]) -> ScoredPairs:
    return ScoredPairs(
        np.array([score for score, _, _ in rows], np.float64),
        np.array([is_same for _, is_same, _ in rows], np.bool_),
        np.array([query for _, _, query in rows], np.int64),
    )
