"""Many runs against many: two versions or settings over a fleet, paired by drive."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from crosscue.eval.scoring.by_drive import DriveMetric, no_longer_scored
from crosscue.replay.base import RunError, UnreadableRunError, UsageError

from .compare import Comparison, Tolerance, allowed_by, is_whole_run, open_scored, parts_of
from .paired import compare_drives


class _Side(NamedTuple):
    """Attributes: ``parts``: of each drive's metrics; ``left_out``: by run, why."""

    parts: list[DriveMetric]
    left_out: dict[str, str]
    is_whole: bool

    @property
    def logs(self) -> set[str]:
        """Identities of its drives."""
        return {one.log for one in self.parts}


def compare_many(
    first: Sequence[Path], second: Sequence[Path], tolerances: Sequence[Tolerance] = ()
) -> Comparison:
    """Compare the scores of two sets of runs, drive by drive.

    Args:
        first: Runs that were good.
        second: Runs to judge.
        tolerances: The last one whose pattern fits a metric counts; without any, none.

    Raises:
        UsageError: A drive has two runs on one side.
        UnreadableRunError: No run of a side is scored.
    """
    before, after = _side(first, "--against"), _side(second, "--runs")
    judged = compare_drives(
        before.parts, after.parts, lambda path, value: allowed_by(path, value, tolerances)
    )
    both, theirs, ours = before.logs & after.logs, before.logs, after.logs
    return Comparison(
        changes=(),
        tables=(),
        judged=judged,
        metrics=(),
        no_longer_scored=no_longer_scored(before.parts, after.parts),
        tables_same=0,
        drives=(len(both), len(theirs - ours), len(ours - theirs)),
        why_no_metrics="",
        is_whole=before.is_whole and after.is_whole,
        left_out={**before.left_out, **after.left_out},
        is_many=True,
    )


def _side(paths: Sequence[Path], option: str) -> _Side:
    parts: list[DriveMetric] = []
    left_out: dict[str, str] = {}
    run_of: dict[str, Path] = {}
    is_whole = True
    for path in dict.fromkeys(paths):
        try:
            run = open_scored(path)
            found = parts_of(run)
            is_whole = is_whole_run(run) and is_whole
        except RunError as error:
            left_out[str(path)] = str(error)
            continue
        if found is None:
            left_out[str(path)] = "not scored, or by an earlier version; crosscue score it"
            continue
        for log in {one.log for one in found}:
            other = run_of.setdefault(log, path)
            if other != path:
                raise UsageError(
                    f"{option}: {other} and {path} are runs of one drive; narrow the query to one "
                    "run of each, such as by tag, settings or time"
                )
        parts += found
    if not parts:
        why = next(iter(left_out.values()), "it selects no run")
        raise UnreadableRunError(f"{option}: no scored run: {why}")
    return _Side(parts, left_out, is_whole and not left_out)
