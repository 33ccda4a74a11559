"""Match annotated pictures of other tools to a log's frames, and convert them to ground truth.

A label with the name of a cue (``stop sign``, ``parked_left``) means that the cue is present. An
annotated picture without the label means that the cue is absent. Other labels remain labels of
objects.
"""

import difflib
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.replay.columns import Int64s
from crosscue.replay.errors import AnnotationError, SchemaError, UsageError
from crosscue.replay.vehicle.cue_table import CUES

from .truth import CueTruth

# Labels of objects on a road that are not cues by themselves.
OTHER_THINGS: Final = frozenset(
    {"person", "pedestrian", "bicycle", "car", "motorcycle", "bus", "train", "truck", "van",
     "vehicle", "rider", "trailer"}
)  # fmt: skip
# Max distance of a box outside the picture; tools round differently.
SLACK_PX: Final = 1.0
# Max time between a picture and its frame, as a fraction of the time between frames.
FAR: Final = 0.4


@dataclass(frozen=True, slots=True)
class Annotation:
    """One annotated object.

    Attributes:
        label: Label as annotated.
        box_px: x0, y0, x1, y1; None for a label of the complete picture. In fractions of the
            picture if that says so.
        is_crowd: True for a group of objects that are not counted, or a region that is not scored.
        visible: Visible fraction, or None.
        track: Number of the object in all pictures; None if unknown.
        segmentation: COCO's polygons or run lengths, or None.
        place: Position in its file, for errors.
        range_m: Distance from the camera, or None if the file does not specify it.
        score: Score of a detector, for a box that is not confirmed yet.
    """

    label: str
    box_px: tuple[float, float, float, float] | None
    is_crowd: bool = False
    visible: float | None = None
    track: int | None = None
    segmentation: Any = None
    place: str = ""
    range_m: float | None = None
    score: float | None = None


@dataclass(frozen=True, slots=True)
class Picture:
    """One annotated picture.

    Attributes:
        name: File name.
        size_px: Width and height in the annotation tool; 0 if it does not specify them.
        t_ns: Log time, if the file reports it.
        frame: Number of the frame in its video, if the file reports it.
        things: Annotated objects; empty if the picture shows none of them.
        is_in_fractions: True if boxes are in fractions of the picture, not in pixels.
    """

    name: str
    size_px: tuple[int, int]
    t_ns: int | None = None
    frame: int | None = None
    things: tuple[Annotation, ...] = ()
    is_in_fractions: bool = False

    def boxes(self) -> Iterator[tuple[Annotation, tuple[float, float, float, float]]]:
        """Yield its objects that have a box, with the box."""
        return ((thing, thing.box_px) for thing in self.things if thing.box_px is not None)


@dataclass(frozen=True, slots=True)
class Annotations:
    """One file of annotations.

    Attributes:
        where: Path of the file.
        labels: All labels that annotators could use.
        pictures: All annotated pictures.
        ignored: Number of ignored elements of the file, by kind.
    """

    where: str
    labels: tuple[str, ...]
    pictures: tuple[Picture, ...]
    ignored: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class LogPictures:
    """The pictures of a log's camera.

    Attributes:
        where: Path of the log.
        t_ns: Times, shape (N,), increasing.
        size_px: Width and height of the first picture.
        names: Times by file name if the pictures are files; else empty.
    """

    where: str
    t_ns: Int64s
    size_px: tuple[int, int]
    names: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PictureTimes:
    """Log times of pictures.

    Attributes:
        t_ns: Time of each picture.
        rule: Description of the rule that found the times, for display.
    """

    t_ns: tuple[int, ...]
    rule: str


# Width and height by the name of a picture without suffix; ``*`` for all others.
Sizes = Mapping[str, tuple[int, int]]


def labelled_size(stem: str, sizes: Sizes, path: Path) -> tuple[int, int]:
    """Return the size of a picture whose labels are in fractions of it.

    Raises:
        AnnotationError: The size is unknown.
    """
    size = sizes.get(stem, sizes.get("*"))
    if size is None:
        raise AnnotationError(
            f"{path}: {stem}: no such picture was exported; expected names as exported"
        )
    return size


