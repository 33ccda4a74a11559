"""Fit a compass to a drive: mounting, hard and soft iron, as far as the drive shows them.

The reference is the GNSS course. What a drive cannot show keeps its value and is named: a straight
drive shows the mounting alone.

example:
  crosscue fit compass drive.mcap --vehicle car.toml -o car.toml
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from crosscue.eval.commands.shared.drive_part import selection_of
from crosscue.eval.commands.shared.options import (
    add_log_arguments,
    add_vehicle_output,
    check_vehicle_output,
    limits_of,
    print_json,
)
from crosscue.eval.fit.compass import fit, section_of, with_section
from crosscue.localization.compass_fit import CompassFit
from crosscue.replay.base import write_text
from crosscue.replay.logs.opening import open_logs
from crosscue.replay.vehicle.vehicle import Vehicle, load, parse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    add_log_arguments(parser)
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="vehicle file")
    add_vehicle_output(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fit, report, and write where asked."""
    check_vehicle_output(args)
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    with open_logs(args.logs, limits_of(args)) as logs:
        fitted = fit(logs, vehicle, selection_of(args, logs))
    if args.output is not None:
        text = with_section(args.vehicle.read_text(encoding="utf-8"), fitted)
        parse(text, str(args.vehicle))
        write_text(args.output, text)
    if args.json:
        print_json(_as_json(fitted))
    elif not args.quiet:
        print(_report_text(fitted))
        if args.output is not None:
            print(f"written to {args.output}")
    return 0


def _report_text(fitted: CompassFit) -> str:
    sd_deg, turn_deg = math.degrees(fitted.residual_sd_rad), fitted.settings.mounting_yaw_rad
    bound = "at least " if fitted.persists_is_bound else ""
    lines = [
        f"readings    {fitted.readings_used} of {fitted.readings} used; headings cover "
        f"{fitted.coverage_deg} degrees of the circle",
        f"fitted      {', '.join(fitted.observable) or 'nothing'}",
        *(f"not seen    {name}: {reason}" for name, reason in fitted.not_observable),
        *(
            ["residual    not known: there is no reference heading"]
            if math.isnan(sd_deg)
            else [
                f"mounting    {math.degrees(turn_deg):.2f} +- "
                f"{math.degrees(fitted.mounting_yaw_sd_rad):.2f} degrees",
                f"residual    s.d. {sd_deg:.2f} degrees, persists for {bound}"
                f"{fitted.persists_s:.1f} s",
            ]
        ),
        "",
        "[compass]",
        *(f"{key} = {value}" for key, value in section_of(fitted).items()),
    ]
    return "\n".join(lines)


def _as_json(fitted: CompassFit) -> dict[str, object]:
    return {
        "compass": section_of(fitted),
        "observable": list(fitted.observable),
        "not_observable": dict(fitted.not_observable),
        "readings": fitted.readings,
        "readings_used": fitted.readings_used,
        "coverage_deg": fitted.coverage_deg,
        "residual_sd_rad": fitted.residual_sd_rad,
        "persists_s": fitted.persists_s,
        "persists_is_bound": fitted.persists_is_bound,
        "mounting_yaw_sd_rad": fitted.mounting_yaw_sd_rad,
    }
