"""Results of studies."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any

from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree
from crosscue.results import Result


class StoredResult(Result):
    """Result whose JSON output is a file of the study's folder."""

    __slots__ = ()

    @property
    @abstractmethod
    def stored(self) -> Path:
        """The file."""

    def as_dict(self) -> Any:
        """Return the content of the file."""
        return json_tree(door.read(self.stored))
