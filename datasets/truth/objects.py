"""Write the labelled objects of a data set as the COCO file of a truth file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text

OBJECTS_FILE: Final = "objects.json"

# COCO's category numbers; other labels are numbered from 200.
COCO_IDS: Final = {
    "person": 1,
    "bicycle": 2,
    "car": 3,
    "motorcycle": 4,
    "bus": 6,
    "train": 7,
    "truck": 8,
}


@dataclass(slots=True)
class Objects:
    """Collection of boxes in pictures, in the order of pictures."""

    images: list[dict[str, Any]] = field(default_factory=list)
    annotations: list[dict[str, Any]] = field(default_factory=list)
    labels: dict[str, int] = field(default_factory=dict)

    def add_picture(self, t_ns: int, file_name: str, size_px: tuple[int, int]) -> None:
        """Add a picture, to which the boxes added afterwards belong."""
        wide, high = size_px
        number = len(self.images) + 1
        row = {"id": number, "t_ns": t_ns, "file_name": file_name, "width": wide, "height": high}
        self.images.append(row)

    def add(self, label: str, box_px: tuple[float, float, float, float], **more: object) -> None:
        """Add a box, x0, y0, x1, y1, to the last picture, clipped to the picture.

        Args:
            label: Label, which is COCO's name if COCO has the class.
            box_px: Box, which is omitted if it is completely outside the picture.
            more: Further keys of its row.
        """
        image = self.images[-1]
        x0, x1 = (min(max(x, 0.0), image["width"]) for x in (box_px[0], box_px[2]))
        y0, y1 = (min(max(y, 0.0), image["height"]) for y in (box_px[1], box_px[3]))
        if x1 - x0 < 1.0 or y1 - y0 < 1.0:
            return
        number = self.labels.setdefault(label, COCO_IDS.get(label, 200 + len(self.labels)))
        self.annotations.append(
            {
                "id": len(self.annotations) + 1,
                "image_id": image["id"],
                "category_id": number,
                "bbox": [round(x0, 2), round(y0, 2), round(x1 - x0, 2), round(y1 - y0, 2)],
                "area": round((x1 - x0) * (y1 - y0), 1),
                "iscrowd": 0,
                **more,
            }
        )

    def save(self, folder: Path, source: str) -> str:
        """Write the file next to a truth file, and return its name.

        Raises:
            OutputError: It cannot be written.
        """
        tree: Mapping[str, object] = {
            "info": {"description": source},
            "images": self.images,
            "annotations": self.annotations,
            "categories": [{"id": number, "name": name} for name, number in self.labels.items()],
        }
        write_text(folder / OBJECTS_FILE, strict_json(tree) + "\n")
        return OBJECTS_FILE
