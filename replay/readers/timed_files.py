"""Pairing of the files in a folder with the times of a time file.

Files and times are paired by the first of these rules that applies:

* by name, if the time file has names;
* one by one, if their numbers are equal;
* by the numbers in the file names, if these span as many values as there are times;
* in order from the first, with a notice.

Whenever the counts differ, a notice is added.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.columns import Int64s
from crosscue.replay.errors import LogFormatError

from .time_file import TimeFile

_DIGITS: Final = re.compile(r"([0-9]+)")


@dataclass(frozen=True, slots=True, eq=False)
class TimedFiles:
    """Files of one stream and their times.

    Attributes:
        paths: N files in natural order.
        t_ns: Shape (N,), int64: times; -1 for a file without a time.
        missing_ns: Shape (M,), int64: times without a file.
        declared: Number of times in the time file, or None if it states a rate.
        notices: Remarks on the pairing, one sentence each.
    """

    paths: tuple[Path, ...]
    t_ns: Int64s
    missing_ns: Int64s
    declared: int | None
    notices: tuple[str, ...]


def list_files(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """List files with these suffixes in natural order (``2.png`` before ``10.png``).

    Hidden files are omitted.
    """
    paths = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and p.name[0] != "."]
    return sorted(paths, key=lambda path: _natural(path.name))


def pair_with_times(paths: Sequence[Path], times: TimeFile) -> TimedFiles:
    """Pair each file with its time by the rules in the module's docstring.

    Raises:
        LogFormatError: No file can be paired with a time.
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
    """Return the line of each file, by its name with or without suffix; -1 if missing."""
    at = {name: i for i, name in enumerate(names)}
    found = [at.get(path.name, at.get(path.stem, -1)) for path in paths]
    return np.array(found, dtype=np.int64)


def _in_order(paths: Sequence[Path], times: TimeFile, notices: list[str]) -> Int64s:
    """Return the line of each file, for time files without names."""
    n, lines = len(paths), len(times.t_ns)
    numbers, place = _numbers(paths), paths[0].parent.name
    has_gaps = numbers is not None and int(numbers[-1]) + 1 > n
    if times.period is not None:
        notices.append(
            f"{place}: times are computed from a constant rate of "
            f"{float(1_000_000_000 / times.period):g} Hz ({times.path.name}), starting at 0"
        )
    elif numbers is None or n == lines or int(numbers[-1]) + 1 != lines:
        if n != lines:
            notices.append(
                f"{place}: {n} files and {lines} times ({times.path.name}), which cannot be "
                "matched: paired in order from the first"
            )
        elif has_gaps and numbers is not None:
            notices.append(
                f"{place}: {int(numbers[-1]) + 1 - n} numbers are missing in the file names; there "
                "are as many times as files, so they are paired one by one"
            )
        index = np.arange(n, dtype=np.int64)
        return np.where(index < lines, index, -1)
    if has_gaps and numbers is not None:
        notices.append(
            f"{place}: {int(numbers[-1]) + 1 - n} numbers are missing in the file names; "
            "times are paired by number"
        )
    return np.arange(n, dtype=np.int64) if numbers is None else numbers


def _numbers(paths: Sequence[Path]) -> Int64s | None:
    """Return each file's index from the last number in its name; None if a name has no number.

    The median step between numbers counts as one, if all steps are multiples of it.
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
