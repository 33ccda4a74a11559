"""Plug-ins: detectors, cues, readers and data sets of other installed packages.

A package declares them as entry points in its ``pyproject.toml``::

    [project.entry-points."crosscue.readers"]
    vbo = "my_package.vbo:FORMAT"

A plug-in that fails to load is ignored with a warning; ``crosscue plugins`` reports the cause.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, TypeVar

from crosscue.replay.errors import PluginWarning, UsageError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

Kind = Literal["detector", "cue", "reader", "dataset"]
T = TypeVar("T")

# Entry point groups by kind of plug-in.
GROUPS: Final[dict[Kind, str]] = {
    "detector": "crosscue.detectors",
    "cue": "crosscue.cues",
    "reader": "crosscue.readers",
    "dataset": "crosscue.datasets",
}


@dataclass(frozen=True, slots=True)
class Plugin:
    """One plug-in.

    Attributes:
        name: Its name in crosscue.
        kind: ``detector``, ``cue``, ``reader`` or ``dataset``.
        package: The installed package that declares it.
        version: Version of that package.
        place: ``module:object``.
        problem: Reason why it does not load; empty if it loads.
    """

    name: str
    kind: Kind
    package: str
    version: str
    place: str
    problem: str = ""


def offered(kind: Kind) -> list[EntryPoint]:
    """Return the entry points of a kind, sorted by name; duplicate names are all included."""
    points = [point for point in _points_on(tuple(sys.path)) if point.group == GROUPS[kind]]
    return sorted(points, key=lambda point: (point.name, point.value))


@lru_cache(maxsize=4)
def _points_on(path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Find all entry points once for each ``sys.path``, because reading them takes 30 ms."""
    from importlib.metadata import entry_points  # takes 10 ms, and a built-in format needs none

    found = entry_points()
    return tuple(point for group in GROUPS.values() for point in found.select(group=group))


def load_entry_point(point: EntryPoint, wanted: type[T]) -> T:
    """Load the object of an entry point.

    Raises:
        ImportError: It cannot be imported, or has another type; the message is one line.
    """
    try:
        found = point.load()
    except (Exception, SystemExit) as error:
        # An import error in another package must not terminate crosscue.
        raise ImportError(f"{type(error).__name__}: {_short(error)}") from None
    if not isinstance(found, wanted):
        raise ImportError(
            f"{point.value} is {type(found).__name__}; expected {wanted.__name__}"
        ) from None
    if getattr(found, "name", point.name) != point.name:
        raise ImportError(f"{point.value} has another name; expected the name {point.name!r}")
    return found


def loaded(kind: Kind, wanted: type[T], taken: Collection[str]) -> Iterator[tuple[str, T]]:
    """Yield the names and objects of a kind of plug-in; warn of those that do not load.

    Args:
        kind: Kind of plug-in.
        wanted: Required type of the objects.
        taken: Built-in names, which a plug-in cannot replace.
    """
    seen = {*taken}
    for point in offered(kind):
        try:
            found = load_entry_point(point, wanted)
            if point.name in seen:
                raise ImportError("its name is taken; give it another")
        except ImportError as error:
            text = f"plug-in {point.name} ({GROUPS[kind]}): {error}; see crosscue plugins"
            warnings.warn(text, PluginWarning, stacklevel=2)
            continue
        seen.add(point.name)
        yield point.name, found


def _short(error: BaseException) -> str:
    """Return the message of another package's error on one line."""
    return " ".join(str(error).split())[:300]


def described(point: EntryPoint, kind: Kind, problem: str) -> Plugin:
    """Describe an entry point and its package, for ``crosscue plugins``."""
    package = "unknown" if point.dist is None else str(point.dist.metadata["Name"])
    version = "unknown" if point.dist is None else str(point.dist.version)
    return Plugin(point.name, kind, package, version, point.value, problem)


def imported(place: str, user: str) -> object:
    """Return the object that ``module:name`` names, as written in a command or settings file.

    Args:
        place: Module and name.
        user: What it is to be, for the error.

    Raises:
        UsageError: There is no such module or name.
    """
    module, _, name = place.partition(":")
    try:
        return attrgetter(name)(import_module(module))
    except (ImportError, AttributeError) as error:
        # A command does not search the current folder, unlike python -m and python -c.
        hint = "check the module and the name"
        if isinstance(error, ModuleNotFoundError) and Path(f"{module}.py").exists():
            hint = f"{module}.py is in this folder, which is not searched: set PYTHONPATH=."
        raise UsageError(f"{user} {place}: {error}; {hint}") from None
