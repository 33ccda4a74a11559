"""Numbered files in a folder and a time for each.

Files and times are paired by name where the time file has names; else one by one where there are
as many of each; else by the numbers in the file names where these span as many; else in order from
the first, which is reported. Nothing is paired in silence when the counts differ.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.base import Int64s, LogFormatError

from .time_file import TimeFile

_DIGITS: Final = re.compile(r"([0-9]+)")


@dataclass(frozen=True, slots=True, eq=False)
class TimedFiles:
    """Files of one stream and their times.

    Attributes:
        paths: N files in natural order.
        t_ns: Shape (N,), int64; -1 for a file without time.
        missing_ns: Shape (M,), int64: times whose file is not there.
        declared: How many times the time file has, or None where it states a rate.
        notices: What is odd about the pairing, a sentence each.
    """

    paths: tuple[Path, ...]
    t_ns: Int64s
    missing_ns: Int64s
    declared: int | None
    notices: tuple[str, ...]


def list_files(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Files with these suffixes in natural order (``2.png`` before ``10.png``), hidden ones not."""
    paths = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.name[0] != "."]
    return sorted(paths, key=lambda path: _natural(path.name))


def pair(paths: Sequence[Path], times: TimeFile) -> TimedFiles:
    """Give each file its time, as the module's text says.

    Raises:
        LogFormatError: Not one file gets a time.
    """
    notices = list(times.notices)
    if times.names is not None:
        index = _by_name(paths, times.names)
    else:
        index = _in_order(paths, times, notices)
    is_timed = index >= 0
    if not is_timed.any():
        raise LogFormatError(
            f"{times.path}: no line names a file of {paths[0].parent}; expected names like "
            f"{paths[0].name!r}"
        )
    t_ns = np.full(len(paths), -1, dtype=np.int64)
    t_ns[is_timed] = times.times_at(index[is_timed])
    missing = np.ones(len(times.t_ns), dtype=np.bool_)
    missing[index[is_timed] if times.period is None else []] = False
    declared = len(times.t_ns) if times.period is None else None
    return TimedFiles(tuple(paths), t_ns, times.t_ns[missing], declared, tuple(notices))


def _by_name(paths: Sequence[Path], names: Sequence[str]) -> Int64s:
    """Line of each file, by its name with or without suffix; -1 where none exists."""
    at = {name: i for i, name in enumerate(names)}
    found = [at.get(path.name, at.get(path.stem, -1)) for path in paths]
    return np.array(found, dtype=np.int64)


def _in_order(paths: Sequence[Path], times: TimeFile, notices: list[str]) -> Int64s:
    """Line of each file where lines hold no names."""
    n, lines = len(paths), len(times.t_ns)
    numbers, place = _numbers(paths), paths[0].parent.name
    has_gaps = numbers is not None and int(numbers[-1]) + 1 > n
    if times.period is not None:
        notices.append(
            f"{place}: times are made up from a constant rate of "
            f"{float(1_000_000_000 / times.period):g} Hz ({times.path.name}), starting at 0"
        )
    elif numbers is None or n == lines or int(numbers[-1]) + 1 != lines:
        if n != lines:
            notices.append(
                f"{place}: {n} files and {lines} times ({times.path.name}), and nothing says "
                "which belong together: paired in order from the first"
            )
        elif has_gaps and numbers is not None:
            notices.append(
                f"{place}: the numbers in the file names leave out {int(numbers[-1]) + 1 - n}; "
                "there are as many times as files, so they are paired one by one"
            )
        index = np.arange(n, dtype=np.int64)
        return np.where(index < lines, index, -1)
    if has_gaps and numbers is not None:
        notices.append(
            f"{place}: {int(numbers[-1]) + 1 - n} numbers are missing in the file names; "
            "times go by number"
        )
    return np.arange(n, dtype=np.int64) if numbers is None else numbers


def _numbers(paths: Sequence[Path]) -> Int64s | None:
    """Each file's place by the last number in its name, from 0, or None where none exists.

    The usual step between numbers counts as one place, if all steps are whole multiples of it.
    """
    texts = [_DIGITS.findall(path.stem) for path in paths]
    if not all(texts) or any(len(found[-1]) > 18 for found in texts):
        return None
    numbers = np.array([int(found[-1]) for found in texts], dtype=np.int64)
    steps = np.array([b - a for a, b in pairwise(numbers.tolist())], dtype=np.int64)
    if not len(steps) or steps.min() <= 0:
        return None if len(steps) else np.zeros(1, dtype=np.int64)
    usual = int(np.median(steps))
    places: Int64s = (numbers - numbers[0]) // usual
    return places if not (steps % usual).any() else None


def _natural(name: str) -> list[str | int]:
    return [int(part) if i % 2 else part for i, part in enumerate(_DIGITS.split(name))]
