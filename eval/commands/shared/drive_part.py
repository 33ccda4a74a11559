"""The part of a drive that ``--from``, ``--to`` and ``--topics`` ask for."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from crosscue.eval.interface.logs.log import Log as DriveLog
from crosscue.eval.interface.logs.log import open as open_drive
from crosscue.replay.logs.log_part import part_in_words
from crosscue.replay.logs.opening import unless_damaged

from .terminal import limits_of


@contextmanager
def open_part(args: argparse.Namespace, logs: Sequence[Path | str]) -> Iterator[DriveLog]:
    """The drive, open, of which only the part asked for is read."""
    with open_drive(*logs, limits=limits_of(args)) as log, unless_damaged(log.logs):
        part = part_in_words(log.logs, args.start, args.end, args.topics)
        yield replace(log, selection=part)
