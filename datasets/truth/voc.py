"""Read a Pascal VOC file: the boxes of one picture, as XML.

The file is parsed with expat, like CVAT's files: a document type declaration is refused, so that
there are no entities. (defusedxml, which does the same, has had no release since 2021.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeAlias
from xml.parsers import expat

from crosscue.replay.errors import AnnotationError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.limits import MIB

MAX_BYTES: Final = 16 * MIB
MAX_DEPTH: Final = 16
# Class; x0, y0, x1, y1 in pixels; True if it is marked difficult.
VocBox: TypeAlias = tuple[str, tuple[float, float, float, float], bool]


def read_voc(path: Path) -> tuple[str, tuple[int, int] | None, list[VocBox]]:
    """Return file name, size and boxes of the picture.

    Raises:
        AnnotationError: The file does not exist, has another format, or contains a document type
            declaration.
    """
    reader = _Reader(str(path))
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = reader.refuse_doctype
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.text
    parser.buffer_text = True
    try:
        content = read_at_most(path, MAX_BYTES)
        if content is None:
            raise AnnotationError(f"{path}: over {MAX_BYTES // MIB} MiB; expected Pascal VOC")
        parser.Parse(content, True)
    except (OSError, expat.ExpatError) as error:
        raise AnnotationError(f"{path}: not XML ({error}); expected a Pascal VOC file") from None
    if not reader.is_voc:
        raise AnnotationError(f"{path}: no <annotation>; expected a Pascal VOC file")
    name = reader.values.get("annotation/filename", "") or path.name
    return name, reader.size(), reader.boxes


@dataclass(slots=True)
class _Reader:
    """Parser of a file, with the contents read so far; values by their path below the root."""

    where: str
    is_voc: bool = False
    values: dict[str, str] = field(default_factory=dict)
    boxes: list[VocBox] = field(default_factory=list)
    _place: list[str] = field(default_factory=list)
    _object: dict[str, str] = field(default_factory=dict)
    _text: str = ""

    def refuse_doctype(self, *_: object) -> None:
        """Refuse a document type declaration."""
        raise AnnotationError(f"{self.where}: has a document type declaration; remove it")

    def start(self, name: str, _attributes: dict[str, str]) -> None:
        """Handle the start of an element."""
        self._place.append(name)
        if len(self._place) > MAX_DEPTH:
            raise AnnotationError(f"{self.where}: over {MAX_DEPTH} elements deep; not Pascal VOC")
        self.is_voc = self.is_voc or self._place == ["annotation"]
        self._text = ""
        if self._place == ["annotation", "object"]:
            self._object = {}

    def text(self, text: str) -> None:
        """Handle the text of an element."""
        self._text += text

    def end(self, _name: str) -> None:
        """Handle the end of an element."""
        place = "/".join(self._place)
        if place.startswith("annotation/object/"):
            self._object.setdefault(place.removeprefix("annotation/object/"), self._text.strip())
        elif place == "annotation/object":
            self.boxes.append(self._box())
        else:
            self.values.setdefault(place, self._text.strip())
        self._place.pop()

    def size(self) -> tuple[int, int] | None:
        """Width and height, if the file specifies them."""
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
