"""Fit of the curve from heights in pixels to ranges, to tables, drives or runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal, NamedTuple, TypeAlias

import numpy as np

from crosscue.datasets.truth.csv_rows import csv_rows
from crosscue.datasets.truth.truth import FILE, read_truth
from crosscue.detectors.ranging.height_to_range import (
    FAMILIES,
    Bin,
    Family,
    RangeFit,
    fit_range,
    range_of,
    residuals,
)
from crosscue.eval.fit.vehicle_output import Fitted
from crosscue.eval.report.chart import Chart, Series
from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import AnnotationError, EmptyResultError, SchemaError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import read_json
from crosscue.replay.limits import MIB
from crosscue.replay.safe_text import counted
from crosscue.results import HIDDEN
from crosscue.verb import Option, keywords

RangeCue: TypeAlias = Literal["stop_sign", "traffic_light"]
PUBLISHED_SD_M: Final[dict[RangeCue, float]] = {"stop_sign": 1.7, "traffic_light": 5.9}
MAX_BYTES: Final = 256 * MIB
LABELS: Final[Mapping[str, str]] = {"stop_sign": "stop sign", "traffic_light": "traffic light"}
# Column of true ranges by cue: stop signs are at the intersection's start, lights at its end.
REFERENCES: Final[Mapping[str, str]] = {"stop_sign": "start_m", "traffic_light": "end_m"}
# Min visible fraction of an object; the height of an occluded one does not show its range.
MIN_VISIBLE: Final = 0.9
# Max time difference between a detection and its true range.
NEAREST_NS: Final = 20_000_000


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedRanges(Fitted):
    """Fitted curves from heights to ranges, with residuals by distance.

    Attributes:
        cue: Cue whose objects were measured.
        fits: One fit per family of curves.
        tested: Residuals of the best curve on other drives; None without such drives.
        pairs: What was fitted to.
    """

    cue: RangeCue
    fits: tuple[RangeFit, ...]
    tested: RangeFit | None
    pairs: RangePairs = field(metadata=HIDDEN)

    also: ClassVar = {"best": "best.curve.family"}

    @property
    def best(self) -> RangeFit:
        """The fit with the smallest residual."""
        return min(self.fits, key=lambda fit: fit.curve.residual_sd_m)

    @property
    def toml(self) -> str:
        """The vehicle file's section with the best curve."""
        curve = self.best.curve
        parameters = ", ".join(f"{p:.6g}" for p in curve.parameters)
        return (
            f'[ranges.{self.cue}]\nfamily = "{curve.family}"\nparameters = [{parameters}]\n'
            f"residual_sd_m = {curve.residual_sd_m:.3f}\n"
        )

    def report(self) -> Iterator[str]:
        """Yield the residual of each family, and those of the best by distance."""
        best, tested = self.best, self.tested
        for fit in self.fits:
            yield f"{fit.curve.family:15} residual s.d. {fit.curve.residual_sd_m:.2f} m"
        yield f"{'published':15} residual s.d. {PUBLISHED_SD_M[self.cue]:.1f} m, on real images"
        yield from ("", f"{best.curve.family} by distance, {_pairs_text(best)}:")
        yield from _bins(best.bins)
        if tested is not None:
            sd = tested.curve.residual_sd_m
            yield from ("", f"on other drives, {counted(tested.pairs, 'pair')}, r.m.s. {sd:.2f} m:")
            yield from _bins(tested.bins)

    def charts(self) -> Iterator[Chart]:
        """Yield the pairs with each curve, and the residuals by distance."""
        height_px, range_m = self.pairs
        grid_px = np.linspace(height_px.min(), height_px.max(), 400)
        curves = [
            Series(one.curve.family, grid_px, range_of(grid_px, one.curve)) for one in self.fits
        ]
        yield Chart(
            "Pairs and curves",
            f"height of the {LABELS[self.cue]} (px)",
            "range to the rear axle (m)",
            (Series("pairs", height_px, range_m, is_line=False), *curves),
        )
        parts = [("fitted to", self.best), ("other drives", self.tested)]
        yield Chart(
            f"Residual of {self.best.curve.family} by distance",
            "range (m)",
            "r.m.s. residual (m)",
            [
                Series(
                    name,
                    [0.5 * (one.from_m + one.to_m) for one in fit.bins],
                    [one.rms_m for one in fit.bins],
                )
                for name, fit in parts
                if fit is not None
            ],
        )


