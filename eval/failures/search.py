"""Find the failures of runs, worst first, by cause."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

import pyarrow as pa

from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.catalog.query.catalog import catalog
from crosscue.eval.failures.find import (
    failures_beside_truth,
    failures_unlabelled,
    failures_without_truth,
)
from crosscue.eval.failures.order import CauseGroup, cause_groups, diverse, ranked
from crosscue.eval.failures.record import Failure, failure_table, write_failures
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.runs import find_truth, judge_scene, remembered_truth
from crosscue.replay.errors import CrosscueError, EmptyResultError, OutputError, UsageError
from crosscue.replay.processes import in_processes
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted, visible
from crosscue.results import HIDDEN, Result, json_key, listing
from crosscue.verb import Option, keywords

THRESHOLD: Final = 0.9
PRINTED: Final = 20
ENDINGS: Final = (".parquet", ".json")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Failures(Result):
    """Failures of runs; its text is the output of ``crosscue failures``.

    Attributes:
        failures: All failures, most severe first, or the requested number of diverse ones.
        groups: All failures that were found, grouped by kind, feature or cue, and cause.
        found: Total number of failures.
        runs: Number of runs examined.
        without_truth: Runs without truth, of which only flipped beliefs are known.
        failed: Errors of the runs that could not be examined.
        output: Table that was written; None without one.
        is_unlabelled: True if no truth was used.
    """

    failures: tuple[Failure, ...]
    groups: tuple[CauseGroup, ...]
    found: int
    runs: int
    without_truth: tuple[Path, ...]
    failed: Mapping[Path, CrosscueError]
    output: Path | None = field(default=None, metadata=json_key("written"))
    is_unlabelled: bool = field(default=False, metadata=HIDDEN)

    @property
    def table(self) -> pa.Table:
        """Return a table with one row per failure."""
        return failure_table(self.failures)

    @property
    def exit_status(self) -> int:
        """3 when a run could not be examined, else 0."""
        return 3 if self.failed else 0

    def __len__(self) -> int:
        return len(self.failures)

    def lines(self) -> Iterator[str]:
        """Yield counts, causes, and the worst failures."""
        yield f"failures   {self.found:,} in {counted(self.runs, 'run')}"
        if self.without_truth:
            more = (
                ""
                if self.is_unlabelled
                else ": of these, only flipped beliefs (--unlabelled: more)"
            )
            yield f"no truth   {counted(len(self.without_truth), 'run')}{more}"
        yield from (f"left out   {visible(str(error))}" for error in self.failed.values())
        if self.groups:
            yield from self._tables()
        if self.output is not None:
            yield f"written to {visible(str(self.output))}"

    def _tables(self) -> Iterator[str]:
        head = ("kind", "about", "cause", "failures", "runs", "severity")
        rows = [
            (g.kind, g.what, g.cause, g.failures, g.runs, f"{g.severity:.1f}") for g in self.groups
        ]
        yield from ("", listing(head, rows, 3), "")
        head = ("severity", "run", "at s", "kind", "about", "cause")
        worst = [
            (
                f"{one.severity:.1f}",
                Path(one.run).name,
                f"{one.at_s:.3f}",
                one.kind,
                one.what,
                one.cause,
            )
            for one in self.failures[:PRINTED]
        ]
        yield listing(head, worst, 6)
        left = len(self.failures) - PRINTED
        if left > 0:
            yield f"and {left:,} more; -o writes all"


@dataclass(frozen=True, slots=True)
class FindWork:
    """Search of one run for failures, in this process or in another."""

    truth: Path | None
    threshold: float
    any_log: bool
    is_unlabelled: bool

    def __call__(self, path: Path) -> tuple[tuple[Failure, ...], bool] | CrosscueError:
        """Return its failures and whether it has truth, or the error if it cannot be examined."""
        try:
            run = open_run(path)
            if self.is_unlabelled:
                return failures_unlabelled(run, self.threshold), False
            try:
                known = remembered_truth(run) if self.truth is None else None
                truth = find_truth(run, self.truth) if known is None else known.path
            except UsageError:
                return failures_without_truth(run, self.threshold), False
            any_log = self.any_log or (known is not None and known.any_log)
            scene = judge_scene(run, truth, any_log=any_log)
            return failures_beside_truth(run, scene, self.threshold), True
        except CrosscueError as error:
            return error


@dataclass(frozen=True, slots=True, kw_only=True)
class FailureSettings:
    """Settings of a search for failures.

    Attributes:
        truth: Truth of all runs (default: that of each run's last score, or truth.json next to
            its log).
        any_log: Accept truth made for another file of the same drive, such as a converted log.
        unlabelled: Rank what looks wrong without any truth: the belief, the way the car was driven,
            other cues or other detectors contradict a cue.
        top: Only N failures, from as many causes and runs as possible (default: all).
        threshold: Probability above which a feature counts as believed.
        workers: Number of runs in parallel.
    """

    truth: Path | str | None = None
    any_log: bool = False
    unlabelled: bool = False
    top: int | None = None
    threshold: float = THRESHOLD
    workers: int = 1

    def __post_init__(self) -> None:
        """Check numbers.

        Raises:
            UsageError: A number is out of range.
        """
        if self.unlabelled and self.truth is not None:
            raise UsageError("unlabelled, truth: expected one of them")
        if self.top is not None and self.top < 1:
            raise UsageError(f"top: {self.top}, expected 1 or more")
        if not 0.5 < self.threshold < 1.0:
            raise UsageError(f"threshold: {self.threshold:g}, expected 0.5 to 1")
        if self.workers < 1:
            raise UsageError(f"workers: {self.workers}, expected 1 or more")


@dataclass(frozen=True, slots=True, kw_only=True)
class SearchSettings(FailureSettings):
    """Settings of a search whose result may be written.

    Attributes:
        where: Only runs that this query selects; RUN is then one folder.
        output: Table to write: .parquet or .json.
        overwrite: Replace an existing table.
    """

    where: Annotated[str | None, Option(metavar="QUERY")] = None
    output: Annotated[Path | str | None, Option(metavar="TABLE")] = None
    overwrite: bool = False


@keywords(SearchSettings)
def failures(
    runs: Annotated[Sequence[str | Path] | Path | str, Option(metavar="RUN")],
    settings: SearchSettings,
) -> Failures:
    """List what went wrong in runs, worst first, by cause.

    There are five kinds: a feature or cue that exists and was missed; a feature believed only
    within 8 m of the intersection (late); a feature believed, or a cue found, that does not exist
    (false); a range outside its 95 % interval; and a belief that was decided and then flipped.
    Without truth, only the last kind can be detected; --unlabelled ranks moments worth a look.
    Severity is in bits; docs/howto/failures.md explains it. --top picks the worst failure of every
    cause and run before a second one of any.
    Nothing is written into the runs. A run that cannot be examined does not stop the others.

    Examples:
        crosscue failures runs
        crosscue failures runs --top 20 -o worst.parquet
        crosscue failures runs --where "'dusk' in conditions"
        crosscue failures runs --unlabelled --top 50 -o to_label.parquet

    Args:
        runs: Run folders, or folders of them.
        settings: What to search.

    Raises:
        UsageError: A value is out of range, or the output has another suffix.
        OutputError: The output exists.
        RunError: No run could be examined.
    """
    path = _checked_output(settings.output)
    if path is not None and path.exists() and not settings.overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")
    given = [runs] if isinstance(runs, Path | str) else runs
    if settings.where is not None:
        given = _selected(given, settings.where)
    return search(given, settings, path)


def _selected(runs: Sequence[Path | str], where: str) -> Sequence[Path]:
    if len(runs) != 1:
        raise UsageError("where: expected one folder of runs to select from")
    found = catalog(runs[0]).select(where)
    if not found:
        raise EmptyResultError(f"{runs[0]}: no run where {where}")
    return found


def search(
    runs: Sequence[Path | str], settings: FailureSettings, output: Path | None = None
) -> Failures:
    """Find failures of runs, and write them to a table if ``output`` is not None."""
    paths = runs_of([str(one) for one in runs])
    truth = None if settings.truth is None else Path(settings.truth)
    work = FindWork(truth, settings.threshold, settings.any_log, settings.unlabelled)
    found: list[Failure] = []
    failed: dict[Path, CrosscueError] = {}
    without: list[Path] = []
    for done, result in enumerate(in_processes(work, paths, settings.workers), 1):
        one = paths[done - 1]
        if isinstance(result, CrosscueError):
            failed[one] = result
        else:
            found += result[0]
            if not result[1]:
                without.append(one)
        emit(Progress("examining", done, len(paths), "runs"))
    if len(failed) == len(paths):
        raise next(iter(failed.values()))
    chosen = ranked(found) if settings.top is None else diverse(found, settings.top)
    if output is not None:
        write_failures(chosen, output)
    return Failures(
        chosen,
        cause_groups(found),
        len(found),
        len(paths),
        tuple(without),
        failed,
        output,
        settings.unlabelled,
    )


def _checked_output(output: Path | str | None) -> Path | None:
    if output is None:
        return None
    path = Path(output)
    if path.suffix not in ENDINGS:
        raise UsageError(f"{path}: expected a name that ends in {' or '.join(ENDINGS)}")
    return path
