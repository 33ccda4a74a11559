"""Ground truth of a drive, ``truth.json``, and the check that it fits a log.

Version 1 contains pose, approaches, cues and the names of files with objects and ranges; every
section is optional.
"""

import difflib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias, cast

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from crosscue.replay.errors import AnnotationError, CrosscueError, EmptyResultError, one_line
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.formats import data_sets
from crosscue.replay.limits import DEFAULT_LIMITS, MIB, LimitsGiven
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.validation_errors import explain
from crosscue.results import Result, json_key

FILE: Final = "truth.json"
MAX_BYTES: Final = 256 * MIB

# Functions that write the truth of a data set, by format of ``replay.formats.FORMATS``.
CARRIED: Final[dict[str, str]] = {
    "comma2k19": "crosscue.datasets.adapters.comma2k19_truth:write_comma_truth",
    "kitti-raw": "crosscue.datasets.adapters.kitti:write_kitti_truth",
    "kitti-odometry": "crosscue.datasets.adapters.kitti_odometry:write_kitti_odometry_truth",
    "nuscenes": "crosscue.datasets.adapters.nuscenes_truth:write_nuscenes_truth",
    "pandaset": "crosscue.datasets.adapters.pandaset:write_pandaset_truth",
}


class TruthSection(BaseModel):
    """Section of a truth file, which refuses unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Origin(TruthSection):
    """Origin of the map frame; x points east, y north, z up."""

    latitude_deg: Annotated[float, Field(ge=-90.0, le=90.0)]
    longitude_deg: Annotated[float, Field(ge=-180.0, le=180.0)]
    altitude_m: float


class Mounting(TruthSection):
    """Rigid transform from the rear axle, on the ground, to a body; ISO 8855 axes.

    The rotations are applied in the order yaw, pitch, roll. Null means unknown: a score then uses
    x, y and yaw from the vehicle file's ``[camera]`` or ``[gnss]``, and reports it.
    """

    x_m: float | None = 0.0
    """Distance ahead of the rear axle."""
    y_m: float | None = 0.0
    """Distance to the left of the centre line."""
    z_m: float | None = 0.0
    """Height above the ground."""
    roll_rad: float | None = 0.0
    pitch_rad: float | None = 0.0
    """Pitch, positive downwards."""
    yaw_rad: float | None = 0.0
    """Yaw, positive counter-clockwise."""


Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)]


class Features(TruthSection):
    """Directions in which an intersection can be left; null means unknown and is not scored."""

    left: bool | None
    right: bool | None
    straight: bool | None


class Approach(TruthSection):
    """One approach to one intersection."""

    id: int
    intersection: str
    start_ns: int
    enter_ns: int
    """Time at which the rear axle reaches the start of the intersection, or the end of a log that
    ends before."""
    control: Literal["stop_sign", "traffic_light", "none"]
    features: Features
    one_way: Literal["left", "right"] | None = None
    """Direction of the crossroad's traffic, if it is one-way."""
    do_not_enter: bool = False
    conditions: tuple[str, ...] = ()
    """Free tags: rain, dusk, glare, occluded, ..."""
    length_m: float | None = None
    """Distance from the start of the intersection to its end."""


def _examples(schema: dict[str, Any]) -> None:
    schema["examples"] = [*CUES]


class CueTruth(TruthSection):
    """Presence of the object of a cue, at one time or over a half-open span."""

    cue: Annotated[Name, Field(json_schema_extra=_examples)]
    """Name in ``CUES``, or in the file's ``own_cues``."""
    present: bool
    t_ns: int | None = None
    start_ns: int | None = None
    end_ns: int | None = None
    approach: int | None = None
    count: int | None = None
    """Number of objects."""
    visible: float | None = None
    """Visible fraction of the most visible object."""


