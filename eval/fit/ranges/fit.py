"""Fit of the curve from heights in pixels to ranges."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, TypeAlias

from crosscue.detectors.ranging.height_to_range import (
    FAMILIES,
    Bin,
    Family,
    RangeFit,
    fit_range,
    residuals,
)
from crosscue.eval.fit.ranges.pairs import (
    RangePairs,
    concatenate_pairs,
    pairs_of_run,
    pairs_of_truth,
    range_pairs,
)
from crosscue.eval.fit.vehicle_output import new_file
from crosscue.replay.errors import EmptyResultError, UsageError
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option, keywords

RangeCue: TypeAlias = Literal["stop_sign", "traffic_light"]
PUBLISHED_SD_M: Final[dict[RangeCue, float]] = {"stop_sign": 1.7, "traffic_light": 5.9}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedRanges(Result):
    """Fitted curves from heights to ranges, with residuals by distance.

    Attributes:
        cue: Cue whose objects were measured.
        fits: One fit per family of curves.
        tested: Residuals of the best curve on other drives; None without such drives.
    """

    cue: RangeCue
    fits: tuple[RangeFit, ...] = field(metadata=HIDDEN)
    tested: RangeFit | None = field(metadata=HIDDEN)

    also: ClassVar = {
        "best": "best.curve.family",
        "fits": "fits_in_json",
        "tested": "tested_in_json",
    }

    @property
    def best(self) -> RangeFit:
        """The fit with the smallest residual."""
        return min(self.fits, key=lambda fit: fit.curve.residual_sd_m)

    @property
    def fits_in_json(self) -> list[dict[str, Any]]:
        """Curve and residuals of each family, as in JSON."""
        return [_as_json(fit) for fit in self.fits]

    @property
    def tested_in_json(self) -> dict[str, Any] | None:
        """Residuals on other drives, as in JSON."""
        return None if self.tested is None else _as_json(self.tested)

    def lines(self) -> Iterator[str]:
        """Yield the residual of each family, those of the best by distance, and its section."""
        best, tested = self.best, self.tested
        for fit in self.fits:
            yield f"{fit.curve.family:15} residual s.d. {fit.curve.residual_sd_m:.2f} m"
        yield f"{'published':15} residual s.d. {PUBLISHED_SD_M[self.cue]:.1f} m, on real images"
        yield from ("", f"{best.curve.family} by distance, {_pairs_text(best)}:")
        yield from _bins(best.bins)
        if tested is not None:
            sd = tested.curve.residual_sd_m
            yield from ("", f"on other drives, {tested.pairs} pairs, r.m.s. {sd:.2f} m:")
            yield from _bins(tested.bins)
        parameters = ", ".join(f"{p:.6g}" for p in best.curve.parameters)
        yield from ("", f"[ranges.{self.cue}]", f'family = "{best.curve.family}"')
        yield f"parameters = [{parameters}]"
        yield f"residual_sd_m = {best.curve.residual_sd_m:.3f}"


def _pairs_text(fit: RangeFit) -> str:
    left_out = f" ({fit.outliers} outliers left out)" if fit.outliers else ""
    return f"{fit.pairs} pairs{left_out}"


def _bins(bins: tuple[Bin, ...]) -> list[str]:
    return [
        f"  {b.from_m:5.0f} to {b.to_m:5.0f} m  {b.pairs:6} pairs  mean {b.mean_m:+6.2f} m  "
        f"r.m.s. {b.sd_m:5.2f} m"
        for b in bins
    ]


def _as_json(fit: RangeFit) -> dict[str, object]:
    return {
        "family": fit.curve.family,
        "parameters": list(fit.curve.parameters),
        "residual_sd_m": fit.curve.residual_sd_m,
        "pairs": fit.pairs,
        "outliers": fit.outliers,
        "bins": [
            {
                "from_m": b.from_m,
                "to_m": b.to_m,
                "pairs": b.pairs,
                "mean_m": b.mean_m,
                "rms_m": b.sd_m,
            }
            for b in fit.bins
        ],
    }


@dataclass(frozen=True, slots=True)
class RangeFitSettings:
    """What a curve from heights to ranges is fitted to.

    Attributes:
        table: CSV or Parquet file with the columns height_px and range_m, from the rear axle.
        truth: Drives with annotated objects and ranges, instead of a table.
        runs: Run folders with detections to measure heights in, one per drive of --truth.
        test: Other drives to measure the best curve on.
        min_score: Min score of a detection of the runs.
        family: Fit only this family of curves.
        bin_m: Width of the distance bins.
        figure: Figure to write, with pairs, curves and residuals.
        overwrite: Replace an existing figure.
    """

    table: Annotated[Path | str | None, Option(metavar="TABLE", is_positional=True)] = None
    truth: Annotated[Sequence[Path | str], Option(metavar="TRUTH")] = ()
    runs: Sequence[Path | str] = ()
    _: KW_ONLY
    test: Annotated[Sequence[Path | str], Option(metavar="TRUTH")] = ()
    min_score: Annotated[float, Option(metavar="P")] = 0.9
    family: Family | None = None
    bin_m: float = 10.0
    figure: Path | str | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UsageError: Neither a table nor truth is passed, or a value is out of range.
        """
        if not self.bin_m > 0.0:
            raise UsageError(f"bin_m: {self.bin_m:g}, expected more than 0")
        if self.family is not None and self.family not in FAMILIES:
            raise UsageError(f"family: {self.family}, expected one of {', '.join(FAMILIES)}")
        if (self.table is None) == (not self.truth):
            raise UsageError("truth: expected drives, or else a TABLE of pairs")
        if self.runs and self.truth and len(self.runs) != len(self.truth):
            runs, drives = len(self.runs), len(self.truth)
            raise UsageError(f"runs: {runs} runs for {drives} drives; expected one run per drive")


