"""Options and output of the study commands."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeVar

import crosscue

from .terminal import print_json

if TYPE_CHECKING:
    from crosscue.eval.studies.town.settings import FieldStudy, LandmarkStudy, RangeStudy

FLAGS: Final = ("drives", "seed", "range_runs", "landmark_runs", "minutes")

AnyStudy = TypeVar("AnyStudy", "RangeStudy", "LandmarkStudy", "FieldStudy")


def add_study_arguments(parser: argparse.ArgumentParser, folder: str) -> None:
    """Add ``-o``, ``--settings``, ``--seed``, ``--workers``, ``--overwrite`` and ``--json``."""
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path(folder),
        metavar="DIR",
        help=f"folder for drives, summary, figures and page (default: {folder})",
    )
    parser.add_argument(
        "--settings", type=Path, metavar="X.toml", help="settings of your own study"
    )
    parser.add_argument("--seed", type=int, metavar="N", help="random seed")
    parser.add_argument(
        "--workers", type=int, metavar="N", help="number of threads (default: all cores)"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace existing results of another study"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_cluster_arguments(parser: argparse.ArgumentParser) -> None:
    """Add ``--drives`` and ``--ray``."""
    parser.add_argument("--drives", type=int, metavar="N", help="drives per combination")
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="run on a Ray cluster: its address, auto, or local"
    )


def study_of(args: argparse.Namespace, kind: type[AnyStudy]) -> AnyStudy:
    """Return the settings of ``--settings`` or of the published study, with the options applied.

    Raises:
        UsageError: An option is out of range.
        StudyFileError: The file is not valid.
    """
    from pydantic import ValidationError

    from crosscue.eval.studies.town.settings import load_study

    study = kind() if args.settings is None else load_study(args.settings, kind)
    flags = {name: getattr(args, name, None) for name in FLAGS}
    changed = {name: value for name, value in flags.items() if value is not None}
    try:
        return kind.model_validate({**dict(study), **changed})
    except ValidationError as error:
        first = error.errors()[0]
        flag = str(first["loc"][0])
        raise crosscue.UsageError(
            f"--{flag.replace('_', '-')} {changed.get(flag)}: {first['msg'].lower()}"
        ) from None


def workers_of(args: argparse.Namespace) -> int:
    """Return the number of threads.

    Raises:
        UsageError: ``--workers`` is below 1.
    """
    from crosscue.eval.studies.town.work import default_workers

    if args.workers is None:
        return default_workers()
    if args.workers < 1:
        raise crosscue.UsageError(f"--workers {args.workers}: expected 1 or more")
    return int(args.workers)


def print_study(found: crosscue.StudyResult, args: argparse.Namespace) -> None:
    """Print the tables and the paths of the page and the drives, or the summary as JSON."""
    if args.json:
        print_json(found.as_dict())
    elif not args.quiet:
        print(found)
        print(f"\npage       {found.page}\ndrives     {args.output / 'drives.parquet'}")
