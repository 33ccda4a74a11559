"""A vehicle file with the values of a fit in it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from crosscue.replay.base import OutputError, UsageError, write_text
from crosscue.replay.vehicle.vehicle import Vehicle, parse


def check_output(
    vehicle: Vehicle | Path | str | None, output: Path | str | None, *, overwrite: bool
) -> None:
    """Refuse, before any work, an output that cannot be written as asked.

    Raises:
        UsageError: There is no vehicle file to put the fit into.
        OutputError: The output is another file that exists.
    """
    if output is None:
        return
    if vehicle is None or isinstance(vehicle, Vehicle):
        raise UsageError("-o: needs the vehicle file that gets the fit; give it as --vehicle")
    path = Path(output)
    if path.exists() and not path.samefile(vehicle) and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")


def write_fit(
    vehicle: Vehicle | Path | str | None,
    output: Path | str | None,
    with_fit: Callable[[str], str],
) -> Path | None:
    """Write the vehicle file's text with the fit in it, if asked for; once ``check_output``ed."""
    if output is None:
        return None
    assert isinstance(vehicle, Path | str)
    text = with_fit(Path(vehicle).read_text(encoding="utf-8"))
    parse(text, str(vehicle))
    write_text(Path(output), text)
    return Path(output)
