"""A first vehicle file, made from what a drive holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.interface.logs.log import Log, opened
from crosscue.replay.base import OutputError, write_text
from crosscue.replay.vehicle.draft import draft
from crosscue.replay.vehicle.vehicle import Vehicle, parse


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleDraft:
    """A first vehicle file; printed as its text.

    Attributes:
        text: TOML, with comments on what is to be checked.
        path: Where it was written; None where it was not.
    """

    text: str
    path: Path | None

    @property
    def vehicle(self) -> Vehicle:
        """Its settings; DBC files are named as seen from its folder."""
        return parse(self.text, "the draft")

    def as_dict(self) -> dict[str, object]:
        """What ``crosscue vehicle init --json`` prints."""
        return {"vehicle": None if self.path is None else str(self.path), "text": self.text}

    def __repr__(self) -> str:
        return self.text.rstrip("\n")


def draft_vehicle(
    log: Log | Path | str,
    databases: Sequence[Path | str] = (),
    output: Path | str | None = None,
    *,
    overwrite: bool = False,
) -> VehicleDraft:
    """Write a first vehicle file from what a drive holds.

    Args:
        log: The drive, or its path.
        databases: DBC, KCD, ARXML or SYM files of its CAN buses.
        output: The file; if left out, the text is returned only.
        overwrite: Replace a file that is there.

    Raises:
        EmptyResultError: No topic plays a role in a vehicle file.
        SchemaError: A database cannot be understood.
        OutputError: The file exists, or cannot be written.
    """
    path = None if output is None else Path(output)
    if path is not None and path.exists() and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")
    folder = Path.cwd() if path is None else path.parent
    with opened(log) as drive:
        text = draft(drive.logs, [Path(name) for name in databases], folder)
    parse(text, "the draft")
    if path is not None:
        write_text(path, text)
    return VehicleDraft(text, path)