class Truth(TruthSection):
    """Ground truth of a drive, the content of a truth file."""

    version: Literal[1]
    log: str = ""
    """Name of its log, for display."""
    log_sha256: dict[str, str] = {}
    """Hashes by file name. A run of a log with none of them is refused; empty: not checked."""
    start_ns: int
    end_ns: int
    """End of the half-open range of log times that the truth covers."""
    place: str = ""
    """Name of the place. Drives of one place are not independent, so scores and comparisons
    resample places. Default: positions within 50 m of each other where the truth has an origin and
    a trajectory, else the names of the intersections."""
    pose: str | None = None
    """TUM trajectory, a file in the same folder: seconds on the log clock, metres, quaternion."""
    pose_point: Literal["rear_axle", "camera", "antenna", "imu"] = "rear_axle"
    """Body of the trajectory: the vehicle at its rear axle; a camera, x along its optical axis; a
    GNSS antenna, x along the vehicle; or an inertial unit, x along its forward axis."""
    mounting: Mounting | None = None
    """Position of that body on the vehicle. Default: at the rear axle, or, for a camera or an
    antenna, as in the vehicle file's ``[camera]`` or ``[gnss]``."""
    mounting_source: str = ""
    """Source and accuracy of the mounting."""
    position_sd_m: Annotated[float, Field(gt=0.0)] | None = None
    """Standard deviation of east and of north; null means exact."""
    heading_sd_rad: Annotated[float, Field(gt=0.0)] | None = None
    """Standard deviation of the heading; null means exact."""
    origin: Origin | None = None
    source: str = ""
    """Source and accuracy of the measurements."""
    map_sha256: str = ""
    """Hash of the map that the approaches are from. A run that used it is refused."""
    approaches: tuple[Approach, ...] = ()
    cues: tuple[CueTruth, ...] = ()
    own_cues: tuple[Name, ...] = ()
    """Additional cues in this file, named as in the vehicle file's ``[cues.own]``."""
    objects: str | None = None
    """COCO file of labelled objects in the same folder, with images by ``t_ns``."""
    ranges: str | None = None
    """CSV file in the same folder: t_ns, approach, start_m, end_m, of the rear axle at each
    picture."""


# Writes ``truth.json`` for the data set at a path to a folder, and returns its path.
Writer: TypeAlias = Callable[[Path, Path], Path]


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
    """Write ``truth.json`` to ``folder``, and return its path."""
    write_text(folder / FILE, strict_json(truth.model_dump(mode="json")) + "\n")
    return folder / FILE


def read_truth(path: Path) -> Truth:
    """Read and check a truth file, or the ``truth.json`` of a folder.

    Raises:
        AnnotationError: The file does not exist, is not JSON, or does not conform to version 1.
    """
    path = path / FILE if path.is_dir() else path
    try:
        content = read_whole(path, MAX_BYTES)
        tree = json_tree(content, object_pairs_hook=_unique_keys)
        truth = Truth.model_validate(tree)
    except ValidationError as error:
        raise AnnotationError(explain(error, None, str(path), Truth)) from None
    except FileNotFoundError:
        raise AnnotationError(
            f"{path}: no such truth file; for a data set write it with: crosscue truth LOG -o DIR"
        ) from None
    except OSError as error:
        raise AnnotationError(f"{path}: {error.strerror}; correct it") from None
    except ValueError as error:
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
        raise AnnotationError(f"{path}: approaches: duplicate id in {numbers}; correct it")


def _check_cues(truth: Truth, path: Path) -> None:
    numbers = {one.id for one in truth.approaches}
    known = (*CUES, *truth.own_cues)
    for place, one in enumerate(truth.cues):
        where = f"{path}: cues.{place} ({one.cue})"
        if one.cue not in known:
            near = difflib.get_close_matches(one.cue, known, 1)
            meant = f", did you mean {near[0]}?" if near else ""
            raise AnnotationError(f"{where}: no such cue{meant}; list your own cues in own_cues")
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


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    if len(set(keys)) != len(keys):
        raise ValueError(f"duplicate key in {keys}")
    return dict(pairs)


def truth_schema() -> dict[str, Any]:
    """Print the JSON Schema of truth.json, for editors and other tools.

    Examples:
        crosscue truth schema > truth.schema.json
    """
    from crosscue.replay.meanings import SchemaWithMeanings

    return Truth.model_json_schema(schema_generator=SchemaWithMeanings)


@dataclass(frozen=True, slots=True, repr=False)
class WrittenTruth(Result):
    """A truth file that was written.

    Attributes:
        path: The file.
        source: Where its content is from, and what is missing; empty if not known.
    """

    path: Path = field(metadata=json_key("truth"))
    source: str = ""

    def lines(self) -> Iterator[str]:
        """Yield the path, and where its content is from."""
        yield str(self.path)
        if self.source:
            yield f"source  {self.source}"


def write_truth(
    log: Path | str, output: Path | str, *, limits: LimitsGiven = DEFAULT_LIMITS
) -> WrittenTruth:
    """Write the truth that a data set contains.

    The result is truth.json and a TUM trajectory.

    Examples:
        crosscue truth comma2k19/Example_1/ROUTE/40 -o truth/

    Args:
        log: Folder of a data set.
        output: Folder for the truth file and its trajectory.
        limits: Limits for reading the logs.

    Raises:
        EmptyResultError: The log's format contains no truth.
        OutputError: The files cannot be written.
    """
    with open_log(log, limits) as opened:
        path = write_carried(opened.format, Path(opened.path), Path(output))
        return WrittenTruth(path, read_truth(path).source)
