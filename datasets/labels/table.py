"""The table of formats for labelling tools, and which of them a file is in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.datasets.truth.annotations import Annotations, Sizes
from crosscue.datasets.truth.coco import read_coco, write_coco
from crosscue.datasets.truth.cvat import read_cvat, write_cvat
from crosscue.replay.base import AnnotationError, UsageError, json_tree, read_at_most

from .fiftyone import FILE as FIFTYONE
from .fiftyone import read_fiftyone, write_fiftyone
from .label_studio import read_label_studio, write_label_studio
from .yolo import read_yolo, write_yolo

MAX_BYTES: Final = 512 << 20


@dataclass(frozen=True, slots=True)
class LabelFormat:
    """One format.

    Attributes:
        write: Into a folder, beside the pictures; returns the file to give to the tool.
        read: A file or folder that the tool exported; sizes are needed where boxes are fractions.
        pictures: Folder of the pictures.
        title: For people.
    """

    write: Callable[[Path, Annotations], Path]
    read: Callable[[Path, Sizes], Annotations]
    pictures: str
    title: str


LABEL_FORMATS: Final[dict[str, LabelFormat]] = {
    "coco": LabelFormat(write_coco, lambda path, _: read_coco(path), "images", "COCO"),
    "cvat": LabelFormat(write_cvat, lambda path, _: read_cvat(path), "images", "CVAT 1.1"),
    "yolo": LabelFormat(write_yolo, read_yolo, "images", "YOLO"),
    "fiftyone": LabelFormat(write_fiftyone, read_fiftyone, "data", "FiftyOne"),
    "labelstudio": LabelFormat(
        write_label_studio, lambda path, _: read_label_studio(path), "images", "Label Studio"
    ),
}


def read_labels(path: Path, sizes: Sizes, kind: str | None = None) -> Annotations:
    """Read what a labelling tool exported.

    Args:
        path: Its file or folder.
        sizes: Of pictures by name without ending; ``*`` for all others.
        kind: One of ``LABEL_FORMATS``; recognised if left out.

    Raises:
        UsageError: Another kind, or none of them.
        AnnotationError: It cannot be read.
    """
    if kind is not None and kind not in LABEL_FORMATS:
        raise UsageError(f"--format {kind}: expected one of {', '.join(LABEL_FORMATS)}")
    return LABEL_FORMATS[kind or _recognised(path)].read(path, sizes)


def _recognised(path: Path) -> str:
    suffix = path.suffix.lower()
    if path.is_dir():
        return "fiftyone" if (path / FIFTYONE).is_file() else "yolo"
    if suffix in (".xml", ".yaml"):
        return "cvat" if suffix == ".xml" else "yolo"
    if suffix != ".json":
        raise UsageError(
            f"{path}: expected COCO, FiftyOne or Label Studio (.json), CVAT (.xml), or a folder"
        )
    try:
        content = read_at_most(path, MAX_BYTES)
        tree = None if content is None else json_tree(content)
    except (OSError, ValueError) as error:
        raise AnnotationError(f"{path}: not readable as JSON ({error}); give labels") from None
    if isinstance(tree, list):
        return "labelstudio"
    return "fiftyone" if isinstance(tree, dict) and "labels" in tree else "coco"
