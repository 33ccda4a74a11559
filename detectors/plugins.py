"""List plug-ins of installed packages, with the reasons of those that do not load."""

from collections.abc import Collection, Iterator

from crosscue.detectors.registry import BUILTIN
from crosscue.replay.formats import FORMATS, DataSet, Format
from crosscue.replay.plugins import GROUPS, Kind, Plugin, described, load_entry_point, offered
from crosscue.replay.vehicle.vehicle import BUILTIN_CUES, CueSpec
from crosscue.results import Listing


class Plugins(Listing[Plugin]):
    """Plug-ins; its repr is a table."""

    head = ("name", "kind", "package", "version", "state")
    root = "plugins"

    @property
    def exit_status(self) -> int:
        """1 when a plug-in does not load, else 0."""
        return 1 if any(one.problem for one in self) else 0

    def cells(self, row: Plugin) -> tuple[object, ...]:
        """Return the cells of a row."""
        return (row.name, row.kind, row.package, row.version, row.problem or "loaded")

    def lines(self) -> Iterator[str]:
        """Yield a table, or a sentence where nothing is installed."""
        yield from Listing.lines(self) if len(self) else ("no plug-in is installed",)


def plugins() -> Plugins:
    """List the extensions that installed packages register.

    These are detectors, cues, readers and data sets. A package registers them as entry points in
    the groups crosscue.detectors, crosscue.cues, crosscue.readers and crosscue.datasets. Each
    plug-in is loaded; the exit status is 1 when one cannot be loaded.

    Examples:
        crosscue plugins
    """
    built_in: dict[Kind, tuple[type[object], Collection[str]]] = {
        "detector": (object, BUILTIN),
        "cue": (CueSpec, BUILTIN_CUES),
        "reader": (Format, FORMATS),
        "dataset": (DataSet, FORMATS),
    }
    found: list[Plugin] = []
    for kind in GROUPS:
        wanted, taken = built_in[kind]
        seen = {*taken}
        for point in offered(kind):
            problem = ""
            try:
                made = load_entry_point(point, wanted)
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
