"""Read and validate COCO annotations; unusable ones are counted by reason.

Masks are compressed run lengths, plain run lengths or polygons. An annotation may also have only a
box. It is left out if its class is not selected, its picture is not listed, its box has no area
within the picture, or its mask is not of the picture's size. A box that exceeds the picture is
clipped.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias, TypeGuard

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import AnnotationError, SchemaError
from crosscue.replay.files.bounded import read_whole
from crosscue.replay.files.tree_text import json_tree

# Maximum size of an annotation file.
MAX_BYTES: Final = 2 << 30
MAX_SIDE_PX: Final = 32768

# x0, y0, x1, y1.
Box: TypeAlias = tuple[float, float, float, float]
# Compressed runs, or polygons as consecutive (x, y) pairs.
Mask: TypeAlias = bytes | tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True)
class TrainingObject:
    """One annotated object.

    Attributes:
        label: Index into the classes.
        box_px: x0, y0, x1, y1 within the picture.
        mask: Compressed runs, or polygons as consecutive (x, y) pairs; None where only the box is
            known.
        is_crowd: True for a group of objects, which is ignored: it need not be found, and
            detections of it are not wrong.
    """

    label: int
    box_px: Box
    mask: Mask | None
    is_crowd: bool


@dataclass(frozen=True, slots=True)
class LabelledPicture:
    """One annotated picture.

    Attributes:
        path: File of the picture.
        size_px: Width and height as annotated.
        objects: All objects of the selected classes.
        decoys_px: Boxes of objects of other classes, which may resemble the selected ones.
    """

    path: Path
    size_px: tuple[int, int]
    objects: tuple[TrainingObject, ...]
    decoys_px: tuple[Box, ...] = ()


@dataclass(frozen=True, slots=True)
class LabelledSet:
    """A set of annotated pictures, for training or measurement.

    Attributes:
        source: The annotation file.
        classes: Class names, in the order of ``TrainingObject.label``.
        pictures: Pictures, in the order of the file.
        left_out: Number of annotations and pictures that were left out or repaired, by reason.
    """

    source: Path
    classes: tuple[str, ...]
    pictures: tuple[LabelledPicture, ...]
    left_out: Mapping[str, int]

    @property
    def objects(self) -> int:
        """Number of objects in all pictures."""
        return sum(len(picture.objects) for picture in self.pictures)

    @property
    def masks(self) -> int:
        """Number of objects with a mask."""
        return sum(one.mask is not None for picture in self.pictures for one in picture.objects)


def read_training_coco(path: Path, folder: Path, classes: Sequence[str]) -> LabelledSet:
    """Read a COCO file.

    Args:
        path: The file.
        folder: Folder of its pictures.
        classes: Names of the selected classes; a label is an index into them.

    Raises:
        AnnotationError: The file is not a COCO file, or the folder does not exist.
        SchemaError: All pictures are missing, or no annotation is of the selected classes.
    """
    tree = coco_tree(path)
    if not folder.is_dir():
        raise AnnotationError(
            f"{folder}: not a folder; expected the folder with the images of {path.name}"
        )
    left_out: Counter[str] = Counter()
    names = {row["id"]: row["name"] for row in coco_rows(tree, "categories", path) if "id" in row}
    if not set(classes) & set(names.values()):
        has = ", ".join(sorted(str(name) for name in names.values())[:20])
        raise SchemaError(f"{path}: no class of {', '.join(classes)}; it has: {has or 'none'}")
    pictures = _pictures(coco_rows(tree, "images", path), folder, left_out)
    if not pictures:
        raise SchemaError(
            f"{path}: none of its pictures is in {folder}; name the folder of its images"
        )
    numbers = {name: i for i, name in enumerate(classes)}
    objects: dict[Any, list[TrainingObject]] = {key: [] for key in pictures}
    decoys: dict[Any, list[Box]] = {key: [] for key in pictures}
    for row in coco_rows(tree, "annotations", path):
        found = _labelled(row, pictures, names, numbers, left_out)
        if isinstance(found, TrainingObject):
            objects[row["image_id"]].append(found)
        elif found is not None:
            decoys[row["image_id"]].append(found)
    if not any(objects.values()):
        raise SchemaError(f"{path}: no usable annotation of {', '.join(classes)}{_why(left_out)}")
    whole = tuple(
        LabelledPicture(picture, size, tuple(objects[key]), tuple(decoys[key]))
        for key, (picture, size) in pictures.items()
    )
    return LabelledSet(path, tuple(classes), whole, dict(left_out))


def _why(left_out: Counter[str]) -> str:
    reported = ", ".join(f"{count} {reason}" for reason, count in left_out.most_common(3))
    return f"; left out: {reported}" if reported else ""


def coco_tree(path: Path, max_bytes: int = MAX_BYTES) -> Mapping[str, Any]:
    """Read the tree of a COCO file.

    Raises:
        AnnotationError: The file does not exist, is too large, or has another content.
    """
    try:
        content = read_whole(path, max_bytes)
        tree = json_tree(content)
    except OSError as error:
        raise AnnotationError(f"{path}: {error.strerror}; expected a COCO file") from None
    except ValueError as error:
        raise AnnotationError(f"{path}: not JSON ({error}); expected a COCO file") from None
    if not isinstance(tree, dict):
        raise AnnotationError(f"{path}: expected a COCO file: images, annotations and categories")
    return tree


def coco_rows(tree: Mapping[str, Any], key: str, path: Path) -> list[dict[str, Any]]:
    """Return the rows of a list of a COCO file.

    Raises:
        AnnotationError: It is not a list of objects.
    """
    rows = tree.get(key)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise AnnotationError(f"{path}: {key}: expected a list of objects, as COCO files have")
    return rows


def _pictures(
    rows: list[dict[str, Any]], folder: Path, left_out: Counter[str]
) -> dict[Any, tuple[Path, tuple[int, int]]]:
    found: dict[Any, tuple[Path, tuple[int, int]]] = {}
    for row in rows:
        name, width, height = row.get("file_name"), row.get("width"), row.get("height")
        sides = [side for side in (width, height) if type(side) is int and 0 < side <= MAX_SIDE_PX]
        if not isinstance(name, str) or len(sides) != 2 or not isinstance(row.get("id"), int | str):
            left_out["pictures without a name or size"] += 1
        elif Path(name).is_absolute() or ".." in Path(name).parts or "\0" in name:
            left_out["pictures outside the folder"] += 1
        elif not (folder / name).is_file():
            left_out["pictures not there"] += 1
        else:
            found[row["id"]] = (folder / name, (sides[0], sides[1]))
    return found


def _labelled(
    row: Mapping[str, Any],
    pictures: Mapping[Any, tuple[Path, tuple[int, int]]],
    names: Mapping[Any, Any],
    numbers: Mapping[str, int],
    left_out: Counter[str],
) -> TrainingObject | Box | None:
    """Return the object, or only its box if its class is not selected; None if it is unusable."""
    picture, category = row.get("image_id"), row.get("category_id")
    if not isinstance(picture, int | str) or picture not in pictures:
        left_out["annotations of other pictures"] += 1
        return None
    if not isinstance(category, int | str) or category not in names:
        left_out["annotations of unknown classes"] += 1
        return None
    size = pictures[picture][1]
    if names[category] not in numbers:
        left_out["annotations of other classes"] += 1
        return _box(row.get("bbox"), size, Counter())
    box = _box(row.get("bbox"), size, left_out)
    if box is None:
        return None
    segmentation = row.get("segmentation")
    mask = _mask(segmentation, size)
    if segmentation and mask is None:
        left_out["annotations without a mask of the picture's size"] += 1
        return None
    return TrainingObject(numbers[names[category]], box, mask, bool(row.get("iscrowd", 0)))


def _box(given: object, size: tuple[int, int], left_out: Counter[str]) -> Box | None:
    if not _is_numbers(given) or len(given) != 4:
        left_out["annotations without a box"] += 1
        return None
    x, y, width, height = given
    x0, y0 = max(x, 0.0), max(y, 0.0)
    x1, y1 = min(x + width, float(size[0])), min(y + height, float(size[1]))
    if x1 - x0 < 1.0 or y1 - y0 < 1.0:
        left_out["boxes outside the picture, or empty"] += 1
        return None
    if (x0, y0, x1, y1) != (x, y, x + width, y + height):
        left_out["boxes cut off at the picture's edge"] += 1
    return x0, y0, x1, y1


def _is_numbers(given: object) -> TypeGuard[list[float]]:
    return isinstance(given, list) and all(
        isinstance(one, int | float) and math.isfinite(one) for one in given
    )


def _mask(given: Any, size: tuple[int, int]) -> Mask | None:
    if isinstance(given, list) and given:
        is_polygons = all(_is_numbers(one) and len(one) >= 6 and len(one) % 2 == 0 for one in given)
        return tuple(tuple(float(v) for v in one) for one in given) if is_polygons else None
    if not isinstance(given, dict) or given.get("size") != [size[1], size[0]]:
        return None
    counts = given.get("counts")
    try:
        if isinstance(counts, list):
            return _from_lengths(np.array(counts, np.int64), size)
        text = str(counts).encode("ascii")
        rle.column_heights_px(text, size)
    except (ValueError, TypeError, OverflowError):
        return None
    return text


def _from_lengths(lengths: Int64s, size: tuple[int, int]) -> bytes:
    if lengths.min(initial=0) < 0 or int(lengths.sum()) != size[0] * size[1]:
        raise ValueError("run lengths do not fill the picture")
    flat = np.repeat(np.arange(len(lengths)) % 2 == 1, lengths)
    return rle.encode_mask(flat.reshape(size).T, (0, 0), size)


def mask_of(labelled: TrainingObject, size_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Rasterise an object's mask, shape (height, width); its box where it has no mask."""
    import cv2

    if labelled.mask is None:
        inside = np.zeros((size_px[1], size_px[0]), np.bool_)
        x0, y0, x1, y1 = (round(value) for value in labelled.box_px)
        inside[y0:y1, x0:x1] = True
        return inside
    if isinstance(labelled.mask, bytes):
        return rle.decode_mask(labelled.mask, size_px)
    canvas = np.zeros((size_px[1], size_px[0]), np.uint8)
    for polygon in labelled.mask:
        # Integer coordinates are pixel edges in COCO and pixel centres in OpenCV; 4 fraction bits.
        corners = np.clip(np.array(polygon).reshape(-1, 2) - 0.5, -(2.0**20), 2.0**20)
        cv2.fillPoly(canvas, [np.rint(corners * 16).astype(np.int32)], (1,), shift=4)
    return canvas.astype(np.bool_)