def _pairs_text(fit: RangeFit) -> str:
    left_out = f" ({counted(fit.outliers, 'outlier')} left out)" if fit.outliers else ""
    return f"{counted(fit.pairs, 'pair')}{left_out}"


def _bins(bins: tuple[Bin, ...]) -> list[str]:
    return [
        f"  {b.from_m:5.0f} to {b.to_m:5.0f} m  {b.pairs:6} pairs  mean {b.mean_m:+6.2f} m  "
        f"r.m.s. {b.rms_m:5.2f} m"
        for b in bins
    ]


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
    """

    table: Annotated[Path | str | None, Option(metavar="TABLE", is_positional=True)] = None
    truth: Annotated[Sequence[Path | str], Option(metavar="TRUTH")] = ()
    runs: Sequence[Path | str] = ()
    _: KW_ONLY
    test: Annotated[Sequence[Path | str], Option(metavar="TRUTH")] = ()
    min_score: Annotated[float, Option(metavar="P")] = 0.9
    family: Family | None = None
    bin_m: float = 10.0

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
            raise UsageError(f"runs: got {runs} for {drives}; expected one run per drive")


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
        crosscue fit ranges --cue traffic_light --truth drives/L* --test drives/A-01 --page a.html
        crosscue fit ranges --cue stop_sign --runs runs/A-01 --truth drives/A-01

    Args:
        cue: Cue whose objects were measured.
        settings: What the curve is fitted to.

    Raises:
        UsageError: Neither a table nor truth is passed, or a value is out of range.
        EmptyResultError: The drives contain no pairs.
    """
    bin_m = settings.bin_m
    if cue not in PUBLISHED_SD_M:
        raise UsageError(f"cue: {cue}, expected one of {', '.join(PUBLISHED_SD_M)}")
    pairs = _pairs(cue, settings)
    others = [pairs_of_truth(Path(one), cue) for one in settings.test]
    names = [name for name in FAMILIES if settings.family in (None, name)]
    fits = tuple(fit_range(*pairs, name, bin_m) for name in names)
    found = FittedRanges(cue, fits, None, pairs)
    if others:
        tested = concatenate_pairs(others)
        if not len(tested.range_m):
            raise EmptyResultError(f"test: the drives contain no {cue}; use others")
        found = replace(found, tested=residuals(*tested, found.best.curve, bin_m))
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


class RangePairs(NamedTuple):
    """N heights in pixels, and true ranges of the rear axle along the path in metres."""

    height_px: Floats
    range_m: Floats


def concatenate_pairs(parts: Iterable[RangePairs]) -> RangePairs:
    """Concatenate sets of pairs."""
    heights, ranges = zip(*parts, strict=True)
    return RangePairs(np.concatenate(heights), np.concatenate(ranges))


def range_pairs(path: Path) -> RangePairs:
    """Read pairs from a CSV or Parquet file with the columns ``height_px`` and ``range_m``.

    Raises:
        AnnotationError: The file does not exist, is too large, or lacks these columns.
    """
    try:
        columns = _parquet(path) if path.suffix == ".parquet" else _csv(path, RangePairs._fields)
    except OSError as error:
        raise AnnotationError(
            f"{path}: {error.strerror or error}; give a table (CSV or Parquet) with height_px and "
            "range_m"
        ) from None
    except (KeyError, ValueError):
        raise AnnotationError(
            f"{path}: expected the columns height_px and range_m, all numbers"
        ) from None
    return RangePairs(*columns)


