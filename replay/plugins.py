"""Detectors, cues, readers and data sets that other installed packages offer as entry points.

A package names them in its ``pyproject.toml``::

    [project.entry-points."crosscue.readers"]
    vbo = "my_package.vbo:FORMAT"

One that does not load stops nothing; ``crosscue plugins`` says why.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Final, Literal, TypeVar

Kind = Literal["detector", "cue", "reader", "dataset"]
T = TypeVar("T")

GROUPS: Final[dict[Kind, str]] = {
    "detector": "crosscue.detectors",
    "cue": "crosscue.cues",
    "reader": "crosscue.readers",
    "dataset": "crosscue.datasets",
}
"""From what is offered to its entry point group."""


class PluginWarning(UserWarning):
    """An installed plug-in does not load, so crosscue goes on without it."""


@dataclass(frozen=True, slots=True)
class Plugin:
    """One entry point.

    Attributes:
        name: What it is called in crosscue.
        kind: ``detector``, ``cue``, ``reader`` or ``dataset``.
        package: The installed package that offers it.
        version: Of that package.
        place: ``module:object``.
        problem: Why it does not load; empty if it does.
    """

    name: str
    kind: Kind
    package: str
    version: str
    place: str
    problem: str = ""


def offered(kind: Kind) -> list[EntryPoint]:
    """The entry points of a kind, by name; where a name is offered twice, both."""
    points = entry_points(group=GROUPS[kind])
    return sorted(points, key=lambda point: (point.name, point.value))


def load(point: EntryPoint, wanted: type[T]) -> T:
    """The object behind an entry point.

    Raises:
        ImportError: It cannot be imported, or is something else; one line says why.
    """
    try:
        found = point.load()
    except (Exception, SystemExit) as error:
        # Whatever another package does when imported must not end crosscue.
        raise ImportError(f"{type(error).__name__}: {_short(error)}") from None
    if not isinstance(found, wanted):
        raise ImportError(
            f"{point.value} is {type(found).__name__}; expected {wanted.__name__}"
        ) from None
    if getattr(found, "name", point.name) != point.name:
        raise ImportError(f"{point.value} is named otherwise; expected the name {point.name!r}")
    return found


def loaded(kind: Kind, wanted: type[T], taken: Collection[str]) -> Iterator[tuple[str, T]]:
    """What installed packages offer of a kind, by name; warns of what does not load.

    Args:
        kind: Which.
        wanted: What it must be.
        taken: Names of crosscue's own, which no plug-in replaces.
    """
    seen = {*taken}
    for point in offered(kind):
        try:
            found = load(point, wanted)
            if point.name in seen:
                raise ImportError("its name is taken; give it another")
        except ImportError as error:
            text = f"plug-in {point.name} ({GROUPS[kind]}): {error}; see crosscue plugins"
            warnings.warn(text, PluginWarning, stacklevel=2)
            continue
        seen.add(point.name)
        yield point.name, found


def _short(error: BaseException) -> str:
    """On one line, whatever another package says."""
    return " ".join(str(error).split())[:300]


def described(point: EntryPoint, kind: Kind, problem: str) -> Plugin:
    """One line of ``crosscue plugins``."""
    package = "unknown" if point.dist is None else str(point.dist.metadata["Name"])
    version = "unknown" if point.dist is None else str(point.dist.version)
    return Plugin(point.name, kind, package, version, point.value, problem)
