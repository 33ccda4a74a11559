"""``truth.json``: what is known to be so about a drive, and the check that it fits a log.

Version 1 carries pose, approaches, cues and the names of files with objects and ranges; every
section may be missing.
"""

from __future__ import annotations

import difflib
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Protocol, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from crosscue.replay.base import (
    MIB,
    AnnotationError,
    CrosscueError,
    EmptyResultError,
    json_tree,
    one_line,
    read_at_most,
    strict_json,
    write_text,
)
from crosscue.replay.formats import data_sets
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.validation_errors import explain

VERSION: Final = 1
FILE: Final = "truth.json"
MAX_BYTES: Final = 256 * MIB

CARRIED: Final[dict[str, str]] = {
    "comma2k19": "crosscue.datasets.adapters.comma2k19_truth:write",
    "kitti-raw": "crosscue.datasets.adapters.kitti:write_truth",
    "kitti-odometry": "crosscue.datasets.adapters.kitti_odometry:write_truth",
    "nuscenes": "crosscue.datasets.adapters.nuscenes_truth:write",
    "pandaset": "crosscue.datasets.adapters.pandaset:write_truth",
}
"""From a format of ``crosscue.replay.formats.FORMATS`` to the function that writes its truth."""


class Section(BaseModel):
    """Unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Origin(Section):
    """Where the map frame's zero lies; x points east, y north, z up."""

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)]
    altitude_m: float


class Mounting(Section):
    """A rigid transform from the rear axle, on the ground, to a body; ISO 8855 axes.

    Angles turn yaw first, then pitch, then roll. Null: unknown; a score then takes x, y and yaw
    from the vehicle file's ``[camera]`` or ``[gnss]``, and says so.
    """

    x_m: float | None = 0.0
    """Ahead of the rear axle."""
    y_m: float | None = 0.0
    """To its left."""
    z_m: float | None = 0.0
    """Above the ground."""
    roll_rad: float | None = 0.0
    pitch_rad: float | None = 0.0
    """Downwards."""
    yaw_rad: float | None = 0.0
    """Counter-clockwise."""


Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)]


class Features(Section):
    """Where one may drive on from an intersection; null where unknown, which is not scored."""

    left: bool | None
    right: bool | None
    straight: bool | None


class Approach(Section):
    """One approach to one intersection."""

    id: int
    intersection: str
    start_ns: int
    enter_ns: int
    """When the rear axle is at the start of the intersection, or the end of a log that ends
    before."""
    control: Literal["stop_sign", "traffic_light", "none"]
    features: Features
    one_way: Literal["left", "right"] | None = None
    """Where the crossroad's traffic goes, if only one way."""
    do_not_enter: bool = False
    conditions: tuple[str, ...] = ()
    """Free tags: rain, dusk, glare, occluded, ..."""
    length_m: float | None = None
    """From the start of the intersection to its end."""


def _examples(schema: dict[str, Any]) -> None:
    schema["examples"] = [*CUES]


class CueTruth(Section):
    """Whether what a cue stands for is there, at one time or over a half-open span."""

    cue: Annotated[Name, Field(json_schema_extra=_examples)]
    """One of ``CUES``, or of the file's ``own_cues``."""
    present: bool
    t_ns: int | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    approach: int | None = None
    count: int | None = None
    """How many things show it."""
    visible: float | None = None
    """Fraction of the most visible one that nothing hides."""


class Truth(Section):
    """A whole truth file."""

    version: Literal[1]
    log: str = ""
    """Name of the log it belongs to, for people."""
    log_sha256: dict[str, str] = {}
    """By file name: a run of a log with none of these hashes is refused. Empty: not checked."""
    start_ns: int
    end_ns: int
    """Log times between which the truth speaks; half open."""
    pose: str | None = None
    """TUM trajectory, a file beside this one: seconds on the log clock, metres, quaternion."""
    pose_point: Literal["rear_axle", "camera", "antenna", "imu"] = "rear_axle"
    """The body whose pose the trajectory is: the car, about its rear axle; a camera, x along its
    optical axis; a GNSS antenna, x along the car; or an inertial unit, x along its forward axis."""
    mounting: Mounting | None = None
    """Where that body sits on the car. Left out: at the rear axle, or, for a camera or an antenna,
    where the vehicle file's ``[camera]`` or ``[gnss]`` puts it."""
    mounting_source: str = ""
    """Who states the mounting, and how well."""
    position_sd_m: Annotated[float, Field(gt=0.0)] | None = None
    """S.d. of east and of north; left out: taken for exact."""
    heading_sd_rad: Annotated[float, Field(gt=0.0)] | None = None
    """Of the heading."""
    origin: Origin | None = None
    source: str = ""
    """Who measured it, and how well."""
    approaches: tuple[Approach, ...] = ()
    cues: tuple[CueTruth, ...] = ()
    own_cues: tuple[Name, ...] = ()
    """Cues beside the usual ones that this file reports, as the vehicle file's ``[cues.own]``
    names them."""
    objects: str | None = None
    """COCO file of labelled objects beside this one, images by ``t_ns``."""
    ranges: str | None = None
    """CSV beside this one: t_ns, approach, start_m, end_m, of the rear axle at each picture."""


