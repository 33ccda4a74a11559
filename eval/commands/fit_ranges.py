"""Fit a curve from an object's height in pixels to its range, with the residual by distance.

TABLE is a CSV or Parquet file with the columns height_px and range_m (range to the rear axle). All
families are fitted; the one with the smallest residual is offered.

example:
  crosscue fit ranges stop_signs.csv --cue stop_sign
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from crosscue.detectors.ranges import FAMILIES, RangeFit, fit_range
from crosscue.replay.columns import Floats
from crosscue.replay.errors import UsageError
from crosscue.replay.limits import MIB

from .common import print_json

MOST_BYTES = 256 * MIB


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("table", type=Path, metavar="TABLE", help="height_px and range_m")
    parser.add_argument(
        "--cue", required=True, choices=("stop_sign", "traffic_light"), help="what was measured"
    )
    parser.add_argument("--family", choices=FAMILIES, help="fit this one only")
    parser.add_argument("--bin-m", type=float, default=10.0, help="width of the distance bins")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fit and tell."""
    if not args.bin_m > 0.0:
        raise UsageError(f"--bin-m {args.bin_m}: want more than 0")
    height_px, range_m = _pairs(args.table)
    names = (args.family,) if args.family else FAMILIES
    fits = [fit_range(height_px, range_m, name, args.bin_m) for name in names]
    best = min(fits, key=lambda fit: fit.curve.residual_sd_m)
    if args.json:
        print_json(
            {"cue": args.cue, "best": best.curve.family, "fits": [_as_json(f) for f in fits]}
        )
    elif not args.quiet:
        print(_told(args.cue, fits, best))
    return 0


def _told(cue: str, fits: list[RangeFit], best: RangeFit) -> str:
    lines = [f"{fit.curve.family:15} residual s.d. {fit.curve.residual_sd_m:.2f} m" for fit in fits]
    lines += ["", f"{best.curve.family} by distance, {best.pairs} pairs:"]
    lines += [
        f"  {b.from_m:5.0f} to {b.to_m:5.0f} m  {b.pairs:6} pairs  mean {b.mean_m:+6.2f} m  "
        f"r.m.s. {b.sd_m:5.2f} m"
        for b in best.bins
    ]
    parameters = ", ".join(f"{p:.6g}" for p in best.curve.parameters)
    lines += [
        "",
        f"[ranges.{cue}]",
        f'family = "{best.curve.family}"',
        f"parameters = [{parameters}]",
        f"residual_sd_m = {best.curve.residual_sd_m:.3f}",
    ]
    return "\n".join(lines)


def _as_json(fit: RangeFit) -> dict[str, object]:
    return {
        "family": fit.curve.family,
        "parameters": list(fit.curve.parameters),
        "residual_sd_m": fit.curve.residual_sd_m,
        "pairs": fit.pairs,
        "bins": [
            {"from_m": b.from_m, "to_m": b.to_m, "pairs": b.pairs, "mean_m": b.mean_m,
             "rms_m": b.sd_m}
            for b in fit.bins
        ],
    }  # fmt: skip


def _pairs(path: Path) -> tuple[Floats, Floats]:
    try:
        if path.stat().st_size > MOST_BYTES:
            raise UsageError(f"{path}: over {MOST_BYTES // MIB} MiB; give fewer rows")
        columns = _parquet(path) if path.suffix == ".parquet" else _csv(path)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: {error}; give a table") from None
    except (KeyError, ValueError):
        raise UsageError(f"{path}: want the columns height_px and range_m, all numbers") from None
    return columns


def _csv(path: Path) -> tuple[Floats, Floats]:
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    heights, ranges = ([float(row[name] or "nan") for row in rows] for name in _COLUMNS)
    return np.array(heights), np.array(ranges)


def _parquet(path: Path) -> tuple[Floats, Floats]:
    import pyarrow.parquet as pq

    with path.open("rb") as file:
        table = pq.read_table(file, columns=list(_COLUMNS), page_checksum_verification=True)
    heights, ranges = (np.asarray(table[name].to_numpy(), np.float64) for name in _COLUMNS)
    return heights, ranges


_COLUMNS = ("height_px", "range_m")
