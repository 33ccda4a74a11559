"""Which runs a command line means: run folders, folders that hold some, patterns, lists."""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from crosscue.eval.batch.merge import is_merged
from crosscue.eval.runs.folder import FAILURE, LOCK, MANIFEST, RunFolder
from crosscue.replay.base import (
    RunError,
    UnreadableRunError,
    UsageError,
    is_remote,
    read_at_most,
)

from .query.local import LocalRuns, is_cut_short

LIST_BYTES: Final = 64 << 20


def runs_of(arguments: Sequence[str]) -> tuple[Path, ...]:
    """The run folders that RUN arguments mean, in the order given.

    A folder with a manifest or tables is a run, whole or cut short; any other stands for the runs
    in it, without those that were merged of others; ``@runs.txt`` names one per line; a pattern
    that the shell left alone stands for what it matches.

    Raises:
        RunError: A folder that neither is nor holds a run.
        UsageError: A pattern without a match, a list that cannot be read, a run named twice, or a
            URL.
    """
    found = tuple(path for text in arguments for path in _expanded(text))
    for path, count in Counter(path.resolve() for path in found).items():
        if count > 1:
            raise UsageError(f"{path}: a run named twice; name each once")
    return found


def _expanded(text: str) -> Iterator[Path]:
    if is_remote(text):
        raise UsageError(
            f"{text}: runs on a store; copy those that are needed to this machine (query, compare "
            "and history read them there)"
        )
    if text.startswith("@"):
        for line in _lines(Path(text[1:])):
            yield from _expanded(line)
    elif glob.has_magic(text) and not Path(text).exists():
        matched = [path for path in sorted(glob.glob(text)) if Path(path).is_dir()]  # noqa: PTH207
        if not matched:
            raise UsageError(f"{text}: nothing matches; give folders of runs")
        for path in matched:
            yield from _expanded(path)
    else:
        yield from _in_folder(Path(text))


def _in_folder(folder: Path) -> Iterator[Path]:
    if not folder.is_dir() or _is_run({entry.name for entry in _listed(folder)}):
        # What is wrong with it, if anything, is reported when it is opened.
        yield folder
        return
    below = ((folder / one.run, one.file) for one in LocalRuns(folder).find())
    found = [run for run, file in below if not (_is_merged(run) or _is_bare(run, file))]
    if not found:
        raise UnreadableRunError(
            f"{folder}: neither a run folder nor a folder of some; replay first"
        )
    yield from found


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise UnreadableRunError(f"{folder}: {error.strerror}; check its owner and mode") from None


def _is_run(names: set[str]) -> bool:
    """Does a folder with these files hold a run? Cut short it must be reported, not passed over."""
    return MANIFEST in names or is_cut_short(names)


def _is_bare(folder: Path, file: str) -> bool:
    """Did a run fail before it left anything but the reason? Batches and catalogs report those."""
    return file == FAILURE and {entry.name for entry in _listed(folder)} <= {FAILURE, LOCK}


def _is_merged(folder: Path) -> bool:
    try:
        return is_merged(RunFolder(folder))
    except RunError:
        return False


def _lines(path: Path) -> list[str]:
    try:
        content = read_at_most(path, LIST_BYTES)
        if content is None:
            raise UsageError(f"@{path}: larger than {LIST_BYTES >> 20} MiB; give a list of runs")
        lines = content.decode("utf-8", "surrogateescape").splitlines()
    except OSError as error:
        raise UsageError(f"@{path}: {error.strerror}; give a text file") from None
    named = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    if not named:
        raise UsageError(f"@{path}: names no run; give a line for each")
    return [str(path.parent / line) for line in named]
