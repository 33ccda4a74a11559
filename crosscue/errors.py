"""The errors and warnings that crosscue raises on purpose, drawn in ``crosscue.replay.errors``."""

from crosscue.replay.errors import *  # noqa: F403
