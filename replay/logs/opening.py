"""One way to open any recording: by its suffix, by what is in its folder, by its URL."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import cast

from crosscue.replay.base import (
    DEFAULT_LIMITS,
    Ledger,
    Limits,
    Log,
    LogError,
    MissingTopicError,
    name_of,
)
from crosscue.replay.formats import FORMATS, format_of, known_formats


def open_log(path: Path | str, limits: Limits = DEFAULT_LIMITS) -> Log:
    """Open any recording by its suffix or, for a folder, by what is in it.

    A text with ``://`` is a URL: see ``remote``. Of a log with a seal beside
    it, what is read is held against the seal, see ``sealed_log``.

    Raises:
        UnknownFormatError: No format fits; the message lists those there are.
        LogError: It cannot be opened: missing, no permission, not a file or folder, or not one
            readable record in it.
    """
    if isinstance(path, str) and "://" in path:
        from crosscue.replay.remote.logs import open_remote

        return open_remote(path, lambda fetched: open_log(fetched, limits), limits)
    from crosscue.replay.seal.log import with_seal

    place = Path(path)
    return with_seal(place, lambda: open_unsealed(place, limits))


def open_unsealed(path: Path, limits: Limits = DEFAULT_LIMITS) -> Log:
    """As ``open_log`` of a file or folder, without looking at its seal."""
    name = format_of(path)
    module, _, function = (FORMATS.get(name) or known_formats()[name]).opener.partition(":")
    opener = cast("Callable[[Path, Limits], Log]", getattr(import_module(module), function))
    try:
        return opener(path, limits)
    except PermissionError:
        raise LogError(
            f"{path}: no permission to read it; check the file's owner and mode"
        ) from None
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}; check the path and the disk") from None


@contextmanager
def unless_damaged(logs: Sequence[Log]) -> Iterator[None]:
    """Blame the log, not who names its topics, where what is missing may be in the damaged part.

    Raises:
        LogError: Instead of a ``MissingTopicError``, when a log turns out to be damaged.
    """
    try:
        yield
    except MissingTopicError as error:
        for log in logs:
            ledger = Ledger(name_of(log))
            for _ in log.read(ledger):
                pass
            for loss in ledger.drops():
                detail = f" ({loss.detail})" if loss.detail else ""
                raise LogError(f"{name_of(log)}: {loss.reason}{detail}; so {error}") from None
        raise
