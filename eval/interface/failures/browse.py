"""Write failures as a static site to browse."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.eval.failures.order import ranked
from crosscue.eval.failures.record import Failure, read_failures
from crosscue.eval.failures.site import MARKER, RunWork, by_run, entries_of, write_lists
from crosscue.eval.pipeline.run import moved_to, open_run
from crosscue.eval.recording.view import save_recording
from crosscue.eval.runs import owned
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    EmptyResultError,
    Limits,
    OutputError,
    UsageError,
    cannot_write,
    visible,
)
from crosscue.replay.processes import in_processes

from .failures import ENDINGS, Failures, failures

PRINTED: Final = 3
"""Number of reasons for missing pictures to print."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Site:
    """A static site of failures; its repr is the output of ``crosscue browse``.

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
    found: Failures | None

    @property
    def is_whole(self) -> bool:
        """True if every run could be examined."""
        return self.found is None or not self.found.failed

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue browse``."""
        return {
            "index": str(self.index),
            "failures": self.failures,
            "pictures": self.pictures,
            "without_picture": self.without_picture,
            "reasons": list(self.reasons),
            "failed": {}
            if self.found is None
            else {str(path): str(error) for path, error in self.found.failed.items()},
        }

    def __repr__(self) -> str:
        lines = [f"failures   {self.failures:,}, {self.pictures:,} pictures"]
        if self.without_picture:
            lines.append(f"           {self.without_picture:,} failures without a picture")
        lines += [f"           {visible(why)}" for why in self.reasons[:PRINTED]]
        if len(self.reasons) > PRINTED:
            lines.append(f"           and {len(self.reasons) - PRINTED:,} more reasons (--json)")
        if self.found is not None:
            lines += [f"left out   {visible(str(error))}" for error in self.found.failed.values()]
        lines.append(f"open       {visible(str(self.index.resolve()))}")
        return "\n".join(lines)


def browse(
    runs: Sequence[Path | str] | Path | str,
    output: Path | str,
    *,
    truth: Path | str | None = None,
    top: int | None = None,
    threshold: float = 0.9,
    any_log: bool = False,
    logs: Path | str | None = None,
    limits: Limits = DEFAULT_LIMITS,
    has_recordings: bool = False,
    overwrite: bool = False,
    workers: int = 1,
    on_runs: Callable[[int, int], None] = lambda done, of: None,
) -> Site:
    """Write failures as a static site: pages, pictures and charts that need no server.

    Args:
        runs: As in ``failures``; or a table that ``failures`` wrote.
        output: Folder of the site, new or empty.
        truth: As in ``failures``.
        top: As in ``failures``.
        threshold: As in ``failures``.
        any_log: As in ``failures``.
        logs: Folder that the runs' logs have moved to.
        limits: Limits for reading the logs.
        has_recordings: Also write a recording of each failure, of some megabytes each.
        overwrite: Replace an earlier site.
        workers: Number of runs to draw in parallel.
        on_runs: Called with the number of runs drawn, and their total.

    Raises:
        UsageError: A value is out of range, or a table is combined with other runs.
        EmptyResultError: There is no failure.
        UsageError: ``overwrite`` would delete files that an earlier call did not write.
        OutputError: The folder is not empty, or cannot be written.
    """
    folder = Path(output)
    _check_place(folder, overwrite)
    moved = moved_to(logs)
    chosen, found = _given(runs, truth, top, threshold, any_log, workers)
    if not chosen:
        raise EmptyResultError(f"{folder}: no failure to show; nothing was written")
    entries = entries_of(chosen)
    made = folder.with_name(f".{folder.name}.partial")
    try:
        shutil.rmtree(made, ignore_errors=True)
        for part in ("f", "p", "t", "by", *(["r"] if has_recordings else [])):
            (made / part).mkdir(parents=True)
        work = RunWork(made, len(entries), moved, has_recordings, limits)
        groups, pictures, reasons = by_run(entries), frozenset[str](), []
        for done, (written, why) in enumerate(in_processes(work, groups, workers), 1):
            pictures |= written
            reasons += [why] if why else []
            on_runs(done, len(groups))
        if has_recordings:
            for one in entries:
                path = made / "r" / f"{one.number:05d}.rrd"
                run = open_run(one.failure.run, moved, limits=limits)
                save_recording(run, path, at=f"{one.failure.t_ns}ns")
        write_lists(made, entries, pictures)
        owned.replace_folder(made, folder, owned.of_list(folder / MARKER))
    except OSError as error:
        raise cannot_write(Path(error.filename or folder), error) from None
    finally:
        shutil.rmtree(made, ignore_errors=True)
    bare = sum(one.picture not in pictures for one in entries)
    return Site(
        folder / "index.html", len(entries), len(pictures), bare, tuple(sorted(set(reasons))), found
    )


def _check_place(folder: Path, overwrite: bool) -> None:
    try:
        there = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    except OSError as error:
        raise cannot_write(folder, error) from None
    if there and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; give another folder")
    if there and not overwrite:
        raise OutputError(f"{folder}: holds files already; give another folder or --overwrite")
    if there:
        owned.refuse_others(folder, owned.of_list(folder / MARKER))


def _given(
    runs: Sequence[Path | str] | Path | str,
    truth: Path | str | None,
    top: int | None,
    threshold: float,
    any_log: bool,
    workers: int,
) -> tuple[tuple[Failure, ...], Failures | None]:
    """Return the failures of runs or of a table, and, for runs, how they were found."""
    given = [Path(one) for one in ([runs] if isinstance(runs, Path | str) else runs)]
    if any(one.suffix in ENDINGS for one in given):
        if len(given) > 1 or top is not None:
            raise UsageError(f"{given[0]}: expected either runs, or one table without --top")
        return ranked(read_failures(given[0])), None
    found = failures(
        [str(one) for one in given],
        truth=truth,
        top=top,
        threshold=threshold,
        any_log=any_log,
        workers=workers,
    )
    return ranked(found.failures), found
