"""Identity of a log independent of its path; ``identity`` computes it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

# Number of hex digits in a run's name.
SHORT: Final = 8


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of a log, or of the logs of one drive.

    Attributes:
        name: Name of the file or folder, as it is spelled in a run.
        size: Total size in bytes; None in runs of earlier versions.
        digest: SHA-256 as 64 hex digits.
    """

    name: str
    size: int | None
    digest: str

    @property
    def short(self) -> str:
        """First digits of the digest, for display."""
        return self.digest[:SHORT]

    def __str__(self) -> str:
        size = "" if self.size is None else f", {self.size:,} bytes"
        return f"{self.name} ({self.short}{size})"


def as_row(identity: Identity) -> dict[str, object]:
    """Convert an identity to a row of a manifest."""
    return {"name": identity.name, "size": identity.size, "digest": identity.digest}


def of_row(row: Mapping[str, object]) -> Identity:
    """Read an identity from a row of a manifest."""
    size = row["size"]
    return Identity(str(row["name"]), size if isinstance(size, int) else None, str(row["digest"]))