def pairs_of_truth(truth: Path, cue: str) -> RangePairs:
    """Return pairs from a drive's annotated objects that are neither occluded nor truncated.

    Args:
        truth: ``truth.json``, or its folder.
        cue: ``stop_sign`` or ``traffic_light``.

    Raises:
        SchemaError: The truth has no objects or ranges, or they cannot be read.
    """
    t_ns, range_m = _true_ranges(truth, cue)
    tree = _objects(truth)
    try:
        numbers = {c["id"] for c in tree["categories"] if c["name"] == LABELS[cue]}
        times = {image["id"]: int(image["t_ns"]) for image in tree["images"]}
        rows = [
            (times[one["image_id"]], float(one["bbox"][3]))
            for one in tree["annotations"]
            if one["category_id"] in numbers
            and one.get("visible", 1.0) >= MIN_VISIBLE
            and one.get("in_picture", 1.0) >= 1.0
        ]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise AnnotationError(f"{truth}: objects: no COCO file ({error!r}); repair it") from None
    return _paired(rows, t_ns, range_m)


def pairs_of_run(run: Path, truth: Path, cue: str, score: float) -> RangePairs:
    """Return pairs from the detections of a run.

    Args:
        run: A run folder with ``detections.parquet``.
        truth: Truth of its drive.
        cue: ``stop_sign`` or ``traffic_light``.
        score: Threshold that the scores of detections must exceed.

    Raises:
        UnreadableRunError: The run has no detections.
        SchemaError: The truth has no ranges.
    """
    names = ["t_ns", "label", "score", "height_px"]
    table = RunFolder(run).table("detections", names)
    t_ns, label, scores, height = (table[name].to_pylist() for name in names)
    rows = [
        (t, float(h))
        for t, one, s, h in zip(t_ns, label, scores, height, strict=True)
        if one == LABELS[cue] and s > score and h is not None and h > 0.0
    ]
    return _paired(rows, *_true_ranges(truth, cue))


def _paired(rows: list[tuple[int, float]], t_ns: Int64s, range_m: Floats) -> RangePairs:
    if not rows or not len(t_ns):
        return RangePairs(np.empty(0), np.empty(0))
    times = np.array([t for t, _ in rows], np.int64)
    height = np.array([h for _, h in rows])
    after = np.clip(np.searchsorted(t_ns, times), 1, max(len(t_ns) - 1, 1))
    before, after = after - 1, np.minimum(after, len(t_ns) - 1)
    nearer = np.abs(t_ns[before] - times) <= np.abs(t_ns[after] - times)
    at = np.where(nearer, before, after)
    keep = (np.abs(t_ns[at] - times) <= NEAREST_NS) & (range_m[at] > 0.0)
    return RangePairs(height[keep], range_m[at][keep])


def _true_ranges(truth: Path, cue: str) -> tuple[Int64s, Floats]:
    """Return the times and true ranges of a drive's pictures, sorted by time."""
    name = read_truth(truth).ranges
    if name is None:
        raise SchemaError(f"{truth}: has no ranges; name a file with them as ranges")
    path = _folder(truth) / name
    try:
        t_ns, range_m = _csv(path, ("t_ns", REFERENCES[cue]))
    except ValueError as error:
        raise AnnotationError(f"{path}: no table of true ranges ({error}); repair it") from None
    order = np.argsort(t_ns, kind="stable")
    return t_ns[order].astype(np.int64), range_m[order]


def _objects(truth: Path) -> Any:
    name = read_truth(truth).objects
    if name is None:
        raise SchemaError(f"{truth}: has no objects; name a COCO file with them as objects")
    return read_json(_folder(truth) / name, MAX_BYTES, AnnotationError, "repair it")


def _folder(truth: Path) -> Path:
    return truth.parent if truth.name == FILE or truth.is_file() else truth


def _csv(path: Path, names: tuple[str, ...]) -> tuple[Floats, ...]:
    rows = [row for _, row in csv_rows(path, ",".join(names))]
    # As float64, nanoseconds since 1970 are exact to 256 ns, enough to identify a picture.
    return tuple(np.array([float(row[name] or "nan") for row in rows]) for name in names)


def _parquet(path: Path) -> tuple[Floats, ...]:
    import pyarrow.parquet as pq

    names = list(RangePairs._fields)
    with door.arrow_file(path.resolve()) as file:
        table = pq.read_table(file, columns=names, page_checksum_verification=True)
    return tuple(np.asarray(table[name].to_numpy(), np.float64) for name in names)
