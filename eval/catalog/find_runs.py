"""Runs that a command line names: run folders, folders of runs, patterns and lists."""

import glob
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

from crosscue.eval.batch.merge import is_merged
from crosscue.eval.runs.folder import FAILURE, LOCK, MANIFEST, RunFolder
from crosscue.replay.errors import RunError, UnreadableRunError, UsageError
from crosscue.replay.files.bounded import read_text
from crosscue.replay.remote.address import is_remote

from .query.local import LocalRuns, is_cut_short

LIST_BYTES: Final = 64 << 20


def runs_of(arguments: Sequence[str]) -> tuple[Path, ...]:
    """Return the run folders that RUN arguments name, in the order of the arguments.

    A folder with a manifest or tables is a run, complete or interrupted. Any other folder stands
    for the runs in it, except merged ones. ``@runs.txt`` names one run per line. A quoted pattern
    stands for the folders that it matches.

    Raises:
        RunError: A folder neither is nor holds a run.
        UsageError: A pattern has no match, a list cannot be read, a run is named twice, or an
            argument is a URL.
    """
    found = tuple(path for text in arguments for path in _expanded(text))
    for path, count in Counter(path.resolve() for path in found).items():
        if count > 1:
            raise UsageError(f"{path}: a run named twice; name each once")
    return found


def _expanded(text: str) -> Iterator[Path]:
    if is_remote(text):
        raise UsageError(
            f"{text}: runs on a store; copy them to this machine (only query, compare and history "
            "read runs on a store)"
        )
    if text.startswith("@"):
        for line in _lines(Path(text[1:])):
            yield from _expanded(line)
    elif glob.has_magic(text) and not Path(text).exists():
        matched = [path for path in sorted(glob.glob(text)) if Path(path).is_dir()]  # noqa: PTH207
        if not matched:
            raise UsageError(f"{text}: nothing matches; expected folders of runs")
        for path in matched:
            yield from _expanded(path)
    else:
        yield from _in_folder(Path(text))


def _in_folder(folder: Path) -> Iterator[Path]:
    names = {entry.name for entry in _listed(folder)} if folder.is_dir() else {MANIFEST}
    if MANIFEST in names or is_cut_short(names):
        # A damaged, interrupted or missing run is reported when it is opened.
        yield folder
        return
    runs = LocalRuns(folder)
    below = ((runs.path(one.run), one.file) for one in runs.find())
    found = [run for run, file in below if not (_is_merged(run) or _is_bare(run, file))]
    if not found:
        raise UnreadableRunError(
            f"{folder}: neither a run folder nor a folder of runs; replay first"
        )
    yield from found


def _listed(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        raise UnreadableRunError(f"{folder}: {error.strerror}; check its owner and mode") from None


def _is_bare(folder: Path, file: str) -> bool:
    """Return whether a run failed with no output but its error; batches and catalogs report it."""
    return file == FAILURE and {entry.name for entry in _listed(folder)} <= {FAILURE, LOCK}


def _is_merged(folder: Path) -> bool:
    try:
        return is_merged(RunFolder(folder))
    except RunError:
        return False


def _lines(path: Path) -> list[str]:
    text = read_text(path, LIST_BYTES, UsageError, "expected a list of runs", "surrogateescape")
    lines = text.splitlines()
    named = [line.strip() for line in lines if line.strip() and not line.startswith("#")]
    if not named:
        raise UsageError(f"@{path}: names no run; expected a line for each")
    return [str(path.parent / line) for line in named]
