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
    * StudyFileError         a study file is unreadable or does not match (exit status 2)
    * WorkerError            a worker process died; finished parts are kept
    * EmptyResultError       the logs contain nothing that was requested
    * AccountError           the row counts do not add up: a bug in crosscue

An invalid argument of the caller's own code raises ``ValueError``. Dropped rows do not stop the
work; they issue a ``LossWarning``.
"""


class CrosscueError(Exception):
    """Base class of all exceptions that crosscue raises on purpose.

    The message is one line: what happened, where (file, topic, time), what was expected, what
    to do.
    """

    exit_status: int = 1


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


class StudyFileError(CrosscueError):
    """A study file is unreadable or does not match."""

    exit_status = 2


class WorkerError(CrosscueError):
    """A worker process died; finished parts are kept."""


class EmptyResultError(CrosscueError):
    """The logs contain nothing that was requested."""


class AccountError(CrosscueError):
    """The row counts do not add up, so results are unreliable; always a bug in crosscue."""


def one_line(error: BaseException, max_length: int | None = None) -> str:
    """Return an error's message on one line, with runs of white space collapsed.

    Args:
        error: The exception. Messages of other libraries may span lines and quote a complete file.
        max_length: Maximum number of characters to keep; None keeps all.
    """
    return " ".join(str(error).split())[:max_length]


class LossWarning(UserWarning):
    """Rows of a log were dropped; the message is one line."""