def match_frames(annotations: Annotations, log: LogPictures) -> PictureTimes:
    """Find the frame of each picture: by its time, its file name, or its number.

    Raises:
        SchemaError: A picture belongs to no frame, two belong to one frame, or sizes differ.
    """
    if not annotations.pictures:
        raise SchemaError(f"{annotations.where}: no picture in it; nothing to import")
    _check_sizes(annotations, log)
    placed = (
        _by_name(annotations, log) or _by_time(annotations, log) or _by_number(annotations, log)
    )
    for t_ns, times in Counter(placed.t_ns).items():
        if times > 1:
            names = [
                p.name for p, t in zip(annotations.pictures, placed.t_ns, strict=True) if t == t_ns
            ]
            raise SchemaError(
                f"{annotations.where}: {' and '.join(names[:2])} belong to one frame, {t_ns} ns "
                f"({placed.rule}); expected a different time or number for each"
            )
    return placed


def _check_sizes(annotations: Annotations, log: LogPictures) -> None:
    for picture in annotations.pictures:
        if picture.size_px != log.size_px:
            raise SchemaError(
                f"{annotations.where}: {picture.name}: {_size(picture.size_px)} pixels; those of "
                f"{log.where} have {_size(log.size_px)}; annotate pictures as recorded"
            )


def _size(size_px: tuple[int, int]) -> str:
    return f"{size_px[0]} x {size_px[1]}"


def _by_name(annotations: Annotations, log: LogPictures) -> PictureTimes | None:
    names = [re.split(r"[/\\]", picture.name)[-1] for picture in annotations.pictures]
    if not all(name in log.names for name in names):
        return None
    return PictureTimes(tuple(log.names[name] for name in names), "by file name")


def _by_time(annotations: Annotations, log: LogPictures) -> PictureTimes | None:
    """Match each picture to the nearest frame, by ``t_ns`` or a file name that is a time."""
    asked = [_time_of(picture) for picture in annotations.pictures]
    if any(t is None for t in asked):
        return None
    wanted = np.array(asked, np.int64)
    found = nearest_times(log.t_ns, wanted)
    off = np.abs(found - wanted)
    period = float(np.median(np.diff(log.t_ns))) if len(log.t_ns) > 1 else math.inf
    if off.max() > FAR * period:
        worst = int(off.argmax())
        raise SchemaError(
            f"{annotations.where}: {annotations.pictures[worst].name}: no frame of {log.where} "
            f"near {wanted[worst]} ns; the nearest is {found[worst]} ns; it belongs to another log"
        )
    return PictureTimes(tuple(found.tolist()), f"by time, at most {off.max() * 1e-6:.1f} ms off")


