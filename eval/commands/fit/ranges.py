"""Fit a curve from an object's height in pixels to its range, with the residual by distance.

Pairs come from a TABLE (CSV or Parquet with height_px and range_m, to the rear axle), from the
annotated objects of drives (--truth), or from what a run's detectors found (--runs beside --truth).
All families are fitted; the one with the smallest residual is offered as a section for the vehicle
file. --test measures that curve on other drives.

examples:
  crosscue fit ranges stop_signs.csv --cue stop_sign
  crosscue fit ranges --cue traffic_light --truth drives/L* --test drives/A-01 --figure light.png
  crosscue fit ranges --cue stop_sign --runs runs/A-01 --truth drives/A-01
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.detectors.ranging.height_to_range import FAMILIES, Bin, RangeFit, fit_range, residuals
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.fit.range_pairs import (
    RangePairs,
    pairs_of_run,
    pairs_of_table,
    pairs_of_truth,
    together,
)
from crosscue.replay.errors import EmptyResultError, OutputError, UsageError

PUBLISHED_SD_M = {"stop_sign": 1.7, "traffic_light": 5.9}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "table",
        nargs="?",
        type=Path,
        metavar="TABLE",
        help="CSV or Parquet file with the columns height_px and range_m",
    )
    parser.add_argument(
        "--cue",
        required=True,
        choices=tuple(PUBLISHED_SD_M),
        help="cue whose objects were measured",
    )
    parser.add_argument(
        "--truth",
        nargs="+",
        type=Path,
        metavar="TRUTH",
        default=[],
        help="drives with annotated objects and ranges",
    )
    parser.add_argument(
        "--runs",
        nargs="+",
        type=Path,
        metavar="RUN",
        default=[],
        help="take heights from these run folders, one per --truth",
    )
    parser.add_argument(
        "--min-score",
        type=float,
        default=0.9,
        metavar="P",
        help="min score of a detection (default: 0.9)",
    )
    parser.add_argument(
        "--test",
        nargs="+",
        type=Path,
        metavar="TRUTH",
        default=[],
        help="other drives to measure the curve on",
    )
    parser.add_argument("--family", choices=FAMILIES, help="fit only this family")
    parser.add_argument(
        "--bin-m",
        type=float,
        default=10.0,
        metavar="M",
        help="width of the distance bins (default: 10)",
    )
    parser.add_argument(
        "--figure", type=Path, metavar="PNG", help="figure of pairs, curves and residuals to write"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing figure")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fit and report."""
    if not args.bin_m > 0.0:
        raise UsageError(f"--bin-m {args.bin_m}: expected more than 0")
    if args.figure is not None and args.figure.exists() and not args.overwrite:
        raise OutputError(f"{args.figure}: exists; give another name or --overwrite")
    pairs = _pairs(args)
    names = (args.family,) if args.family else FAMILIES
    fits = [fit_range(*pairs, name, args.bin_m) for name in names]
    best = min(fits, key=lambda fit: fit.curve.residual_sd_m)
    tested = None
    if args.test:
        others = together(pairs_of_truth(path, args.cue) for path in args.test)
        if not len(others.range_m):
            raise EmptyResultError(f"--test: no {args.cue} in it; give other drives")
        tested = residuals(*others, best.curve, args.bin_m)
    if args.figure is not None:
        from crosscue.eval.fit.range_figure import draw

        draw(args.figure, args.cue, pairs, fits, tested)
    if args.json:
        tree: dict[str, object] = {
            "cue": args.cue,
            "best": best.curve.family,
            "fits": [_as_json(f) for f in fits],
        }
        print_json(tree if tested is None else {**tree, "tested": _as_json(tested)})
    elif not args.quiet:
        print(_report_text(args.cue, fits, best, tested))
    return 0


def _pairs(args: argparse.Namespace) -> RangePairs:
    if (args.table is None) == (not args.truth):
        raise UsageError("fit ranges: give a TABLE, or --truth with drives")
    if args.table is not None:
        return pairs_of_table(args.table)
    if args.runs and len(args.runs) != len(args.truth):
        raise UsageError(f"--runs: {len(args.runs)} runs for {len(args.truth)} drives; pair them")
    parts = (
        [
            pairs_of_run(r, t, args.cue, args.min_score)
            for r, t in zip(args.runs, args.truth, strict=True)
        ]
        if args.runs
        else [pairs_of_truth(path, args.cue) for path in args.truth]
    )
    pairs = together(parts)
    if not len(pairs.range_m):
        raise EmptyResultError(f"--truth: no {args.cue} with a range in it; give other drives")
    return pairs


def _report_text(cue: str, fits: list[RangeFit], best: RangeFit, tested: RangeFit | None) -> str:
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
