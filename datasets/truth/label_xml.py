"""Read labels in XML: CVAT's XML 1.1, for images and for video, and Pascal VOC; write CVAT's.

The files are parsed with expat. A document type declaration is refused, so that there are no
entities: nothing is fetched or expanded. (defusedxml, which does the same, has had no release since
2021.)
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final, TypeAlias
from xml.parsers import expat
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from crosscue.replay.columns import Floats
from crosscue.replay.errors import AnnotationError
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.limits import MIB

from .annotations import Annotation, Annotations, Picture

MAX_BYTES: Final = 512 * MIB
MAX_VOC_BYTES: Final = 16 * MIB
MAX_FRAMES: Final = 10_000_000
MAX_SIDE: Final = 100_000
WRITTEN: Final = "annotations.xml"
SHAPES: Final = ("box", "polygon", "mask", "tag")
IGNORED: Final = ("polyline", "points", "cuboid", "ellipse", "skeleton")


def read_cvat(path: Path) -> Annotations:
    """Read an ``annotations.xml``.

    Boxes, polygons, masks and tags are read; other shapes are counted in ``ignored``.

    Raises:
        AnnotationError: The file does not exist, has another format, or contains a document type
            declaration.
    """
    reader = _CvatReader(str(path))
    parse_xml(path, reader, MAX_BYTES)
    return reader.annotations()


def parse_xml(path: Path, reader: XmlReader, max_bytes: int) -> None:
    """Parse a file.

    Raises:
        AnnotationError: It is missing, too large, or not XML, or its reader refuses it.
    """
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = reader.refuse_doctype
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.text
    parser.buffer_text = True
    try:
        content = read_whole(path, max_bytes)
        parser.Parse(content, True)
    except OSError as error:
        raise AnnotationError(f"{path}: {error.strerror}; expected {reader.kind}") from None
    except expat.ExpatError as error:
        raise AnnotationError(f"{path}: not XML ({error}); expected {reader.kind}") from None


@dataclass(slots=True)
class XmlReader:
    """Parser of a file; the path of the current element, and its text."""

    where: str
    kind: ClassVar[str]
    max_depth: ClassVar[int]
    _path: list[str] = field(default_factory=list)
    _words: list[str] = field(default_factory=list)

    def refuse_doctype(self, *_: object) -> None:
        """Refuse the file."""
        raise AnnotationError(
            f"{self.where}: has a document type declaration, which may define entities; remove it "
            f"({self.kind} has none)"
        )

    def start(self, tag: str, found: Mapping[str, str]) -> None:
        """Begin an element."""
        if len(self._path) >= self.max_depth:
            raise AnnotationError(
                f"{self.where}: nested over {self.max_depth} levels deep; expected {self.kind}"
            )
        self._path.append(tag)
        self._words = []

    def end(self, tag: str) -> None:
        """End an element."""
        self._path.pop()
        self._words = []

    def text(self, words: str) -> None:
        """Take text of the current element."""
        self._words.append(words)

    @property
    def _said(self) -> str:
        return "".join(self._words).strip()


@dataclass(slots=True)
class _CvatReader(XmlReader):
    kind = "CVAT's XML 1.1"
    max_depth = 64
    _meta: dict[str, str] = field(default_factory=dict)
    _labels: list[str] = field(default_factory=list)
    _pictures: list[Picture] = field(default_factory=list)
    _things: list[Annotation] = field(default_factory=list)
    _by_frame: dict[int, list[Annotation]] = field(default_factory=dict)
    _track: tuple[int, str] | None = None
    _ignored: dict[str, int] = field(default_factory=dict)

    def start(self, tag: str, found: Mapping[str, str]) -> None:
        if not self._path and tag != "annotations":
            raise AnnotationError(
                f"{self.where}: <{tag}>: expected <annotations> of CVAT's XML 1.1"
            )
        XmlReader.start(self, tag, found)
        if tag == "image":
            self._things = []
            self._pictures.append(self._picture(found))
        elif tag == "track":
            self._track = (self._whole(found, "id"), self._text(found, "label"))
        elif tag in SHAPES and self._path[-2] in ("image", "track"):
            self._shape(tag, found)
        elif tag in IGNORED and self._path[-2] in ("image", "track"):
            self._ignored[tag] = self._ignored.get(tag, 0) + 1

    def end(self, tag: str) -> None:
        text = self._said
        if self._path[-3:] == ["labels", "label", "name"]:
            self._labels.append(text)
        elif "meta" in self._path:
            # The first is used, because other numbers below <segments> have the same names.
            self._meta.setdefault("/".join(self._path[-2:]), text)
        elif tag == "image":
            last = self._pictures.pop()
            self._pictures.append(
                Picture(last.name, last.size_px, None, last.frame, tuple(self._things))
            )
        elif tag == "track":
            self._track = None
        XmlReader.end(self, tag)

    def _picture(self, found: Mapping[str, str]) -> Picture:
        name = self._text(found, "name")
        size = (self._whole(found, "width"), self._whole(found, "height"))
        self._check_size(size)
        # The frame is the number at the end of the name, else the number of the picture.
        has_number = re.search(r"[0-9]\.[A-Za-z]+$", name) is not None
        return Picture(name, size, None, None if has_number else self._whole(found, "id"))

    def _check_size(self, size: tuple[int, int]) -> None:
        if not (0 < size[0] <= MAX_SIDE and 0 < size[1] <= MAX_SIDE):
            raise AnnotationError(
                f"{self.where}: pictures of {size[0]} x {size[1]}: expected pixels"
            )

    def _shape(self, tag: str, found: Mapping[str, str]) -> None:
        if self._path[-2] == "track":
            assert self._track is not None
            frame = self._whole(found, "frame")
            things = self._by_frame.setdefault(frame, [])
            # An ``outside`` box is the object's last position; the object is not in this frame.
            if found.get("outside") != "1":
                number, label = self._track
                things.append(self._thing(tag, found, label, number, f"track {number}"))
            return
        label = self._text(found, "label")
        name = self._pictures[-1].name
        self._things.append(self._thing(tag, found, label, None, name))

    def _thing(
        self, tag: str, found: Mapping[str, str], label: str, track: int | None, place: str
    ) -> Annotation:
        if tag == "tag":
            return Annotation(label, None, track=track, place=place)
        if tag == "box":
            x0, y0, x1, y1 = (self._number(found, name) for name in ("xtl", "ytl", "xbr", "ybr"))
            return Annotation(label, (x0, y0, x1, y1), track=track, place=place)
        if tag == "mask":
            left, top, wide, high = (
                self._whole(found, name) for name in ("left", "top", "width", "height")
            )
            return Annotation(label, (left, top, left + wide, top + high), track=track, place=place)
        points = self._points(found)
        corners = (*points.min(axis=0).tolist(), *points.max(axis=0).tolist())
        box = (corners[0], corners[1], corners[2], corners[3])
        return Annotation(
            label, box, track=track, place=place, segmentation=[points.ravel().tolist()]
        )

    def _points(self, found: Mapping[str, str]) -> Floats:
        text = self._text(found, "points")
        try:
            pairs = [[float(value) for value in pair.split(",")] for pair in text.split(";")]
            points = np.array(pairs, np.float64)
        except ValueError:
            points = np.empty((0, 0))
        if points.ndim != 2 or points.shape[1:] != (2,) or not np.isfinite(points).all():
            raise AnnotationError(
                f"{self.where}: points {text[:40]!r}: expected x,y;x,y;...; correct it"
            )
        return points

    def _text(self, found: Mapping[str, str], name: str) -> str:
        if name not in found:
            raise AnnotationError(
                f"{self.where}: <{self._path[-1]}> has no {name}; expected CVAT's XML 1.1"
            )
        return found[name]

    def _whole(self, found: Mapping[str, str], name: str) -> int:
        text = self._text(found, name)
        if not re.fullmatch(r"[0-9]{1,9}", text):
            raise AnnotationError(
                f"{self.where}: <{self._path[-1]}> {name} {text[:40]!r}: expected a whole number"
            )
        return int(text)

    def _number(self, found: Mapping[str, str], name: str) -> float:
        text = self._text(found, name)
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise AnnotationError(
                f"{self.where}: <{self._path[-1]}> {name} {text[:40]!r}: expected a number"
            )
        return value

    def annotations(self) -> Annotations:
        pictures = tuple(self._pictures) or self._video()
        used = {thing.label for picture in pictures for thing in picture.things}
        labels = tuple(dict.fromkeys([*self._labels, *sorted(used)]))
        return Annotations(self.where, labels, pictures, dict(self._ignored))

    def _video(self) -> tuple[Picture, ...]:
        size = (self._known("original_size/width"), self._known("original_size/height"))
        self._check_size(size)
        first = self._known("start_frame", 0)
        last = self._known("stop_frame", first + self._known("size", 0) - 1)
        filtered = re.search(r"step=([0-9]{1,6})", self._found("frame_filter") or "")
        step = max(int(filtered[1]), 1) if filtered else 1
        if last - first > MAX_FRAMES:
            raise AnnotationError(f"{self.where}: frames {first} to {last}: over {MAX_FRAMES}")
        frames = range(first, last + 1, step)
        # An object drawn in a single frame ends one frame later, possibly after the last frame.
        strange = [n for n, things in self._by_frame.items() if things and n not in frames]
        if strange:
            raise AnnotationError(
                f"{self.where}: frame {strange[0]}: the task has {first} to {last} by {step}"
            )
        return tuple(
            Picture(f"frame {n}", size, None, n, tuple(self._by_frame.get(n, ()))) for n in frames
        )

    def _found(self, name: str) -> str | None:
        ends = (f"task/{name}", f"job/{name}", name)
        return next((self._meta[end] for end in ends if end in self._meta), None)

    def _known(self, name: str, otherwise: int | None = None) -> int:
        text = self._found(name) or ""
        if re.fullmatch(r"[0-9]{1,9}", text):
            return int(text)
        if otherwise is None or text:
            raise AnnotationError(
                f"{self.where}: meta: {name} {text[:40]!r}: expected a whole number"
            )
        return otherwise


def write_cvat(folder: Path, labels: Annotations) -> Path:
    """Write a file "CVAT for images" 1.1, and return its path.

    Raises:
        OutputError: The file cannot be written.
    """
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        "<annotations>",
        "<version>1.1</version>",
        "<meta><task>",
        f"<name>{escape(labels.where)}</name><size>{len(labels.pictures)}</size>",
        "<mode>annotation</mode><labels>",
        *(f"<label><name>{escape(name)}</name></label>" for name in labels.labels),
        "</labels></task></meta>",
    ]
    for number, picture in enumerate(labels.pictures):
        lines += _written(number, picture)
    write_text(folder / WRITTEN, "\n".join([*lines, "</annotations>"]) + "\n")
    return folder / WRITTEN


def _written(number: int, picture: Picture) -> list[str]:
    wide, high = picture.size_px
    boxes = []
    for thing, box_px in picture.boxes():
        x0, y0, x1, y1 = (repr(float(side)) for side in box_px)
        boxes.append(
            f'<box label={quoteattr(thing.label)} source="auto" occluded="0" xtl="{x0}" '
            f'ytl="{y0}" xbr="{x1}" ybr="{y1}" z_order="0"></box>'
        )
    head = f'<image id="{number}" name={quoteattr(picture.name)} width="{wide}" height="{high}">'
    return [head, *boxes, "</image>"]


# Class; x0, y0, x1, y1 in pixels; True if it is marked difficult.
VocBox: TypeAlias = tuple[str, tuple[float, float, float, float], bool]


def read_voc(path: Path) -> tuple[str, tuple[int, int] | None, list[VocBox]]:
    """Return file name, size and boxes of the picture.

    Raises:
        AnnotationError: The file does not exist, has another format, or contains a document type
            declaration.
    """
    reader = _VocReader(str(path))
    parse_xml(path, reader, MAX_VOC_BYTES)
    if not reader.is_voc:
        raise AnnotationError(f"{path}: no <annotation>; expected a Pascal VOC file")
    name = reader.values.get("annotation/filename", "") or path.name
    return name, reader.size(), reader.boxes


@dataclass(slots=True)
class _VocReader(XmlReader):
    kind = "a Pascal VOC file"
    max_depth = 16
    is_voc: bool = False
    values: dict[str, str] = field(default_factory=dict)
    boxes: list[VocBox] = field(default_factory=list)
    _object: dict[str, str] = field(default_factory=dict)

    def start(self, tag: str, found: Mapping[str, str]) -> None:
        XmlReader.start(self, tag, found)
        self.is_voc = self.is_voc or self._path == ["annotation"]
        if self._path == ["annotation", "object"]:
            self._object = {}

    def end(self, tag: str) -> None:
        place, text = "/".join(self._path), self._said
        if place.startswith("annotation/object/"):
            self._object.setdefault(place.removeprefix("annotation/object/"), text)
        elif place == "annotation/object":
            self.boxes.append(self._box())
        else:
            self.values.setdefault(place, text)
        XmlReader.end(self, tag)

    def size(self) -> tuple[int, int] | None:
        found = [self.values.get(f"annotation/size/{side}", "") for side in ("width", "height")]
        if not all(one.isdecimal() and int(one) > 0 for one in found):
            return None
        return int(found[0]), int(found[1])

    def _box(self) -> VocBox:
        where = f"{self.where}: object {len(self.boxes) + 1}"
        if not self._object.get("name"):
            raise AnnotationError(f"{where}: no name; correct it")
        try:
            x0, y0, x1, y1 = (
                float(self._object[f"bndbox/{side}"]) for side in ("xmin", "ymin", "xmax", "ymax")
            )
        except (KeyError, ValueError):
            raise AnnotationError(
                f"{where} ({self._object['name']}): expected bndbox with xmin, ymin, xmax and ymax"
            ) from None
        if not all(map(math.isfinite, (x0, y0, x1, y1))):
            raise AnnotationError(f"{where} ({self._object['name']}): expected finite numbers")
        # The first pixel is 1, and the last pixel belongs to the box.
        box = (x0 - 1.0, y0 - 1.0, x1, y1)
        return self._object["name"], box, self._object.get("difficult", "0") == "1"
