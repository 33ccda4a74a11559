"""Read labelled boxes of pictures: COCO, YOLO, Pascal VOC and KITTI; or what pictures show.

* COCO: a ``.json`` file. ``iscrowd`` marks regions that are not scored; ``t_ns`` and ``range_m``
  (of an annotation, metres) are used if present.
* YOLO: a folder of ``.txt`` files, ``class x y width height`` in fractions of the picture. Class
  names come from ``classes.txt``, ``obj.names``, ``data.yaml`` or ``dataset.yaml`` there or up to
  two folders above.
* Pascal VOC: a folder of ``.xml`` files. The first pixel is 1, and the last pixel belongs to the
  box; objects marked ``difficult`` are not scored.
* KITTI: a folder of ``.txt`` files with 15 columns. ``DontCare`` regions are not scored; the range
  is the distance ahead of the camera.
* Pictures: a ``.csv`` or ``.tsv`` file. The heading names the column of the pictures and the
  classes; in each row, yes, no, 1 or 0 says whether the picture shows an object of that class.

A file without boxes means that its picture shows no objects; a picture without a file is not
labelled.
"""

import csv
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

import numpy as np

from crosscue.replay.errors import AnnotationError, EmptyResultError, UsageError
from crosscue.replay.files.bounded import read_text
from crosscue.replay.files.tree_text import yaml_tree
from crosscue.replay.limits import MIB
from crosscue.verb import Option

from .annotations import Annotation, Annotations, Picture
from .coco import read_coco
from .label_xml import read_voc

LabelFormat: TypeAlias = Literal["coco", "yolo", "voc", "kitti", "pictures"]
FORMATS: Final[tuple[LabelFormat, ...]] = ("coco", "yolo", "voc", "kitti", "pictures")
MAX_TEXT_BYTES: Final = 16 * MIB
NAME_FILES: Final = ("classes.txt", "obj.names", "data.yaml", "dataset.yaml")
DONT_CARE: Final = "DontCare"
OUTSIDE: Final = "boxes outside the picture, or without area"
CUT: Final = "boxes cut off at the picture's edge"
NO_SIZE: Final = (0, 0)
_KITTI_COLUMNS: Final = 15
# Separators of the columns of a table of pictures, by suffix.
_SEPARATORS: Final = {".csv": ",", ".tsv": "\t"}
_YES: Final = ("yes", "true", "1")
_NO: Final = ("no", "false", "0")


def meanings_of(
    *, meanings: Annotated[Sequence[str], Option("--map", metavar="LABEL=NAME")] = ()
) -> dict[str, str]:
    """Return names by label.

    Args:
        meanings: Class or cue that a label counts as; LABEL= ignores it.

    Raises:
        UsageError: A text is not ``LABEL=NAME``.
    """
    found = {}
    for text in meanings:
        name, equals, means = text.rpartition("=")
        if not equals or not name:
            raise UsageError(f"meanings: {text}, expected LABEL=NAME")
        found[name] = means
    return found


# Class or cue of each label, as a parameter of a verb: on the command line, ``--map``.
Meanings: TypeAlias = Annotated[Mapping[str, str], Option(made_by=meanings_of)]


@dataclass(frozen=True, slots=True)
class BoxLabels(Annotations):
    """Labelled boxes of any number of pictures; a label is empty for a region of any class.

    Attributes:
        format: Format of the labels.
    """

    format: LabelFormat = "coco"

    @property
    def is_by_picture(self) -> bool:
        """True if each box stands for a whole picture that shows such an object."""
        return self.format == "pictures"


def boxes_inside(
    picture: Picture, size_px: tuple[int, int], left_out: Counter[str]
) -> list[Annotation]:
    """Return a picture's boxes in pixels within it; others are counted in ``left_out``."""
    width, height = size_px
    factor = np.array([width, height] * 2) if picture.is_in_fractions else np.ones(4)
    found = []
    for one, box in picture.boxes():
        whole = np.array(box) * factor
        cut = np.clip(whole, 0.0, [width, height, width, height])
        if cut[2] - cut[0] < 1.0 or cut[3] - cut[1] < 1.0:
            left_out[OUTSIDE] += 1
            continue
        if np.abs(cut - whole).max() > 1.0:
            left_out[CUT] += 1
        x0, y0, x1, y1 = cut.tolist()
        found.append(replace(one, box_px=(x0, y0, x1, y1)))
    return found


