"""Fit the threshold of landmark matches to labelled pairs of pictures."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar, Final

import numpy as np

from crosscue.datasets.truth.csv_rows import csv_rows
from crosscue.eval.fit.landmarks.threshold import (
    LandmarkFit,
    Rate,
    ScoredPairs,
    fit_threshold,
    fitted_half,
)
from crosscue.eval.fit.vehicle_output import Fitted, check_output, with_section, write_fit
from crosscue.eval.pipeline.landmarks import matcher_for
from crosscue.eval.report.chart import Chart, share_above
from crosscue.localization.landmarks.features import Keypoints, Matcher
from crosscue.localization.landmarks.images import grey_of, read_encoded
from crosscue.replay.errors import AnnotationError, LogError, SchemaError, UsageError
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import HIDDEN
from crosscue.verb import Option

MAX_PAIRS: Final = 1_000_000
_LABELS: Final = {"1": True, "0": False, "true": True, "false": False}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedLandmarks(Fitted):
    """A fitted match threshold and its rates.

    Attributes:
        fitted: The threshold, and the rates on both halves of the pictures.
        matcher: Matcher that the threshold is for.
        pairs: The pairs.
    """

    fitted: LandmarkFit = field(metadata=HIDDEN)
    matcher: str
    pairs: ScoredPairs = field(metadata=HIDDEN)

    also: ClassVar = {
        name: f"fitted.{name}" for name in ("is_shown", *LandmarkFit.__dataclass_fields__)
    }

    @property
    def toml(self) -> str:
        """The vehicle file's section."""
        return f"[landmarks]\nmin_score = {self.fitted.min_score:g}\n"

    def charts(self) -> Iterator[Chart]:
        """Yield the rates of matches above each score, on both halves."""
        is_fit, pairs = fitted_half(self.pairs), self.pairs
        yield Chart(
            f"Fraction of pairs that match above each score; chosen: {self.fitted.min_score:g}",
            "score",
            "fraction",
            [
                share_above(f"{what}, {half}", pairs.score[which & mine])
                for what, which in (("same place", pairs.is_same), ("others", ~pairs.is_same))
                for half, mine in (("fitted", is_fit), ("held out", ~is_fit))
            ],
        )

    def report(self) -> Iterator[str]:
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


def _rate(rate: Rate) -> str:
    return f"{rate.hits} of {rate.of} ({rate.low:.2g} to {rate.high:.2g})"


def fit_landmarks(
    pairs: Annotated[Path | str, Option("--pairs", metavar="FILE.csv")],
    *,
    vehicle: Vehicle | Path | str | None = None,
    output: Annotated[Path | str | None, Option(metavar="V.toml")] = None,
    false_match_rate: Annotated[float, Option(metavar="P")] = 0.001,
    overwrite: bool = False,
) -> FittedLandmarks:
    """Fit the match threshold to a required false-match rate.

    The threshold is chosen on half of the query pictures, and the rates are measured on the other
    half. Pairs are read from a CSV file with the columns query, known (paths relative to the file's
    folder) and same (1 or 0).

    Examples:
        crosscue fit landmarks --pairs pairs.csv --false-match-rate 0.01
        crosscue fit landmarks --pairs pairs.csv --vehicle car.toml -o car.toml

    Args:
        pairs: CSV file query,known,same of labelled pairs.
        vehicle: Vehicle file: matcher.
        output: Vehicle file to write: a copy of --vehicle with the fit; may be the same file.
        false_match_rate: Max fraction of pairs from different places that may match.
        overwrite: Replace another existing file.

    Raises:
        UsageError: The rate is out of range.
        SchemaError: There are too few pairs.
        OutputError: The output exists, or cannot be written.
    """
    if not 0.0 <= false_match_rate < 1.0:
        raise UsageError(f"false_match_rate: {false_match_rate:g}, expected 0 or more, below 1")
    check_output(vehicle, output, overwrite=overwrite)
    matcher = matcher_for(vehicle_given(vehicle))
    scored = landmark_pairs(Path(pairs), matcher)
    try:
        fitted = fit_threshold(scored, false_match_rate)
    except ValueError as error:
        raise SchemaError(f"fit landmarks: {error}; use more labelled pictures") from None
    path = write_fit(
        vehicle,
        output,
        lambda text: with_section(text, "landmarks", {"min_score": fitted.min_score}),
    )
    return FittedLandmarks(fitted, matcher.kind, scored, path=path)


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
    return ScoredPairs(
        np.array([score for score, _, _ in rows], np.float64),
        np.array([is_same for _, is_same, _ in rows], np.bool_),
        np.array([query for _, _, query in rows], np.int64),
    )


def _labelled(path: Path) -> Iterator[tuple[str, str, bool]]:
    for number, (where, row) in enumerate(csv_rows(path, "query,known,same"), 2):
        label = _LABELS.get(str(row["same"]).strip().lower())
        if label is None or number > MAX_PAIRS:
            raise AnnotationError(
                f"{where}: same: expected 1 or 0 (and at most "
                f"{MAX_PAIRS:,} lines), got {row['same']!r}; correct it"
            )
        yield str(row["query"]), str(row["known"]), label
