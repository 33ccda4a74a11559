"""Fit a curve from an object's height in pixels to its range."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.detectors.ranging.height_to_range import FAMILIES, Bin, RangeFit, fit_range, residuals
from crosscue.eval.fit.ranges.pairs import (
    RangePairs,
    pairs_of_run,
    pairs_of_table,
    pairs_of_truth,
    together,
)
from crosscue.replay.base import EmptyResultError, OutputError, UsageError

PUBLISHED_SD_M: Final = {"stop_sign": 1.7, "traffic_light": 5.9}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedRanges:
    """Fitted curves from heights to ranges, with residuals by distance.

    Attributes:
        cue: Cue whose objects were measured.
        fits: One fit per family of curves.
        tested: Residuals of the best curve on other drives; None without such drives.
    """

    cue: str
    fits: tuple[RangeFit, ...]
    tested: RangeFit | None

    @property
    def best(self) -> RangeFit:
        """The fit with the smallest residual."""
        return min(self.fits, key=lambda fit: fit.curve.residual_sd_m)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue fit ranges``."""
        tree: dict[str, object] = {
            "cue": self.cue,
            "best": self.best.curve.family,
            "fits": [_as_json(fit) for fit in self.fits],
        }
        return tree if self.tested is None else {**tree, "tested": _as_json(self.tested)}

    def __repr__(self) -> str:
        return _report_text(self.cue, self.fits, self.best, self.tested)


def _report_text(
    cue: str, fits: Sequence[RangeFit], best: RangeFit, tested: RangeFit | None
) -> str:
    lines = [f"{fit.curve.family:15} residual s.d. {fit.curve.residual_sd_m:.2f} m" for fit in fits]
    lines += [f"{'published':15} residual s.d. {PUBLISHED_SD_M[cue]:.1f} m, on real images"]
    lines += ["", f"{best.curve.family} by distance, {_pairs_text(best)}:", *_bins(best.bins)]
    if tested is not None:
        sd = tested.curve.residual_sd_m
        lines += ["", f"on other drives, {tested.pairs} pairs, r.m.s. {sd:.2f} m:"]
        lines += _bins(tested.bins)
    parameters = ", ".join(f"{p:.6g}" for p in best.curve.parameters)
    lines += [
        "",
        f"[ranges.{cue}]",
        f'family = "{best.curve.family}"',
        f"parameters = [{parameters}]",
        f"residual_sd_m = {best.curve.residual_sd_m:.3f}",
    ]
    return "\n".join(lines)


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


def fit_ranges(
    cue: str,
    table: Path | str | None = None,
    truth: Sequence[Path | str] = (),
    runs: Sequence[Path | str] = (),
    *,
    test: Sequence[Path | str] = (),
    min_score: float = 0.9,
    family: str | None = None,
    bin_m: float = 10.0,
    figure: Path | str | None = None,
    overwrite: bool = False,
) -> FittedRanges:
    """Fit a curve from an object's height in pixels to its range.

    Pairs are read from a table, from the annotated objects of drives, or from the detections of
    runs.

    Args:
        cue: ``stop_sign`` or ``traffic_light``.
        table: CSV or Parquet file with ``height_px`` and ``range_m``, from the rear axle.
        truth: Drives with annotated objects and ranges, instead of a table.
        runs: Runs with detections to measure heights in, one for each drive of ``truth``.
        test: Other drives to measure the best curve on.
        min_score: Min score of a detection of the runs.
        family: Fit only this family of curves.
        bin_m: Width of the distance bins.
        figure: PNG file to write, with pairs, curves and residuals.
        overwrite: Replace an existing figure.

    Raises:
        UsageError: Neither a table nor truth is passed, or a value is out of range.
        EmptyResultError: The drives contain no pairs.
        OutputError: The figure exists, or cannot be written.
    """
    picture = None if figure is None else Path(figure)
    if not bin_m > 0.0:
        raise UsageError(f"--bin-m {bin_m}: expected more than 0")
    if picture is not None and picture.exists() and not overwrite:
        raise OutputError(f"{picture}: exists; give another name or --overwrite")
    if cue not in PUBLISHED_SD_M:
        raise UsageError(f"--cue {cue}: expected one of {', '.join(PUBLISHED_SD_M)}")
    names = [name for name in FAMILIES if family in (None, name)]
    if not names:
        raise UsageError(f"--family {family}: expected one of {', '.join(FAMILIES)}")
    pairs = _pairs(
        cue,
        None if table is None else Path(table),
        [Path(one) for one in truth],
        [Path(one) for one in runs],
        min_score,
    )
    others = together(pairs_of_truth(Path(one), cue) for one in test) if test else None
    found = FittedRanges(cue, tuple(fit_range(*pairs, name, bin_m) for name in names), None)
    if others is not None:
        if not len(others.range_m):
            raise EmptyResultError(f"--test: the drives contain no {cue}; use others")
        tested = residuals(*others, found.best.curve, bin_m)
        found = FittedRanges(cue, found.fits, tested)
    if picture is not None:
        from crosscue.eval.fit.ranges.figure import draw

        draw(picture, cue, pairs, list(found.fits), found.tested)
    return found


def _pairs(
    cue: str,
    table: Path | None,
    truth: Sequence[Path],
    runs: Sequence[Path],
    min_score: float,
) -> RangePairs:
    if (table is None) == (not truth):
        raise UsageError("fit ranges: expected a TABLE, or --truth with drives")
    if table is not None:
        return pairs_of_table(table)
    if runs and len(runs) != len(truth):
        raise UsageError(
            f"--runs: {len(runs)} runs for {len(truth)} drives; expected one run per drive"
        )
    parts = (
        [pairs_of_run(r, t, cue, min_score) for r, t in zip(runs, truth, strict=True)]
        if runs
        else [pairs_of_truth(path, cue) for path in truth]
    )
    pairs = together(parts)
    if not len(pairs.range_m):
        raise EmptyResultError(f"--truth: the drives contain no {cue} with a range; use others")
    return pairs
