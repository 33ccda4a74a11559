"""Options of commands that run detectors."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from crosscue.detectors.result_cache import default_cache


def add_detector_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--detectors``, ``--draw``, ``--cache`` and ``--no-cache``."""
    parser.add_argument(
        "--detectors",
        metavar="NAMES",
        help="comma-separated names (default: all in the vehicle file); "
        "'none' estimates only the pose",
    )
    parser.add_argument(
        "--draw",
        type=int,
        default=0,
        metavar="N",
        help="write up to N camera images with detections, evenly spread over the drive",
    )
    parser.add_argument(
        "--cache",
        type=Path,
        metavar="FILE",
        help="detection cache (default: ~/.cache/crosscue/detections.sqlite)",
    )
    parser.add_argument(
        "--no-cache",
        action="store_true",
        help="run every detector again instead of using the cache",
    )


def detectors_of(args: argparse.Namespace) -> Sequence[str] | None:
    """Return detector names for ``replay_drive``: None for the vehicle file's, empty for none."""
    if args.detectors is None:
        return None
    return [] if args.detectors == "none" else str(args.detectors).split(",")


def check_named(args: argparse.Namespace) -> None:
    """Refuse what the options of ``crosscue replay`` name, before the drives are found."""
    from crosscue.eval.interface.runs.make import check_inputs

    check_inputs(args.vehicle, detectors_of(args), args.first_pose, args.landmarks)


def cache_of(args: argparse.Namespace) -> Path | None:
    """Return the path of the detection cache: as requested, or in the user's cache folder."""
    if args.no_cache:
        return None
    return default_cache() if args.cache is None else Path(args.cache)
