"""The exceptions of crosscue.

* CrosscueError              base class; a one-line message: what happened, where, what to do
    * UsageError             the command or call is invalid (exit status 2)
    * LogError               a log cannot be read as requested (exit status 4)
        * LogFormatError     the bytes violate the format
        * LogTooLargeError   a declared or decoded size exceeds the limit
        * UnknownFormatError no reader supports this file or folder
    * SchemaError            a message definition, DBC or truth file is invalid
        * CanDatabaseError   a CAN database cannot be read (exit status 4)
        * AnnotationError    an annotation file cannot be read (exit status 4)
    * VehicleError           the vehicle file is invalid or lacks a role
        * MissingTopicError  a topic named in it or in an option is not in the logs
    * RunError               a run folder is locked, or lacks the requested results
        * UnreadableRunError it is missing, damaged or of another version (exit status 4)
    * OutputError            a result cannot be written (disk full, no permission)
    * WorkerError            a worker process died; finished parts are kept
    * EmptyResultError       the logs contain nothing that was requested
    * FitError               a fit is worse on held-out data than the values before it
    * AccountError           the row counts do not add up: a bug in crosscue

An invalid argument of the caller's own code raises ``ValueError``. Dropped rows do not stop the
work; they issue a ``LossWarning``.
"""

import re
from typing import Final

# Schemes in which the part before the ``@`` names a container.
_CONTAINER: Final = ("abfs", "abfss", "az", "wasb", "wasbs")
# Path("http://...") has only one slash.
_URL: Final = re.compile(r"\b([a-z][a-z0-9+.-]{1,30}):(/+)(\S+)", re.IGNORECASE)
_HOST: Final = re.compile(r"\[[0-9a-f:.%]*\](:\d*)?|arn:[^@]*|[^:@]*(:\d*)?", re.IGNORECASE)


class CrosscueError(Exception):
    """Base class of all exceptions that crosscue raises on purpose.

    The message is one line: what happened, where (file, topic, time), what was expected, what
    to do. URLs in it lose user, password and query.
    """

    exit_status: int = 1

    def __init__(self, message: object = "") -> None:
        """Keep the message without the secrets of URLs."""
        super().__init__(without_secrets(str(message)))


class UsageError(CrosscueError):
    """The command or call is invalid."""

    exit_status = 2


class LogError(CrosscueError):
    """A log cannot be read as requested."""

    exit_status = 4


class LogFormatError(LogError):
    """The bytes of a log violate its format."""


class LogTooLargeError(LogError):
    """A declared or decoded size exceeds the limit."""


class UnknownFormatError(LogError):
    """No reader supports this file or folder."""


class SchemaError(CrosscueError):
    """A message definition, DBC or truth file is invalid."""


class CanDatabaseError(SchemaError):
    """A CAN database (DBC, KCD, ARXML, SYM) is missing, damaged or in another format."""

    exit_status = 4


class AnnotationError(SchemaError):
    """An annotation file is missing, damaged or does not match its schema."""

    exit_status = 4


class VehicleError(CrosscueError):
    """The vehicle file is invalid or lacks a role."""

    exit_status = 2


class MissingTopicError(VehicleError, UsageError):
    """A topic named in the vehicle file or in an option is not in the logs, or has no rows."""


class RunError(CrosscueError):
    """A run folder is locked, or lacks the requested results."""


class UnreadableRunError(RunError):
    """A run folder, or a log that it refers to, is missing, damaged or of another version."""

    exit_status = 4


class OutputError(CrosscueError):
    """A result cannot be written."""


class WorkerError(CrosscueError):
    """A worker process died; finished parts are kept."""


class EmptyResultError(CrosscueError):
    """The logs contain nothing that was requested."""


class FitError(CrosscueError):
    """A fit is worse than the values before it, on data that it was not fitted to."""


class AccountError(CrosscueError):
    """The row counts do not add up, so results are unreliable; always a bug in crosscue."""


def one_line(error: BaseException, max_length: int | None = None) -> str:
    """Return an error's message on one line, without secrets of URLs, white space collapsed.

    Args:
        error: The exception. Messages of other libraries may span lines and quote a complete file.
        max_length: Maximum number of characters to keep; None keeps all.
    """
    return " ".join(without_secrets(str(error)).split())[:max_length]


class LossWarning(UserWarning):
    """Rows of a log were dropped; the message is one line."""


class PluginWarning(UserWarning):
    """An installed plug-in does not load and is ignored."""


def split_address(scheme: str, rest: str) -> tuple[str, str, str]:
    """Split what follows ``SCHEME://`` into user with ``@``, host with path, and query with ``?``.

    On the web, everything from a ``?`` or ``#`` on is the query. Elsewhere both may be part of a
    name, and only ``?NAME=`` begins a query.
    """
    mark = re.search(r"[?#]" if scheme.lower() in ("http", "https") else r"\?(?=[^/?]*=)", rest)
    place, query = (rest[: mark.start()], rest[mark.start() :]) if mark else (rest, "")
    host, slash, path = place.partition("/")
    user, at, bare = host.rpartition("@")
    if scheme.lower() in _CONTAINER and ":" not in user:
        return "", place, query
    return user + at, bare + slash + path, query


def is_host(text: str) -> bool:
    """Return whether a text may be a host with its port, or a bucket."""
    return _HOST.fullmatch(text) is not None


def without_secrets(text: str) -> str:
    """Return a text with every URL in it reduced to scheme, host and path."""
    return _URL.sub(_public, text) if ":/" in text else text


def _public(url: re.Match[str]) -> str:
    _, place, query = split_address(url[1], url[3])
    # "http://user:pass?word@host/" is not a valid URL; all of it may be the password.
    hidden = "@" in place + query and not is_host(place.partition("/")[0].rpartition("@")[2])
    return f"{url[1]}:{url[2]}{'...' if hidden else without_secrets(place)}"
