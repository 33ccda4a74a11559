"""Find the failures of runs, worst first, by cause."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.failures.find import failures_beside_truth, failures_without_truth
from crosscue.eval.failures.order import CauseGroup, cause_groups, diverse, ranked
from crosscue.eval.failures.record import Failure, failure_table, write_failures
from crosscue.eval.failures.record import read_failures as read_table
from crosscue.eval.interface.show import listing
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.runs import find_truth, judge_scene
from crosscue.replay.base import CrosscueError, UsageError, visible
from crosscue.replay.processes import in_processes

if TYPE_CHECKING:
    import pyarrow as pa

THRESHOLD: Final = 0.9
PRINTED: Final = 20
ENDINGS: Final = (".parquet", ".json")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Failures:
    """Failures of runs; its repr is the output of ``crosscue failures``.

    Attributes:
        failures: All failures, most severe first, or the requested number of diverse ones.
        groups: All failures that were found, grouped by kind, feature or cue, and cause.
        found: Total number of failures.
        runs: Number of runs examined.
        without_truth: Runs without truth, of which only flipped beliefs are known.
        failed: Errors of the runs that could not be examined.
        output: Table that was written; None without one.
    """

    failures: tuple[Failure, ...]
    groups: tuple[CauseGroup, ...]
    found: int
    runs: int
    without_truth: tuple[Path, ...]
    failed: Mapping[Path, CrosscueError]
    output: Path | None = None

    @property
    def table(self) -> pa.Table:
        """Return a table with one row per failure."""
        return failure_table(self.failures)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue failures``."""
        return {
            "runs": self.runs,
            "found": self.found,
            "without_truth": [str(path) for path in self.without_truth],
            "failed": {str(path): str(error) for path, error in self.failed.items()},
            "groups": [asdict(one) for one in self.groups],
            "failures": [asdict(one) for one in self.failures],
            "written": None if self.output is None else str(self.output),
        }

    def __len__(self) -> int:
        return len(self.failures)

    def __repr__(self) -> str:
        lines = [f"failures   {self.found:,} in {self.runs:,} runs"]
        if self.without_truth:
            lines.append(
                f"no truth   {len(self.without_truth):,} runs: of these, only flipped beliefs"
            )
        lines += [f"left out   {visible(str(error))}" for error in self.failed.values()]
        if self.groups:
            head = ("kind", "about", "cause", "failures", "runs", "severity")
            rows = [
                (g.kind, g.what, g.cause, g.failures, g.runs, f"{g.severity:.1f}")
                for g in self.groups
            ]
            lines += ["", listing(head, rows, 3), ""]
            head = ("severity", "run", "at s", "kind", "about", "cause")
            lines.append(
                listing(
                    head,
                    [
                        (
                            f"{one.severity:.1f}",
                            Path(one.run).name,
                            f"{one.at_s:.3f}",
                            one.kind,
                            one.what,
                            one.cause,
                        )
                        for one in self.failures[:PRINTED]
                    ],
                    6,
                )
            )
            left = len(self.failures) - PRINTED
            if left > 0:
                lines.append(f"and {left:,} more; -o writes all")
        if self.output is not None:
            lines.append(f"written to {visible(str(self.output))}")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class FindWork:
    """Search of one run for failures, in this process or in another."""

    truth: Path | None
    threshold: float
    any_log: bool

    def __call__(self, path: Path) -> tuple[tuple[Failure, ...], bool] | CrosscueError:
        """Return its failures and whether it has truth, or the error if it cannot be examined."""
        try:
            run = open_run(path)
            try:
                truth = find_truth(run, self.truth)
            except UsageError:
                return failures_without_truth(run, self.threshold), False
            scene = judge_scene(run, truth, any_log=self.any_log)
            return failures_beside_truth(run, scene, self.threshold), True
        except CrosscueError as error:
            return error


def failures(
    runs: Sequence[Path | str] | Path | str,
    *,
    truth: Path | str | None = None,
    output: Path | str | None = None,
    top: int | None = None,
    threshold: float = THRESHOLD,
    any_log: bool = False,
    workers: int = 1,
    on_runs: Callable[[int, int], None] = lambda done, of: None,
) -> Failures:
    """Find failures: missed, late or false, range outside its interval, belief flipped.

    Nothing is written into the runs. A run that cannot be examined does not stop the others.

    Args:
        runs: Run folders, folders of them, patterns, ``@list.txt``, or the result of
            ``Catalog.select``.
        truth: Truth of all runs; None for the ``truth.json`` next to each run's log.
        output: Table to write: ``.parquet`` or ``.json``.
        top: Max number of failures, from as many causes and runs as possible; None for all, by
            severity.
        threshold: Probability above which a feature counts as believed.
        any_log: Accept truth made for another file of the same drive, such as a converted log.
        workers: Number of runs to examine in parallel.
        on_runs: Called with the number of runs done, and their total.

    Raises:
        UsageError: A value is out of range, or the output has another suffix.
        RunError: No run could be examined.
    """
    path = _checked_output(output)
    if top is not None and top < 1:
        raise UsageError(f"--top {top}: expected 1 or more")
    if not 0.5 < threshold < 1.0 or workers < 1:
        raise UsageError(
            f"--threshold {threshold:g}, --workers {workers}: expected 0.5 to 1, and 1 or more"
        )
    given = [runs] if isinstance(runs, Path | str) else runs
    paths = runs_of([str(one) for one in given])
    work = FindWork(None if truth is None else Path(truth), threshold, any_log)
    found: list[Failure] = []
    failed: dict[Path, CrosscueError] = {}
    without: list[Path] = []
    for done, result in enumerate(in_processes(work, paths, workers), 1):
        one = paths[done - 1]
        if isinstance(result, CrosscueError):
            failed[one] = result
        else:
            found += result[0]
            if not result[1]:
                without.append(one)
        on_runs(done, len(paths))
    if len(failed) == len(paths):
        raise next(iter(failed.values()))
    chosen = ranked(found) if top is None else diverse(found, top)
    if path is not None:
        write_failures(chosen, path)
    return Failures(
        chosen, cause_groups(found), len(found), len(paths), tuple(without), failed, path
    )


def read_failures(table: Path | str) -> tuple[Failure, ...]:
    """Read the table that ``failures`` wrote.

    Args:
        table: ``.parquet`` or ``.json`` file; paths of runs are relative to its folder.

    Raises:
        SchemaError: The table is missing, damaged, or of another kind.
    """
    return read_table(Path(table))


def _checked_output(output: Path | str | None) -> Path | None:
    if output is None:
        return None
    path = Path(output)
    if path.suffix not in ENDINGS:
        raise UsageError(f"{path}: expected a name that ends in {' or '.join(ENDINGS)}")
    return path
