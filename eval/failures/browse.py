"""Write failures as a static site to browse."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Final

from crosscue.eval.failures.order import ranked
from crosscue.eval.failures.record import Failure, read_failures
from crosscue.eval.failures.site import MARKER, RunWork, by_run, site_entries, write_lists
from crosscue.eval.pipeline.run import moved_to
from crosscue.eval.runs import owned
from crosscue.replay.errors import CrosscueError, EmptyResultError, UsageError
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.processes import in_processes
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted, visible
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option, keywords

from .search import ENDINGS, Failures, FailureSettings, search

# Number of reasons for missing pictures to print.
PRINTED: Final = 3


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Site(Result):
    """A static site of failures; its text is the output of ``crosscue browse``.

    Attributes:
        index: First page of the site.
        failures: Number of failures.
        pictures: Number of frames with a picture.
        without_picture: Number of failures without a picture.
        reasons: Reasons for missing pictures.
        found: The failures; None if they were read from a table.
    """

    index: Path
    failures: int
    pictures: int
    without_picture: int
    reasons: tuple[str, ...]
    found: Failures | None = field(metadata=HIDDEN)

    also: ClassVar = {"failed": "failed"}

    @property
    def is_whole(self) -> bool:
        """True if every run could be examined."""
        return self.found is None or not self.found.failed

    @property
    def failed(self) -> Mapping[Path, CrosscueError]:
        """Errors of the runs that could not be examined."""
        return {} if self.found is None else self.found.failed

    def lines(self) -> Iterator[str]:
        """Yield counts, reasons of missing pictures, and the page to open."""
        yield f"failures   {self.failures:,}, {counted(self.pictures, 'picture')}"
        if self.without_picture:
            yield f"           {counted(self.without_picture, 'failure')} without a picture"
        yield from (f"           {visible(why)}" for why in self.reasons[:PRINTED])
        if len(self.reasons) > PRINTED:
            yield f"           and {counted(len(self.reasons) - PRINTED, 'more reason')} (--json)"
        yield from (f"left out   {visible(str(error))}" for error in self.failed.values())
        yield f"open       {visible(str(self.index.resolve()))}"


@dataclass(frozen=True, slots=True, kw_only=True)
class BrowseSettings(FailureSettings):
    """Settings of a site of failures.

    Attributes:
        logs: Folder that the run's logs have moved to; they are recognised by content.
        limits: Limits for reading the logs.
        overwrite: Replace an existing site.
    """

    logs: Annotated[Path | str | None, Option(metavar="DIR")] = None
    limits: LimitsGiven = DEFAULT_LIMITS
    overwrite: bool = False


@keywords(BrowseSettings, 2)
def browse(
    runs: Annotated[Sequence[str | Path] | Path | str, Option(metavar="RUN")],
    output: Path | str,
    settings: BrowseSettings,
) -> Site:
    """Write failures as a static site with pictures and filters.

    It needs no server. RUN is a run folder, a folder of runs, or a table from crosscue failures.
    Open index.html in a browser. Each failure is shown with its picture (with boxes, masks and
    regions), the belief around that time, and the command that opens Rerun at that time.

    Examples:
        crosscue browse runs -o site
        crosscue browse worst.parquet -o site

    Args:
        runs: Run folders, folders of them, or a table.
        output: Folder of the site.
        settings: What to show.

    Raises:
        UsageError: A value is out of range, or a table is combined with other runs.
        EmptyResultError: There is no failure.
        UsageError: ``overwrite`` would delete files that an earlier call did not write.
        OutputError: The folder is not empty, or cannot be written.
    """
    folder = Path(output)
    owned.check_place(folder, MARKER, overwrite=settings.overwrite)
    moved = moved_to(settings.logs)
    chosen, found = _given(runs, settings)
    if not chosen:
        raise EmptyResultError(f"{folder}: no failure to show; nothing was written")
    entries = site_entries(chosen)
    with owned.new_folder(folder, MARKER) as made:
        for part in ("f", "p", "t", "by"):
            (made / part).mkdir()
        truth = None if settings.truth is None else Path(settings.truth)
        work = RunWork(made, len(entries), moved, settings.limits, truth)
        groups, pictures, reasons = by_run(entries), frozenset[str](), []
        for done, (written, why) in enumerate(in_processes(work, groups, settings.workers), 1):
            pictures |= written
            reasons += [why] if why else []
            emit(Progress("drawing", done, len(groups), "runs"))
        write_lists(made, entries, pictures)
    bare = sum(one.picture not in pictures for one in entries)
    return Site(
        folder / "index.html", len(entries), len(pictures), bare, tuple(sorted(set(reasons))), found
    )


def _given(
    runs: Sequence[Path | str] | Path | str, settings: FailureSettings
) -> tuple[tuple[Failure, ...], Failures | None]:
    """Return the failures of runs or of a table, and, for runs, how they were found."""
    given = [Path(one) for one in ([runs] if isinstance(runs, Path | str) else runs)]
    if any(one.suffix in ENDINGS for one in given):
        if len(given) > 1 or settings.top is not None:
            raise UsageError(f"{given[0]}: expected either runs, or one table without --top")
        return ranked(read_failures(given[0])), None
    found = search(given, settings)
    return ranked(found.failures), found