class Writer(Protocol):
    """What a data set's truth function looks like."""

    def __call__(self, path: Path, folder: Path) -> Path:
        """Write ``truth.json`` for the data set at ``path`` into ``folder``; its path returns."""
        ...


def write_carried(format_name: str, path: Path, folder: Path) -> Path:
    """Write the truth that a data set contains.

    Raises:
        EmptyResultError: The format contains no truth.
        CrosscueError: The function of a plug-in failed.
    """
    if format_name in CARRIED:
        return _writer(CARRIED[format_name])(path, folder)
    added = {name: one.truth for name, one in data_sets().items()}
    if format_name not in added:
        known = ", ".join(sorted(CARRIED | added))
        raise EmptyResultError(
            f"{path}: a {format_name} log carries no truth; those that do: {known}"
        )
    try:
        return _writer(added[format_name])(path, folder)
    except CrosscueError:
        raise
    except Exception as error:
        why = f"{type(error).__name__}: {one_line(error, 200)}"
        raise CrosscueError(
            f"{path}: {added[format_name]} failed ({why}); correct this plug-in"
        ) from error


def _writer(name: str) -> Writer:
    module, _, function = name.partition(":")
    return cast("Writer", getattr(import_module(module), function))


def save(truth: Truth, folder: Path) -> Path:
    """Write ``truth.json`` into ``folder``."""
    write_text(folder / FILE, strict_json(truth.model_dump(mode="json")) + "\n")
    return folder / FILE


def load(path: Path) -> Truth:
    """Read and check a truth file; a folder stands for the ``truth.json`` in it.

    Raises:
        AnnotationError: Not there, not JSON, or not what version 1 says.
    """
    path = path / FILE if path.is_dir() else path
    try:
        content = read_at_most(path, MAX_BYTES)
        if content is None:
            raise AnnotationError(f"{path}: over {MAX_BYTES // MIB} MiB; split the drive")
        tree = json_tree(content, object_pairs_hook=_no_twins)
        truth = Truth.model_validate(tree)
    except ValidationError as error:
        raise AnnotationError(explain(error, None, str(path), Truth)) from None
    except FileNotFoundError:
        raise AnnotationError(
            f"{path}: no such truth file; for a data set make it with: crosscue truth LOG -o DIR"
        ) from None
    except (OSError, ValueError) as error:
        raise AnnotationError(f"{path}: not readable as JSON ({error}); correct it") from None
    if truth.end_ns <= truth.start_ns:
        raise AnnotationError(
            f"{path}: end_ns {truth.end_ns} is not after start_ns {truth.start_ns}"
        )
    _check_approaches(truth, path)
    _check_cues(truth, path)
    return truth


def _check_approaches(truth: Truth, path: Path) -> None:
    before: Approach | None = None
    for one in sorted(truth.approaches, key=lambda one: one.start_ns):
        if not truth.start_ns <= one.start_ns < one.enter_ns <= truth.end_ns:
            raise AnnotationError(
                f"{path}: approach {one.id}: start_ns {one.start_ns}, enter_ns {one.enter_ns}: "
                f"expected start before enter, both from {truth.start_ns} to {truth.end_ns}; "
                "correct it"
            )
        if before is not None and one.start_ns < before.enter_ns:
            raise AnnotationError(
                f"{path}: approaches {before.id} and {one.id} overlap; correct them"
            )
        before = one
    numbers = [one.id for one in truth.approaches]
    if len(set(numbers)) != len(numbers):
        raise AnnotationError(f"{path}: approaches: an id stands twice in {numbers}; correct it")


def _check_cues(truth: Truth, path: Path) -> None:
    numbers = {one.id for one in truth.approaches}
    known = (*CUES, *truth.own_cues)
    for place, one in enumerate(truth.cues):
        where = f"{path}: cues.{place} ({one.cue})"
        if one.cue not in known:
            near = difflib.get_close_matches(one.cue, known, 1)
            meant = f", meant: {near[0]}" if near else ""
            raise AnnotationError(
                f"{where}: no such cue{meant}; one of your own goes into own_cues"
            )
        spans = one.start_ns is not None and one.end_ns is not None
        if spans == (one.t_ns is not None) or (one.start_ns is None) != (one.end_ns is None):
            raise AnnotationError(
                f"{where}: expected either t_ns, or start_ns and end_ns; correct it"
            )
        first = one.t_ns if one.start_ns is None else one.start_ns
        last = first + 1 if one.end_ns is None and first is not None else one.end_ns
        assert first is not None
        assert last is not None
        if not truth.start_ns <= first < last <= truth.end_ns:
            raise AnnotationError(
                f"{where}: {first} to {last}: expected times from {truth.start_ns} to "
                f"{truth.end_ns}"
            )
        if one.approach is not None and one.approach not in numbers:
            raise AnnotationError(
                f"{where}: no approach {one.approach}; there are: {sorted(numbers)}"
            )


def _no_twins(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    if len(set(keys)) != len(keys):
        raise ValueError(f"a key stands twice in {keys}")
    return dict(pairs)


def json_schema() -> dict[str, Any]:
    """The file's JSON Schema, for other tools."""
    return Truth.model_json_schema()