def read_box_labels(
    path: Path, kind: str | None = None, class_names: Sequence[str] = ()
) -> BoxLabels:
    """Read labelled boxes.

    Args:
        path: A COCO file, a table of pictures, or a folder of the other formats.
        kind: One of ``FORMATS``; detected by default.
        class_names: Class names in YOLO's order; for other formats, all classes that annotators
            could use.

    Raises:
        UsageError: The format is unknown, or YOLO class names are missing.
        AnnotationError: A file cannot be read; the message states the position.
        EmptyResultError: There are no labelled pictures.
    """
    if kind not in (None, *FORMATS):
        raise UsageError(f"kind: {kind}, expected one of {', '.join(FORMATS)}")
    files = _files(path)
    known = kind or _recognised(path, files)
    if known == "coco":
        found = _coco(path)
    elif known == "pictures":
        found = _pictures(path)
    elif known == "voc":
        found = _voc(path, [file for file in files if file.suffix == ".xml"], class_names)
    elif known == "kitti":
        found = _kitti(path, _texts(files), class_names)
    else:
        found = _yolo(path, _texts(files), tuple(class_names) or _names_of(path))
    if not found.pictures:
        raise EmptyResultError(f"{path}: no labelled image in it; expected labels of the run")
    return found


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(one for one in path.iterdir() if one.is_file())
    if not path.exists():
        raise AnnotationError(f"{path}: no such file or folder; expected labels of images")
    return [path]


def _texts(files: Sequence[Path]) -> list[Path]:
    return [one for one in files if one.suffix == ".txt" and one.name not in NAME_FILES]


def _recognised(path: Path, files: Sequence[Path]) -> LabelFormat:
    if path.is_file() and path.suffix == ".json":
        return "coco"
    if path.is_file() and path.suffix in _SEPARATORS:
        return "pictures"
    if path.is_dir() and any(one.suffix == ".xml" for one in files):
        return "voc"
    if path.is_dir() and _texts(files):
        for one in _texts(files):
            words = _lines(one)[:1]
            if words:
                return "yolo" if words[0].split()[0].replace(".", "").isdigit() else "kitti"
        return "yolo"
    raise AnnotationError(
        f"{path}: no labels of boxes; expected a COCO .json, a .csv of pictures, or a folder of "
        "YOLO .txt, Pascal VOC .xml or KITTI .txt files"
    )


def _coco(path: Path) -> BoxLabels:
    found = read_coco(path)
    return BoxLabels(found.where, found.labels, found.pictures)


def _voc(path: Path, files: Sequence[Path], class_names: Sequence[str]) -> BoxLabels:
    pictures = []
    for file in files:
        name, size, things = read_voc(file)
        boxes = tuple(Annotation(label, box, is_hard) for label, box, is_hard in things)
        pictures.append(Picture(name, size or NO_SIZE, things=boxes))
    classes = _classes(pictures, class_names)
    return BoxLabels(str(path), classes, tuple(pictures), format="voc")


def _kitti(path: Path, files: Sequence[Path], class_names: Sequence[str]) -> BoxLabels:
    pictures = []
    for file in files:
        boxes = []
        for number, line in enumerate(_lines(file), 1):
            words = line.split()
            where = f"{file}:{number}"
            if len(words) < _KITTI_COLUMNS:
                raise AnnotationError(
                    f"{where}: {len(words)} columns; expected KITTI's {_KITTI_COLUMNS}, the class "
                    "first; correct the line"
                )
            box, ahead_m = _numbers(words[4:8], where), _numbers(words[13:14], where)[0]
            is_any = words[0] == DONT_CARE
            boxes.append(
                Annotation(
                    "" if is_any else words[0],
                    (box[0], box[1], box[2], box[3]),
                    is_any,
                    range_m=ahead_m if ahead_m > 0.0 else None,
                )
            )
        pictures.append(Picture(file.name, NO_SIZE, things=tuple(boxes)))
    classes = _classes(pictures, class_names)
    return BoxLabels(str(path), classes, tuple(pictures), format="kitti")


