"""Compare two runs, or two sets of runs."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from crosscue.eval.catalog import compare, many_runs
from crosscue.eval.catalog.query.catalog import catalog
from crosscue.eval.pipeline.run import Run
from crosscue.eval.report.junit import cases_text
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.remote.address import is_remote
from crosscue.verb import Option


def compare_runs(
    first: Run | Path | str,
    second: Run | Path | str,
    tolerances: Sequence[str] = (),
    junit: Path | str | None = None,
    output: Path | str | None = None,
) -> compare.Comparison:
    """Compare the settings, tables and metrics of two runs.

    Args:
        first: The reference run.
        second: The run to judge.
        tolerances: Allowed deterioration of metrics: ``0.01``, ``2%`` or ``PATTERN=0.01``.
        junit: JUnit file to write, with a test case per judged metric that fails if it is worse.
        output: Page to write, with pictures of the largest differences.

    Raises:
        UsageError: A tolerance is not valid, or a run is a URL.
        RunError: A path is not a finished run.
    """
    allowed = [compare.read_tolerance(text) for text in tolerances]
    for one in (first, second):
        if not isinstance(one, Run) and is_remote(one):
            raise UsageError(f"{one}: a run on a store; use --runs and --against, or copy it")
    paths = [one.path if isinstance(one, Run) else Path(one) for one in (first, second)]
    before, after = (compare.open_scored(path) for path in paths)
    found = compare.compare_runs(before, after, allowed)
    return _reported(found, junit, output, paths[:1], paths[1:])


def compare_many(
    runs: str | Sequence[Run | Path | str],
    against: str | Sequence[Run | Path | str],
    folder: Path | str | None = None,
    tolerances: Sequence[str] = (),
    junit: Path | str | None = None,
    output: Path | str | None = None,
) -> compare.Comparison:
    """Compare many runs with others of the same drives: better, worse or undecided.

    Runs are paired by the identity of their drive. The how-to page on comparing fleets explains the
    verdicts.

    Args:
        runs: The runs to judge: their folders or, with ``folder``, a query that selects them.
        against: The runs to compare with, in the same form.
        folder: Folder of all runs, or its URL, to which the queries apply.
        tolerances: As in ``compare_runs``.
        junit: As in ``compare_runs``.
        output: As in ``compare_runs``.

    Raises:
        UsageError: A query is not valid or has no ``folder``, or a side has two runs of one drive.
        RunError: A side has no scored run.
    """
    allowed = [compare.read_tolerance(text) for text in tolerances]
    here: tuple[tuple[Path, ...], tuple[Path, ...]] = ((), ())
    if folder is not None and is_remote(folder):
        # Runs on a store have no folders, so their metrics are read from their catalog.
        found = catalog(folder)
        if not (isinstance(runs, str) and isinstance(against, str)):
            raise UsageError(f"{folder}: runs on a store; expected two queries")
        there = (found.named(against), found.named(runs))
        judged = many_runs.compare_many(*there, allowed, many_runs.score_reader(found))
    else:
        here = (_selected(against, folder), _selected(runs, folder))
        judged = many_runs.compare_many(*here, allowed)
    return _reported(judged, junit, output, *here)


def compare_command(
    first: Annotated[str, Option(metavar="RUN_A")],
    second: Annotated[str | None, Option(metavar="RUN_B", is_positional=True)] = None,
    *,
    runs: Annotated[str | None, Option(metavar="QUERY")] = None,
    against: Annotated[str | None, Option(metavar="QUERY")] = None,
    tolerance: Annotated[Sequence[str], Option(metavar="T")] = (),
    junit: Path | None = None,
    output: Annotated[Path | None, Option(metavar="HTML")] = None,
    overwrite: bool = False,
) -> compare.Comparison:
    """Compare two runs, with tolerances.

    Two runs, or two sets of runs, are compared: each metric is better, worse or undecided. Drives
    are paired, and grouped by place: the truth's place, else positions within 50 m, else the
    intersection. Fewer than six places decide nothing; the number wanted is stated. A metric that
    did not change gets a verdict in at most 5 % of comparisons, over all cues and conditions
    together. Each line shows the 95 % interval of the difference, the smallest loss that four of
    five simulated repetitions of this comparison find, and the number of further places needed for
    a decision.

    With --runs and --against, two queries on a folder of runs select the runs to judge and the runs
    to compare them with, one run per drive.

    The exit status is 1 when a metric is worse by more than its tolerance (default: 0), or is no
    longer scored. Noise alone made a metric worse in 14 of 1,000 simulated comparisons of equal
    runs over eight places. A tolerance is a number in the metric's unit or a fraction of the first
    value (2%), for all metrics or for those of a pattern. The last tolerance that matches a metric
    applies. If the two runs are not scored, the exit status is 1 when a table differs. Folders that
    crosscue score -o wrote for several runs can be compared as well.

    Examples:
        crosscue compare runs/before runs/after -o compare.html
        crosscue compare runs/before runs/after --tolerance 1% 'cues.*.precision=0.02'
        crosscue compare runs --runs "tags['model'] = 'new'" --against "tags['model'] = 'old'"

    Args:
        first: Reference run; with --runs, a folder of runs, or its URL.
        second: Run to compare with it.
        runs: Selects the runs to judge from the folder RUN_A.
        against: Selects the runs to compare them with.
        tolerance: Allowed deterioration of metrics: 0.01, 2% or PATTERN=0.01.
        junit: Write a JUnit file with a test case per judged metric.
        output: Write a page, with pictures of the largest differences.
        overwrite: Replace an existing page.
    """
    if output is not None and output.exists() and not overwrite:
        raise OutputError(f"{output}: exists; give another name or --overwrite")
    if runs is None and against is None:
        if second is None:
            raise UsageError("compare: expected two runs, or --runs and --against")
        return compare_runs(first, second, tolerance, junit, output)
    if runs is None or against is None or second is not None:
        raise UsageError("compare: expected one folder with both --runs and --against")
    return compare_many(runs, against, first, tolerance, junit, output)


def _reported(
    found: compare.Comparison,
    junit: Path | str | None,
    output: Path | str | None,
    before: Sequence[Path],
    after: Sequence[Path],
) -> compare.Comparison:
    if junit is not None:
        write_text(Path(junit), cases_text(found.cases(), "compare", "comparison"))
    if output is not None:
        from .compare_page import write_compare_page

        write_compare_page(Path(output), found, before, after)
    return found


def _selected(
    runs: str | Sequence[Run | Path | str], folder: Path | str | None
) -> tuple[Path, ...]:
    if not isinstance(runs, str):
        return tuple(one.path if isinstance(one, Run) else Path(one) for one in runs)
    if folder is None:
        raise UsageError(f"{runs!r}: a query needs the folder of the runs; pass folder")
    return catalog(folder).select(runs)
