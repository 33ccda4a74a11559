"""List plug-ins of installed packages, with the reasons of those that do not load."""

from __future__ import annotations

from collections.abc import Collection

from crosscue.detectors.registry import BUILTIN
from crosscue.eval.interface.show import Listing
from crosscue.replay.formats import FORMATS, DataSet, Format
from crosscue.replay.plugins import GROUPS, Kind, Plugin, described, load, offered
from crosscue.replay.vehicle.vehicle import BUILTIN_CUES, CueSpec


class Plugins(Listing[Plugin]):
    """Plug-ins; its repr is a table."""

    head = ("name", "kind", "package", "version", "state")

    def cells(self, row: Plugin) -> tuple[object, ...]:
        """Return the cells of a row."""
        return (row.name, row.kind, row.package, row.version, row.problem or "loaded")


def plugins() -> Plugins:
    """Return the detectors, cues, readers and data sets that installed packages register.

    Each plug-in is loaded; ``problem`` is the reason why one cannot be loaded.
    """
    taken: dict[Kind, Collection[str]] = {
        "detector": BUILTIN,
        "cue": BUILTIN_CUES,
        "reader": FORMATS,
        "dataset": FORMATS,
    }
    wanted: dict[Kind, type[object]] = {
        "detector": object,
        "cue": CueSpec,
        "reader": Format,
        "dataset": DataSet,
    }
    found: list[Plugin] = []
    for kind in GROUPS:
        seen = {*taken[kind]}
        for point in offered(kind):
            problem = ""
            try:
                made = load(point, wanted[kind])
                if kind == "detector" and not callable(made):
                    problem = f"{point.value} cannot be called; expected a factory"
            except ImportError as error:
                problem = str(error)
            if not problem and point.name in seen:
                problem = "its name is already in use; rename it"
            if not problem:
                seen.add(point.name)
            found.append(described(point, kind, problem))
    return Plugins(found)