def nearest_times(t_ns: Int64s, wanted: Int64s) -> Int64s:
    """Return the time of ``t_ns``, which increases, that is nearest to each wanted one."""
    after = np.clip(np.searchsorted(t_ns, wanted), 0, len(t_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(wanted - t_ns[before]) < np.abs(wanted - t_ns[after])
    return t_ns[np.where(is_before, before, after)]


def _time_of(picture: Picture) -> int | None:
    if picture.t_ns is not None:
        return picture.t_ns
    name = re.split(r"[/\\]", picture.name)[-1]
    stem = re.sub(r"\.[A-Za-z]+$", "", name)
    return time_in_name(stem)


def time_in_name(stem: str) -> int | None:
    """Return the log time in a picture's name: ``DRIVE_17...ns`` as exported, or nanoseconds."""
    exported = re.search(r"_([0-9]{1,19})ns$", stem)
    if exported is not None:
        return int(exported[1])
    # Nanoseconds since 1970 have nineteen digits, unlike frame numbers.
    return int(stem) if re.fullmatch(r"[0-9]{16,19}", stem) else None


def _by_number(annotations: Annotations, log: LogPictures) -> PictureTimes:
    times: list[int] = []
    for picture in annotations.pictures:
        number = picture.frame
        if number is None:
            digits = re.search(r"([0-9]{1,9})\.[A-Za-z]+$", picture.name)
            if digits is None:
                raise SchemaError(
                    f"{annotations.where}: {picture.name}: has neither a time nor a frame; give "
                    "pictures with a t_ns, or names that end in the frame's number, from 0"
                )
            number = int(digits[1])
        if not 0 <= number < len(log.t_ns):
            raise SchemaError(
                f"{annotations.where}: {picture.name}: frame {number} of {len(log.t_ns)} in "
                f"{log.where} (the first is 0); it belongs to another log"
            )
        times.append(int(log.t_ns[number]))
    return PictureTimes(tuple(times), "by frame number, the first being 0")


def cues_by_label(
    annotations: Annotations,
    own: Mapping[str, str],
    own_cues: Sequence[str] = (),
    *,
    any_thing: bool = False,
) -> dict[str, str | None]:
    """Return cues by label; None for objects that are not cues.

    Args:
        annotations: Annotations with labels.
        own: The user's cues by label; an empty cue for an object that is not a cue.
        own_cues: Cues in addition to the built-in ones.
        any_thing: Accept unknown labels, unless they resemble the name of a cue.

    Raises:
        UsageError: ``own`` names an unknown label or cue.
        SchemaError: A label is neither a cue nor a known object.
    """
    cues = (*CUES, *own_cues)
    for label, cue in own.items():
        if label not in annotations.labels:
            raise UsageError(
                f"meanings: {label}={cue}, no such label; {_choices(annotations.labels)}"
            )
        if cue and cue not in cues:
            raise UsageError(
                f"meanings: {label}={cue}, no such cue; {_choices(cues)}; --vehicle names your own"
            )
    found: dict[str, str | None] = {}
    for label in annotations.labels:
        plain = re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")
        if label in own:
            found[label] = own[label] or None
        elif plain in cues:
            found[label] = plain
        elif plain in OTHER_THINGS:
            found[label] = None
        else:
            close = difflib.get_close_matches(plain, cues, n=1, cutoff=0.6)
            if any_thing and not close:
                found[label] = None
                continue
            hint = close[0] if close else ""
            raise SchemaError(
                f"{annotations.where}: class {label!r} is neither a cue nor a known object; map it "
                f"with --map '{label}={hint}' (nothing after = if it is not a cue)"
            )
    return found


def _choices(names: Sequence[str]) -> str:
    return f"there are: {', '.join(names)}"


def check_boxes(annotations: Annotations) -> None:
    """Refuse boxes without area, or outside their picture.

    Raises:
        SchemaError: A box is invalid; the message states the position of the first one.
    """
    for picture in annotations.pictures:
        width, height = picture.size_px
        for thing, box_px in picture.boxes():
            x0, y0, x1, y1 = box_px
            where = f"{annotations.where}: {thing.place or picture.name} ({thing.label})"
            if not (x0 < x1 and y0 < y1):
                raise SchemaError(f"{where}: box {_box(box_px)} has no area; correct it")
            if x0 < -SLACK_PX or y0 < -SLACK_PX or x1 > width + SLACK_PX or y1 > height + SLACK_PX:
                raise SchemaError(
                    f"{where}: box {_box(box_px)} is outside the picture of "
                    f"{_size(picture.size_px)} pixels; correct it"
                )


def _box(box: tuple[float, float, float, float]) -> str:
    return " ".join(f"{value:g}" for value in box)


def cue_truths(
    annotations: Annotations, placed: PictureTimes, cues: Mapping[str, str | None]
) -> tuple[CueTruth, ...]:
    """Return the truth of each cue that could be labelled, for each annotated picture."""
    meant = {cue for cue in cues.values() if cue is not None}
    known: list[str] = [cue for cue in CUES if cue in meant]
    known += sorted(meant.difference(known))
    reported: list[CueTruth] = []
    for t_ns, picture in sorted(
        zip(placed.t_ns, annotations.pictures, strict=True), key=lambda pair: pair[0]
    ):
        for cue in known:
            mine = [thing for thing in picture.things if cues[thing.label] == cue]
            seen = [thing.visible for thing in mine if thing.visible is not None]
            counted = not any(thing.is_crowd for thing in mine)
            reported.append(
                CueTruth(
                    cue=cue,
                    present=bool(mine),
                    t_ns=t_ns,
                    count=len(mine) if counted else None,
                    visible=max(seen) if mine and len(seen) == len(mine) else None,
                )
            )
    return tuple(reported)
