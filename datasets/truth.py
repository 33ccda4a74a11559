"""``truth.json``: what is known to be so about a drive, and the check that it fits a log.

Version 1 carries the pose; approaches, cues and objects are sections of the same file.
"""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Protocol, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from crosscue.replay.errors import SchemaError, UsageError
from crosscue.replay.run_folder import strict_json, write_text

VERSION: Final = 1
FILE: Final = "truth.json"

CARRIED: Final[dict[str, str]] = {
    "comma2k19": "crosscue.datasets.comma2k19_truth:write",
    "kitti-raw": "crosscue.datasets.kitti:write_truth",
}
"""From a format of ``crosscue.replay.log.FORMATS`` to the function that writes its truth."""


class Section(BaseModel):
    """Unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Origin(Section):
    """Where the map frame's zero lies; x points east, y north, z up."""

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)]
    altitude_m: float


class Truth(Section):
    """A whole truth file."""

    version: Literal[1]
    log: str = ""
    """Name of the log it belongs to, for people."""
    start_ns: int
    end_ns: int
    """Log times between which the truth speaks; half open."""
    pose: str | None = None
    """TUM trajectory, a file beside this one: seconds on the log clock, metres, quaternion."""
    pose_point: Literal["rear_axle", "camera"] = "rear_axle"
    """Whose position the trajectory gives."""
    origin: Origin | None = None
    source: str = ""
    """Who measured it, and how well."""


class Writer(Protocol):
    """What a data set's truth function looks like."""

    def __call__(self, path: Path, folder: Path) -> Path:
        """Write ``truth.json`` for the data set at ``path`` into ``folder``; its path returns."""
        ...


def write_carried(format_name: str, path: Path, folder: Path) -> Path:
    """Write the truth that a data set carries.

    Raises:
        UsageError: The format carries none.
    """
    if format_name not in CARRIED:
        known = ", ".join(sorted(CARRIED))
        raise UsageError(f"{path}: a {format_name} log carries no truth; those that do: {known}")
    module, _, function = CARRIED[format_name].partition(":")
    return cast("Writer", getattr(import_module(module), function))(path, folder)


def save(truth: Truth, folder: Path) -> Path:
    """Write ``truth.json`` into ``folder``."""
    write_text(folder / FILE, strict_json(truth.model_dump(mode="json")) + "\n")
    return folder / FILE


def load(path: Path) -> Truth:
    """Read and check a truth file; a folder stands for the ``truth.json`` in it.

    Raises:
        SchemaError: Not there, not JSON, or not what version 1 says.
    """
    path = path / FILE if path.is_dir() else path
    try:
        text = path.read_text(encoding="utf-8")
        tree = json.loads(text, object_pairs_hook=_no_twins)
        truth = Truth.model_validate(tree)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise SchemaError(f"{path}: {place}: {first['msg'].lower()}; mend it") from None
    except FileNotFoundError:
        raise SchemaError(
            f"{path}: no such truth file; for a data set make it with: crosscue truth LOG -o DIR"
        ) from None
    except (OSError, ValueError) as error:
        raise SchemaError(f"{path}: not readable as JSON ({error}); mend it") from None
    if truth.end_ns <= truth.start_ns:
        raise SchemaError(f"{path}: end_ns {truth.end_ns} is not after start_ns {truth.start_ns}")
    return truth


def _no_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    if len(set(keys)) != len(keys):
        raise ValueError(f"a key stands twice in {keys}")
    return dict(pairs)


def json_schema() -> dict[str, Any]:
    """The file's JSON Schema, for other tools."""
    return Truth.model_json_schema()
