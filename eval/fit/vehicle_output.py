"""Write the values of a fit into a vehicle file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.vehicle.vehicle import Vehicle, parse

# Vehicle file with only default values.
DEFAULTS: Final = "version = 1\n"


def check_output(
    vehicle: Vehicle | Path | str | None, output: Path | str | None, *, overwrite: bool
) -> None:
    """Check, before any work, that the output can be written.

    Raises:
        UsageError: The vehicle settings are not a file, so there is no text to insert the fit into.
        OutputError: The output is another existing file.
    """
    if output is None:
        return
    if isinstance(vehicle, Vehicle):
        raise UsageError(
            "output: expected a vehicle file to insert the fit into, found settings; pass its path"
        )
    path = Path(output)
    is_itself = vehicle is not None and path.exists() and path.samefile(vehicle)
    if path.exists() and not is_itself and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")


def write_fit(
    vehicle: Vehicle | Path | str | None,
    output: Path | str | None,
    with_fit: Callable[[str], str],
) -> Path | None:
    """Write the vehicle file with the fit to ``output``, unless it is None; return its path.

    Without a vehicle file, the fit is inserted into a new file with default values. Call
    ``check_output`` first.
    """
    if output is None:
        return None
    assert not isinstance(vehicle, Vehicle)
    given = DEFAULTS if vehicle is None else Path(vehicle).read_text(encoding="utf-8")
    text = with_fit(given)
    parse(text, str(vehicle))
    write_text(Path(output), text)
    return Path(output)
