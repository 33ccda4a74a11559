"""Two runs compared."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from crosscue.eval.catalog import compare
from crosscue.eval.interface.runs.run import Run


def compare_runs(
    first: Run | Path | str, second: Run | Path | str, tolerances: Sequence[str] = ()
) -> compare.Comparison:
    """What changed from one run to another: settings, tables, metrics, and what is worse.

    Args:
        first: The run to compare with.
        second: The run to judge.
        tolerances: How much worse metrics may be: ``0.01``, ``2%`` or ``PATTERN=0.01``.
    """
    allowed = [compare.read_tolerance(text) for text in tolerances]
    paths = [one.path if isinstance(one, Run) else Path(one) for one in (first, second)]
    before, after = (compare.open_scored(path) for path in paths)
    return compare.compare_runs(before, after, allowed)