def _pictures(path: Path) -> BoxLabels:
    rows = list(csv.reader(_lines(path), delimiter=_SEPARATORS.get(path.suffix, ",")))
    heading = [word.strip() for word in rows[0]] if rows else []
    if len(heading) < 2:
        raise AnnotationError(f"{path}: expected a heading: the column of pictures, then classes")
    pictures = []
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(heading):
            raise AnnotationError(
                f"{path}:{number}: {len(row)} columns, the heading has {len(heading)}; correct it"
            )
        shown = [_is_shown(word, f"{path}:{number}") for word in row[1:]]
        boxes = tuple(
            Annotation(name, (0.0, 0.0, 1.0, 1.0))
            for name, is_there in zip(heading[1:], shown, strict=True)
            if is_there
        )
        name = row[0].strip()
        pictures.append(Picture(name, NO_SIZE, things=boxes, is_in_fractions=True))
    return BoxLabels(str(path), tuple(heading[1:]), tuple(pictures), format="pictures")


def _is_shown(word: str, where: str) -> bool:
    plain = word.strip().lower()
    if plain not in (*_YES, *_NO):
        raise AnnotationError(f"{where}: {word!r}, expected yes or no; correct it")
    return plain in _YES


def _classes(pictures: Sequence[Picture], class_names: Sequence[str]) -> tuple[str, ...]:
    used = {thing.label for one in pictures for thing in one.things if thing.label}
    return (*class_names, *sorted(used.difference(class_names)))


def _yolo(path: Path, files: Sequence[Path], names: Sequence[str]) -> BoxLabels:
    pictures = []
    for file in files:
        boxes = []
        for number, line in enumerate(_lines(file), 1):
            words, where = line.split(), f"{file}:{number}"
            if len(words) != 5 or not words[0].isdecimal():
                raise AnnotationError(
                    f"{where}: expected a class number and x, y, width, height as fractions; "
                    "correct the line"
                )
            if int(words[0]) >= len(names):
                raise AnnotationError(
                    f"{where}: class {words[0]}, but {len(names)} class names from 0; correct one"
                )
            x, y, w, h = _numbers(words[1:], where)
            box = (x - 0.5 * w, y - 0.5 * h, x + 0.5 * w, y + 0.5 * h)
            boxes.append(Annotation(names[int(words[0])], box))
        pictures.append(Picture(file.name, NO_SIZE, things=tuple(boxes), is_in_fractions=True))
    return BoxLabels(str(path), tuple(names), tuple(pictures), format="yolo")


def _names_of(path: Path) -> tuple[str, ...]:
    for folder in (path, *path.parents[:2]):
        for name in NAME_FILES:
            file = folder / name
            if file.is_file():
                return _yaml_names(file) if file.suffix == ".yaml" else tuple(_lines(file))
    raise UsageError(
        f"{path}: YOLO labels without class names (no {', '.join(NAME_FILES)}); add classes.txt "
        "with one name per line to the folder, or use --class-names FILE if the command has it"
    )


def _yaml_names(file: Path) -> tuple[str, ...]:
    try:
        names = yaml_tree("\n".join(_lines(file, is_whole=True)))["names"]
        listed = [names[i] for i in range(len(names))]
    except (ValueError, KeyError, TypeError):
        raise AnnotationError(f"{file}: expected class names under names") from None
    return tuple(map(str, listed))


def _lines(file: Path, *, is_whole: bool = False) -> list[str]:
    """Read the lines that are not empty, stripped; or all lines unchanged."""
    text = read_text(file, MAX_TEXT_BYTES, AnnotationError, "expected labels as text")
    lines = text.splitlines()
    return lines if is_whole else [line.strip() for line in lines if line.strip()]


def _numbers(words: Sequence[str], where: str) -> list[float]:
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = [math.nan]
    if not all(map(math.isfinite, found)):
        raise AnnotationError(f"{where}: {' '.join(words)}: expected numbers; correct the line")
    return found
