"""What training begins with: names of layouts, and a place that can be written to."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from crosscue.datasets.scenes.layout import SCORED
from crosscue.replay.base import UsageError, write_text

MAX_LAYOUTS: Final = 100_000
"""Layouts a command takes; far more than anybody has the time to render."""


def layouts_of(texts: Sequence[str], who: str) -> list[str]:
    """Layouts of names and spans: ``L0``, ``L0-L9``, ``A``, ``A-H``.

    Args:
        texts: As given.
        who: The command or flag, for the error.

    Raises:
        UsageError: Not a layout, an empty span, one named twice, or too many.
    """
    names: list[str] = []
    for text in texts:
        names += _span(text, who)
        if len(names) > MAX_LAYOUTS:
            raise UsageError(f"{who}: {text}: expected at most {MAX_LAYOUTS:,} layouts; give fewer")
    if len(set(names)) != len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise UsageError(f"{who}: {twice}: named twice; name each layout once")
    return names


def learnt_layouts_of(texts: Sequence[str], who: str) -> list[str]:
    """``layouts_of``, for learning from.

    Raises:
        UsageError: One is of those that are scored, too.
    """
    names = layouts_of(texts, who)
    if scored := sorted({*names} & {*SCORED}):
        raise UsageError(f"{who}: {scored[0]}: A to H are only for scoring; take L and a number")
    return names


def _span(text: str, who: str) -> Sequence[str]:
    numbers = re.fullmatch(r"L(\d{1,9})(?:-L(\d{1,9}))?", text)
    letters = re.fullmatch(r"([A-H])(?:-([A-H]))?", text)
    if numbers is not None:
        first, last = int(numbers[1]), int(numbers[2] or numbers[1])
        names: Sequence[str] = [f"L{k}" for k in range(first, min(last, first + MAX_LAYOUTS) + 1)]
    elif letters is not None:
        names = SCORED[SCORED.index(letters[1]) : SCORED.index(letters[2] or letters[1]) + 1]
    else:
        raise UsageError(f"{who}: {text!r} is not a layout; expected L0, L0-L99, A or A-H")
    if not names:
        raise UsageError(f"{who}: {text}: expected the lower one first")
    return names


def check_place(path: Path) -> None:
    """Find out before hours of work whether a file can be written there.

    Raises:
        OutputError: It cannot.
    """
    trial = path.with_name(f".{path.name}.{os.getpid()}.trial")
    write_text(trial, "")
    trial.unlink()
