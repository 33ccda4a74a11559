"""The errors and warnings that crosscue raises on purpose, drawn in ``crosscue.replay.errors``."""

from crosscue.replay.errors import (
    AccountError as AccountError,
)
from crosscue.replay.errors import (
    AnnotationError as AnnotationError,
)
from crosscue.replay.errors import (
    CanDatabaseError as CanDatabaseError,
)
from crosscue.replay.errors import (
    CrosscueError as CrosscueError,
)
from crosscue.replay.errors import (
    EmptyResultError as EmptyResultError,
)
from crosscue.replay.errors import (
    FitError as FitError,
)
from crosscue.replay.errors import (
    FitError as FitError,
    LogError as LogError,
)
from crosscue.replay.errors import (
    LogFormatError as LogFormatError,
)
from crosscue.replay.errors import (
    LogTooLargeError as LogTooLargeError,
)
from crosscue.replay.errors import (
    LossWarning as LossWarning,
)
from crosscue.replay.errors import (
    MissingTopicError as MissingTopicError,
)
from crosscue.replay.errors import (
    OutputError as OutputError,
)
from crosscue.replay.errors import (
    PluginWarning as PluginWarning,
)
from crosscue.replay.errors import (
    RunError as RunError,
)
from crosscue.replay.errors import (
    SchemaError as SchemaError,
)
from crosscue.replay.errors import (
    StudyFileError as StudyFileError,
)
from crosscue.replay.errors import (
    UnknownFormatError as UnknownFormatError,
)
from crosscue.replay.errors import (
    UnreadableRunError as UnreadableRunError,
)
from crosscue.replay.errors import (
    UsageError as UsageError,
)
from crosscue.replay.errors import (
    VehicleError as VehicleError,
)
from crosscue.replay.errors import (
    WorkerError as WorkerError,
)
