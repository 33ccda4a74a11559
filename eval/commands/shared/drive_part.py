"""The part of a drive that ``--from``, ``--to`` and ``--topics`` ask for."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from crosscue.eval.interface.logs import Log as DriveLog
from crosscue.eval.interface.logs import open as open_drive
from crosscue.replay.base import Log, Selection, UsageError
from crosscue.replay.logs.log_part import first_ns, named_topics
from crosscue.replay.logs.opening import unless_damaged

from .options import limits_of


@contextmanager
def open_part(args: argparse.Namespace, logs: Sequence[Path | str]) -> Iterator[DriveLog]:
    """The drive, open, of which only the part asked for is read."""
    with open_drive(*logs, limits=limits_of(args)) as log, unless_damaged(log.logs):
        yield replace(log, selection=selection_of(args, log.logs))


def selection_of(args: argparse.Namespace, logs: Sequence[Log]) -> Selection:
    """The part asked for by ``--from``, ``--to`` and ``--topics``.

    Raises:
        UsageError: A time that cannot be read, an empty span, or a topic that no log has.
    """
    topics = named_topics(logs, args.topics, "--topics") if args.topics else None
    if args.start is None and args.end is None:
        return Selection(topics)
    start_ns = _time_ns("--from", args.start, logs)
    end_ns = _time_ns("--to", args.end, logs)
    if start_ns is not None and end_ns is not None and end_ns <= start_ns:
        raise UsageError(f"--to {args.end}: not after --from {args.start}; give a later time")
    return Selection(topics, start_ns, end_ns)


def _time_ns(flag: str, text: str | None, logs: Sequence[Log]) -> int | None:
    if text is None:
        return None
    if re.fullmatch(r"-?\d+ns", text):
        return int(text[:-2])
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise UsageError(
            f"{flag} {text}: expected seconds after the start (12.5) or absolute time (17...ns)"
        )
    return first_ns(logs) + round(seconds * 1e9)
