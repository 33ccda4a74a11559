"""Fit the threshold of landmark matches to labelled pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from crosscue.eval.fit.landmarks.database import metres, pictures_with, read_poses
from crosscue.eval.fit.landmarks.pairs import landmark_pairs, pairs_of_drive
from crosscue.eval.fit.vehicle_output import check_output, with_section, write_fit
from crosscue.eval.logs.log import DriveIfGiven, opened
from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.localization.landmarks.fit import LandmarkFit, Rate
from crosscue.localization.landmarks.fit import fit_landmarks as fit_threshold
from crosscue.replay.errors import SchemaError, UsageError
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option, keywords


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
            scored = pairs_of_drive(
                pictures,
                marks,
                comparing,
                settings.every_m,
                settings.same_within_m,
                settings.different_beyond_m,
                settings.max_landmarks,
            )
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
