"""Open any log by its suffix, its folder's contents, or its URL."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Final, cast

from crosscue.replay.base import Log, name_of
from crosscue.replay.errors import CrosscueError, LogError, MissingTopicError, UnknownFormatError
from crosscue.replay.files.identity import link_of_log
from crosscue.replay.formats import FORMATS, format_of, known_formats
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS, Limits

# Folders that are searched below one that is not a log, and logs that an error names.
DEPTH: Final = 4
MAX_NAMED: Final = 3


def open_log(path: Path | str, limits: Limits = DEFAULT_LIMITS) -> Log:
    """Open any log by its suffix or, for a folder, by its contents.

    A string that contains ``://`` is a URL, see ``remote``. If a seal exists next to the log, the
    data read is verified against it, see ``sealed_log``.

    Raises:
        UnknownFormatError: No format matches; the message lists the known formats.
        LogError: It cannot be opened: missing, no permission, not a file or folder, or without a
            readable record.
    """
    if isinstance(path, str) and "://" in path:
        from crosscue.replay.remote.logs import open_remote

        return open_remote(path, lambda fetched: open_log(fetched, limits), limits)
    from crosscue.replay.seal.log import with_seal

    place = log_within(Path(path))
    return with_seal(place, lambda: open_unsealed(place, limits))


def log_within(path: Path) -> Path:
    """Return a log, or the only log in the folders below: a data set is one folder or several.

    Raises:
        UnknownFormatError: It contains no log, or several, which the message names.
        LogError: It does not exist, or may not be read.
    """
    try:
        format_of(path)
    except UnknownFormatError:
        found = [*islice(_logs_below(path, DEPTH), MAX_NAMED + 1)] if path.is_dir() else []
        if not found:
            raise
        if len(found) > 1:
            named = ", ".join(str(one) for one in found[:MAX_NAMED])
            more = ", ..." if len(found) > MAX_NAMED else ""
            raise UnknownFormatError(
                f"{path}: a folder of several logs; did you mean one of {named}{more}?"
            ) from None
        return found[0]
    return path


def _logs_below(folder: Path, depth: int) -> Iterator[Path]:
    """Yield the logs in the folders below, without following links."""
    for entry in sorted(folder.iterdir()) if depth else ():
        if entry.name.startswith(".") or entry.is_symlink() or not entry.is_dir():
            continue
        try:
            format_of(entry)
            yield entry
        except UnknownFormatError:
            yield from _logs_below(entry, depth - 1)


def open_unsealed(path: Path, limits: Limits = DEFAULT_LIMITS) -> Log:
    """Open a file or folder as ``open_log`` does, but ignore its seal.

    A link among the files of the log is refused, because it may lead anywhere on this machine.
    """
    name = format_of(path)
    module, _, function = (FORMATS.get(name) or known_formats()[name]).opener.partition(":")
    opener = cast("Callable[[Path, Limits], Log]", getattr(import_module(module), function))
    try:
        link = None if limits.follow_links else link_of_log(path)
        if link is not None:
            raise LogError(f"{link}: a link, which is not followed; see --follow-links")
        return opener(path, limits)
    except PermissionError:
        raise LogError(
            f"{path}: no permission to read it; check the file's owner and mode"
        ) from None
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}; check the path and the disk") from None


@contextmanager
def unless_damaged(
    logs: Sequence[Log], missing: type[CrosscueError] = MissingTopicError
) -> Iterator[None]:
    """Report a missing topic, by this type of error, as damage of the log if a log is damaged.

    The damaged part may contain the topic, so the vehicle file or option need not be wrong.

    Raises:
        LogError: Instead of ``missing``, if a log is damaged.
    """
    try:
        yield
    except missing as error:
        for log in logs:
            ledger = Ledger(name_of(log))
            for _ in log.read(ledger):
                pass
            for loss in ledger.drops():
                detail = f" ({loss.detail})" if loss.detail else ""
                raise LogError(f"{name_of(log)}: {loss.reason}{detail}; so {error}") from None
        raise
