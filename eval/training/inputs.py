"""Check the inputs of a training: names of layouts, and a writable output path."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal, TypeAlias

from crosscue.datasets.scenes.layout import SCORED
from crosscue.replay.errors import UsageError
from crosscue.replay.files.whole_file import write_text

Device: TypeAlias = Literal["auto", "cpu", "cuda", "mps"]
# Max number of layouts of a command, far more than can be rendered in practice.
MAX_LAYOUTS: Final = 100_000


def layouts_of(texts: Sequence[str], who: str) -> list[str]:
    """Return the layouts that names and ranges stand for: ``L0``, ``L0-L9``, ``A``, ``A-H``.

    Args:
        texts: Names and ranges.
        who: Command or option, for the error message.

    Raises:
        UsageError: A text is not a layout, a range is empty, a layout is named twice, or there are
            too many.
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


def training_layouts_of(texts: Sequence[str], who: str) -> list[str]:
    """Return the layouts of ``layouts_of``, none of which may be one of A to H.

    Raises:
        UsageError: As in ``layouts_of``, or a layout is one of those that crosscue is scored on.
    """
    names = layouts_of(texts, who)
    if scored := sorted({*names} & {*SCORED}):
        raise UsageError(
            f"{who}: {scored[0]}: expected L0, L1, and so on, because A to H are only for scoring"
        )
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
        raise UsageError(f"{who}: {text}: expected the lower layout first")
    return names


def check_place(path: Path) -> None:
    """Check, before hours of work, that a file can be written to a path.

    Raises:
        OutputError: It cannot be written.
    """
    trial = path.with_name(f".{path.name}.{os.getpid()}.trial")
    write_text(trial, "")
    trial.unlink()
