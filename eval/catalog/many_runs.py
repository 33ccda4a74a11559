"""Comparison of two sets of runs, such as two versions over a fleet, paired by drive."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

from crosscue.eval.scoring.by_drive import DriveMetric, no_longer_scored
from crosscue.replay.errors import RunError, UnreadableRunError, UsageError

from .compare import Comparison, is_whole_run, open_scored, run_contributions
from .paired import Tolerance, compare_drives
from .query.catalog import Catalog

# Each drive's contribution to the metrics (None if not scored); True if no rows were dropped.
Scored: TypeAlias = tuple[list[DriveMetric] | None, bool]


class _Side(NamedTuple):
    """One of the two sets of runs.

    Attributes:
        parts: Contributions of its drives to the metrics.
        left_out: Reason why a run was left out, by run.
        is_whole: True if no rows were dropped in any run.
    """

    parts: list[DriveMetric]
    left_out: dict[str, str]
    is_whole: bool

    @property
    def logs(self) -> set[str]:
        return {one.log for one in self.parts}


def read_scored(path: Path | str) -> Scored:
    """Read the score of a run folder.

    Raises:
        RunError: The folder is not a run, or is damaged.
    """
    run = open_scored(Path(path))
    return run_contributions(run), is_whole_run(run)


def score_reader(catalog: Catalog) -> Callable[[Path | str], Scored]:
    """Return a function from a run's name in a catalog, local or on a store, to its score."""
    outcomes = catalog.query("select run, outcome from runs").to_pydict()
    is_whole = {run: outcome == "whole" for run, outcome in zip(*outcomes.values(), strict=True)}
    found: dict[str, list[DriveMetric]] = {}
    columns = "run, log, metric, kind, total, rows, places"
    table = catalog.query(
        f"select {columns} from scores where places is not null order by all"  # noqa: S608
    )
    for row in table.to_pylist():
        found.setdefault(row.pop("run"), []).append(DriveMetric(**row))
    return lambda run: (found.get(str(run)), is_whole[str(run)])


def compare_many(
    first: Sequence[Path | str],
    second: Sequence[Path | str],
    tolerances: Sequence[Tolerance] = (),
    read: Callable[[Path | str], Scored] = read_scored,
) -> Comparison:
    """Compare the scores of two sets of runs, drive by drive.

    Args:
        first: Reference runs: their folders, or other arguments of ``read``.
        second: Runs to judge.
        tolerances: The last one whose pattern matches a metric applies; if none does, no loss is
            allowed.
        read: Function that reads the score of a run.

    Raises:
        UsageError: A drive has two runs on one side.
        UnreadableRunError: No run of a side is scored.
    """
    before, after = _side(first, "--against", read), _side(second, "--runs", read)
    judged = compare_drives(before.parts, after.parts, tolerances)
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


def _side(paths: Sequence[Path | str], option: str, read: Callable[[Path | str], Scored]) -> _Side:
    parts: list[DriveMetric] = []
    left_out: dict[str, str] = {}
    run_of: dict[str, Path | str] = {}
    is_whole = True
    for path in dict.fromkeys(paths):
        try:
            found, is_run_whole = read(path)
            is_whole = is_run_whole and is_whole
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
