"""A vehicle file with the values of a fit in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from crosscue.replay.base import OutputError, UsageError, write_text
from crosscue.replay.vehicle.vehicle import Vehicle, parse

DEFAULTS: Final = "version = 1\n"
"""A vehicle file that leaves everything as it is."""


def check_output(
    vehicle: Vehicle | Path | str | None, output: Path | str | None, *, overwrite: bool
) -> None:
    """Refuse, before any work, an output that cannot be written as asked.

    Raises:
        UsageError: The settings are no file, so there is no text to put the fit into.
        OutputError: The output is another file that exists.
    """
    if output is None:
        return
    if isinstance(vehicle, Vehicle):
        raise UsageError("output: needs the vehicle file that gets the fit, not settings; name it")
    path = Path(output)
    is_itself = vehicle is not None and path.exists() and path.samefile(vehicle)
    if path.exists() and not is_itself and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")


def write_fit(
    vehicle: Vehicle | Path | str | None,
    output: Path | str | None,
    with_fit: Callable[[str], str],
) -> Path | None:
    """Write the vehicle file's text with the fit in it, if asked for; once ``check_output``ed.

    Without a vehicle file the fit was one of the default settings, and becomes a file of its own.
    """
    if output is None:
        return None
    assert not isinstance(vehicle, Vehicle)
    given = DEFAULTS if vehicle is None else Path(vehicle).read_text(encoding="utf-8")
    text = with_fit(given)
    parse(text, str(vehicle))
    write_text(Path(output), text)
    return Path(output)
