"""Table of the formats of labelling tools, and detection of a file's format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, TypeAlias

from crosscue.datasets.truth.annotations import Annotations, Sizes
from crosscue.datasets.truth.coco import read_coco, write_coco
from crosscue.datasets.truth.cvat import read_cvat, write_cvat
from crosscue.replay.errors import AnnotationError, UsageError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.tree_text import json_tree

from .fiftyone import FILE as FIFTYONE
from .fiftyone import read_fiftyone, write_fiftyone
from .label_studio import read_label_studio, write_label_studio
from .yolo import read_yolo, write_yolo

MAX_BYTES: Final = 512 << 20


@dataclass(frozen=True, slots=True)
class LabelFormat:
    """Format of a labelling tool.

    Attributes:
        write: Writes labels to a folder with pictures; returns the file to import into the tool.
        read: Reads a file or folder exported by the tool; boxes in fractions require sizes.
        pictures: Folder of the pictures.
        title: Name for display.
    """

    write: Callable[[Path, Annotations], Path]
    read: Callable[[Path, Sizes], Annotations]
    pictures: str
    title: str


ToolFormat: TypeAlias = Literal["coco", "cvat", "yolo", "fiftyone", "labelstudio"]
LABEL_FORMATS: Final[dict[ToolFormat, LabelFormat]] = {
    "coco": LabelFormat(write_coco, lambda path, _: read_coco(path), "images", "COCO"),
    "cvat": LabelFormat(write_cvat, lambda path, _: read_cvat(path), "images", "CVAT 1.1"),
    "yolo": LabelFormat(write_yolo, read_yolo, "images", "YOLO"),
    "fiftyone": LabelFormat(write_fiftyone, read_fiftyone, "data", "FiftyOne"),
    "labelstudio": LabelFormat(
        write_label_studio, lambda path, _: read_label_studio(path), "images", "Label Studio"
    ),
}


def read_tool_labels(path: Path, sizes: Sizes, kind: ToolFormat | None = None) -> Annotations:
    """Read the export of a labelling tool.

    Args:
        path: File or folder of the export.
        sizes: Sizes of pictures by name without suffix; ``*`` for all others.
        kind: One of ``LABEL_FORMATS``; detected by default.

    Raises:
        UsageError: The format is unknown, or cannot be detected.
        AnnotationError: The export cannot be read.
    """
    if kind is not None and kind not in LABEL_FORMATS:
        raise UsageError(f"kind: {kind}, expected one of {', '.join(LABEL_FORMATS)}")
    return LABEL_FORMATS[kind or _recognised(path)].read(path, sizes)


def _recognised(path: Path) -> ToolFormat:
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
        raise AnnotationError(f"{path}: not readable as JSON ({error}); expected labels") from None
    if isinstance(tree, list):
        return "labelstudio"
    return "fiftyone" if isinstance(tree, dict) and "labels" in tree else "coco"
