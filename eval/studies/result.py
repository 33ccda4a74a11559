"""Results of studies."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any, ClassVar

from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree
from crosscue.results import Result


class StoredResult(Result):
    """Result whose JSON output is a file of the study's folder."""

    __slots__ = ()
    json_is: ClassVar = "content"

    @property
    @abstractmethod
    def stored(self) -> Path:
        """The file."""

    @property
    def content(self) -> Any:
        """Content of the file."""
        return json_tree(door.read(self.stored))
