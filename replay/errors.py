"""Everything this toolkit raises on purpose.

* CrosscueError              one line for a person: what, where, what to do
    * UsageError             the command or call cannot mean anything (exit status 2)
    * LogError               a recording cannot be read as asked (exit status 4)
        * LogFormatError     the bytes do not say what the format promises
        * LogTooLargeError   a declared or produced size is over the limit
        * UnknownFormatError no reader knows this file or folder
    * SchemaError            a message type, DBC or truth file cannot be understood
        * CanDatabaseError   a CAN database cannot be read (exit status 4)
        * AnnotationError    a file of annotations cannot be read (exit status 4)
    * VehicleError           the vehicle file is wrong or lacks a role
        * MissingTopicError  a topic that it or a flag names is not in the logs
    * RunError               a run folder is locked, or does not hold what was requested
        * UnreadableRunError it is missing, damaged or of another version (exit status 4)
    * OutputError            a result cannot be written (disk full, no permission)
    * StudyFileError         a study file cannot be read or does not fit (exit status 2)
    * WorkerError            a worker died; finished parts are kept
    * EmptyResultError       nothing of what was requested is in the logs
    * AccountError           rows in are not rows used, skipped and dropped: a bug in crosscue

A wrong argument from the caller's own code stays a ``ValueError``. Dropped rows, which
stop nothing, are a ``LossWarning``.
"""


class CrosscueError(Exception):
    """Catch this to catch all of ours and nothing else.

    The message is one line: what happened, where (file, topic, time), what was expected, what
    to do.
    """

    exit_status: int = 1


class UsageError(CrosscueError):
    """The command or call cannot mean anything."""

    exit_status = 2


class LogError(CrosscueError):
    """A recording cannot be read as asked."""

    exit_status = 4


class LogFormatError(LogError):
    """The bytes do not say what the format promises."""


class LogTooLargeError(LogError):
    """A declared or produced size is over the limit."""


class UnknownFormatError(LogError):
    """No reader knows this file or folder."""


class SchemaError(CrosscueError):
    """A message type, DBC or truth file cannot be understood."""


class CanDatabaseError(SchemaError):
    """A CAN database (DBC, KCD, ARXML, SYM) is missing, damaged or something else."""

    exit_status = 4


class AnnotationError(SchemaError):
    """A file of annotations is missing, damaged or does not follow its schema."""

    exit_status = 4


class VehicleError(CrosscueError):
    """The vehicle file is wrong or lacks a role."""

    exit_status = 2


class MissingTopicError(VehicleError, UsageError):
    """A topic that the vehicle file or a flag names is not in the logs, or a log has no row."""


class RunError(CrosscueError):
    """A run folder is locked, or does not hold what was requested."""


class UnreadableRunError(RunError):
    """A run folder, or the logs that it names, is missing, damaged or of another version."""

    exit_status = 4


class OutputError(CrosscueError):
    """A result cannot be written."""


class StudyFileError(CrosscueError):
    """A study file cannot be read or does not fit."""

    exit_status = 2


class WorkerError(CrosscueError):
    """A worker died; what was finished is kept."""


class EmptyResultError(CrosscueError):
    """Nothing of what was requested is in the logs."""


class AccountError(CrosscueError):
    """An account does not add up, so no result can be relied on; always a bug in crosscue."""


def one_line(error: BaseException, max_length: int | None = None) -> str:
    """What an error says, on one line: each run of white space, line ends too, becomes one space.

    Args:
        error: Often another library's, whose message may span lines and quote a whole file.
        max_length: Keep this many characters; None keeps all.
    """
    return " ".join(str(error).split())[:max_length]


class LossWarning(UserWarning):
    """Something of a log was dropped, in one line."""
