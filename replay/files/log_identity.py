"""What a log is known by wherever it is; ``identity`` computes it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

SHORT: Final = 8
"""Hex digits in a run's name."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Which log, or which logs of one drive.

    Attributes:
        name: Of the file or folder.
        size: Bytes in all; None in runs of earlier versions.
        digest: 64 hex digits.
    """

    name: str
    size: int | None
    digest: str

    @property
    def short(self) -> str:
        """Enough of it for a person."""
        return self.digest[:SHORT]

    def __str__(self) -> str:
        size = "" if self.size is None else f", {self.size:,} bytes"
        return f"{self.name} ({self.short}{size})"


def as_row(identity: Identity) -> dict[str, object]:
    """For a manifest."""
    return {"name": identity.name, "size": identity.size, "digest": identity.digest}


def of_row(row: Mapping[str, object]) -> Identity:
    """From a manifest."""
    size = row["size"]
    return Identity(str(row["name"]), size if isinstance(size, int) else None, str(row["digest"]))