@keywords(RangeFitSettings)
def fit_ranges(
    cue: Annotated[RangeCue, Option("--cue")], settings: RangeFitSettings
) -> FittedRanges:
    """Fit the curve from heights in pixels to ranges.

    Pairs of height and range are read from a TABLE, from the annotated objects of drives (--truth),
    or from the detections of runs (--runs with --truth). All families of curves are fitted, with
    residuals by distance. The one with the smallest residual is printed as a section for the
    vehicle file. --test measures that curve on other drives.

    Examples:
        crosscue fit ranges stop_signs.csv --cue stop_sign
        crosscue fit ranges --cue traffic_light --truth drives/L* --test drives/A-01 --figure a.png
        crosscue fit ranges --cue stop_sign --runs runs/A-01 --truth drives/A-01

    Args:
        cue: Cue whose objects were measured.
        settings: What the curve is fitted to.

    Raises:
        UsageError: Neither a table nor truth is passed, or a value is out of range.
        EmptyResultError: The drives contain no pairs.
        OutputError: The figure exists, or cannot be written.
    """
    bin_m = settings.bin_m
    picture = new_file(settings.figure, overwrite=settings.overwrite)
    if cue not in PUBLISHED_SD_M:
        raise UsageError(f"cue: {cue}, expected one of {', '.join(PUBLISHED_SD_M)}")
    pairs = _pairs(cue, settings)
    others = [pairs_of_truth(Path(one), cue) for one in settings.test]
    names = [name for name in FAMILIES if settings.family in (None, name)]
    found = FittedRanges(cue, tuple(fit_range(*pairs, name, bin_m) for name in names), None)
    if others:
        tested = concatenate_pairs(others)
        if not len(tested.range_m):
            raise EmptyResultError(f"test: the drives contain no {cue}; use others")
        found = replace(found, tested=residuals(*tested, found.best.curve, bin_m))
    if picture is not None:
        from crosscue.eval.fit.ranges.pairs import draw_range_fits

        draw_range_fits(picture, cue, pairs, list(found.fits), found.tested)
    return found


def _pairs(cue: str, settings: RangeFitSettings) -> RangePairs:
    if settings.table is not None:
        return range_pairs(Path(settings.table))
    truth = [Path(one) for one in settings.truth]
    if settings.runs:
        given = zip(map(Path, settings.runs), truth, strict=True)
        pairs = concatenate_pairs([pairs_of_run(r, t, cue, settings.min_score) for r, t in given])
    else:
        pairs = concatenate_pairs([pairs_of_truth(path, cue) for path in truth])
    if not len(pairs.range_m):
        raise EmptyResultError(f"truth: the drives contain no {cue} with a range; use others")
    return pairs
