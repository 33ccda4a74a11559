"""Write the labelled objects of a drive as a COCO file, with images by ``t_ns``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from crosscue.datasets.scenes.cues import MIN_PIXELS
from crosscue.datasets.scenes.rendering.render import RenderedFrame
from crosscue.datasets.scenes.world import CATEGORIES
from crosscue.detectors.rle import encode_mask
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text

# Category numbers and names, which are those of COCO if COCO has the class.
COCO_IDS: Final = {
    "car": (3, "car"), "traffic_light": (10, "traffic light"), "stop_sign": (13, "stop sign"),
    "one_way_left": (101, "one way left"), "one_way_right": (102, "one way right"),
    "do_not_enter": (103, "do not enter"),
}  # fmt: skip


@dataclass(slots=True)
class DriveAnnotations:
    """Annotations of a drive, picture by picture."""

    images: list[dict[str, Any]] = field(default_factory=list)
    annotations: list[dict[str, Any]] = field(default_factory=list)

    def add(
        self, t_ns: int, picture: RenderedFrame, tags: tuple[str, ...], distance_m: float
    ) -> None:
        """Add all objects of a picture that have enough pixels."""
        high, wide = picture.owner.shape
        number = len(self.images) + 1
        self.images.append(
            {
                "id": number,
                "t_ns": t_ns,
                "file_name": f"{t_ns}.jpg",
                "width": wide,
                "height": high,
                "tags": list(tags),
                "intersection_m": round(distance_m, 3),
            }
        )
        for seen in picture.seen:
            area = int(seen.mask.sum())
            if area < MIN_PIXELS:
                continue
            x0, y0, x1, y1 = seen.box_px
            counts = encode_mask(seen.mask, (x0, y0), (wide, high)).decode("ascii")
            self.annotations.append(
                {
                    "id": len(self.annotations) + 1,
                    "image_id": number,
                    "category_id": COCO_IDS[seen.thing.category][0],
                    "bbox": [x0, y0, x1 - x0, y1 - y0],
                    "area": area,
                    "iscrowd": 0,
                    "segmentation": {"size": [high, wide], "counts": counts},
                    "track_id": seen.thing.number,
                    "role": seen.thing.role,
                    "visible": round(seen.visible, 3),
                    "in_picture": round(seen.in_picture, 3),
                    "distance_m": round(seen.distance_m, 3),
                }
            )

    def save(self, path: Path, source: str) -> None:
        """Write the file.

        Raises:
            OutputError: It cannot be written.
        """
        categories = [{"id": COCO_IDS[c][0], "name": COCO_IDS[c][1]} for c in CATEGORIES]
        tree = {
            "info": {"description": source},
            "images": self.images,
            "annotations": self.annotations,
            "categories": categories,
        }
        write_text(path, strict_json(tree) + "\n")
