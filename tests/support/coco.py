"""COCO annotations of pictures, with a stop sign in each."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from crosscue.datasets.truth.truth import Truth, save
from crosscue.datasets.truth.tum import planar, write_tum
from crosscue.replay.columns import Floats


def stop_signs(images: Iterable[tuple[str, int]], size: tuple[int, int]) -> str:
    """Return annotations of pictures of a size, given by their file names and times."""
    (width, height), pictures = size, list(images)
    x, y = width // 8, height // 8
    box = [x, y, 4 * x, 4 * y]
    outline = [x, y, 5 * x, y, 5 * x, 5 * y, x, 5 * y]
    tree = {
        "categories": [{"id": 1, "name": "stop sign"}],
        "images": [
            {"id": k, "file_name": name, "width": width, "height": height, "t_ns": t_ns}
            for k, (name, t_ns) in enumerate(pictures)
        ],
        "annotations": [
            {"id": k, "image_id": k, "category_id": 1, "bbox": box, "segmentation": [outline]}
            for k in range(len(pictures))
        ],
    }
    return json.dumps(tree)


def annotate(drive: Path, start_ns: int) -> None:
    """Write boxes and poses of four pictures of 24 x 16 pixels, a tenth of a second apart."""
    t_ns = start_ns + np.arange(4) * 100_000_000
    times = t_ns.tolist()
    (drive / "objects.json").write_text(stop_signs([(f"{t}.png", t) for t in times], (24, 16)))
    save(
        Truth(version=1, source="x", start_ns=times[0], end_ns=times[-1] + 1, pose="pose.tum"),
        drive,
    )
    zero: Floats = np.zeros(4)
    write_tum(drive / "pose.tum", planar(t_ns, 100.0 * np.arange(4.0), zero, zero), "made up")
