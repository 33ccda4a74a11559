"""Read and write Label Studio tasks: ``tasks.json`` with predictions, and the interface."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from crosscue.datasets.truth.annotations import Annotation, Annotations, Picture
from crosscue.replay.errors import AnnotationError
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import write_text

FILE = "tasks.json"
CONFIG = "interface.xml"
LOCAL = "/data/local-files/?d="
UNLABELLED = "tasks without an annotation"


def write_label_studio(folder: Path, labels: Annotations) -> Path:
    """Write tasks with boxes as predictions, and the labelling interface to paste into a project.

    Raises:
        OutputError: A file cannot be written.
    """
    tasks = []
    for picture in labels.pictures:
        wide, high = picture.size_px
        results = []
        for number, thing in enumerate(picture.things):
            if thing.box_px is not None:
                x0, y0, x1, y1 = thing.box_px
                results.append(
                    {
                        "id": f"{picture.t_ns}-{number}",
                        "from_name": "label",
                        "to_name": "image",
                        "type": "rectanglelabels",
                        "original_width": wide,
                        "original_height": high,
                        "image_rotation": 0,
                        "value": {
                            "x": 100.0 * x0 / wide,
                            "y": 100.0 * y0 / high,
                            "width": 100.0 * (x1 - x0) / wide,
                            "height": 100.0 * (y1 - y0) / high,
                            "rotation": 0,
                            "rectanglelabels": [thing.label],
                        },
                    }
                    | ({} if thing.score is None else {"score": thing.score})
                )
        size = {"width": wide, "height": high, "t_ns": picture.t_ns}
        data = {"image": f"{LOCAL}images/{picture.name}", **size}
        predictions = [{"model_version": "crosscue", "result": results}]
        tasks.append({"data": data, "predictions": predictions})
    write_text(folder / FILE, strict_json(tasks) + "\n")
    names = "".join(f"<Label value={quoteattr(name)}/>" for name in labels.labels)
    boxes = f'<RectangleLabels name="label" toName="image">{names}</RectangleLabels>'
    write_text(folder / CONFIG, f'<View><Image name="image" value="$image"/>\n{boxes}\n</View>\n')
    return folder / FILE


def read_label_studio(path: Path) -> Annotations:
    """Read a JSON export of Label Studio; unconfirmed predictions are not labels.

    Raises:
        AnnotationError: The file cannot be read.
    """
    file = path / FILE if path.is_dir() else path
    try:
        tasks = json_tree(file.read_bytes())
    except (OSError, ValueError) as error:
        raise AnnotationError(f"{file}: not readable as JSON ({error})") from None
    if not isinstance(tasks, list) or not all(isinstance(task, dict) for task in tasks):
        raise AnnotationError(f"{file}: expected a list of tasks, as Label Studio exports JSON")
    pictures: list[Picture] = []
    ignored: dict[str, int] = {}
    for number, task in enumerate(tasks):
        picture = _picture(task, f"{file}: task {task.get('id', number)}", ignored)
        if picture is not None:
            pictures.append(picture)
    used = dict.fromkeys(thing.label for one in pictures for thing in one.things)
    return Annotations(str(file), tuple(sorted(used)), tuple(pictures), ignored)


def _picture(task: Mapping[str, Any], where: str, ignored: dict[str, int]) -> Picture | None:
    done = task.get("annotations")
    kept = [
        one
        for one in (done if isinstance(done, list) else [])
        if isinstance(one, dict) and not one.get("was_cancelled")
    ]
    if not kept:
        ignored[UNLABELLED] = ignored.get(UNLABELLED, 0) + 1
        return None
    try:
        data, results = task["data"], kept[-1]["result"]
        name = str(data["image"]).replace("\\", "/").rpartition("/")[2].rpartition("=")[2]
        t_ns = data.get("t_ns")
        sizes = [(row["original_width"], row["original_height"]) for row in _boxes(results)]
        size = sizes[0] if sizes else (data.get("width", 0), data.get("height", 0))
        wide, high = int(size[0]), int(size[1])
        things = tuple(_thing(row, (wide, high), where) for row in _boxes(results))
    except (KeyError, TypeError, ValueError, IndexError):
        raise AnnotationError(
            f"{where}: expected data.image and rectangles with original_width, x, y, width, height"
        ) from None
    for row in results:
        if row not in list(_boxes(results)):
            kind = str(row.get("type", "something"))
            ignored[kind] = ignored.get(kind, 0) + 1
    return Picture(name, (wide, high), int(t_ns) if t_ns is not None else None, None, things)


def _boxes(results: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    for row in results:
        if row.get("type") == "rectanglelabels" and not row["value"].get("rotation"):
            yield row


def _thing(row: Mapping[str, Any], size: tuple[int, int], where: str) -> Annotation:
    value = row["value"]
    x, y, w, h = (float(value[name]) / 100.0 for name in ("x", "y", "width", "height"))
    box = (x * size[0], y * size[1], (x + w) * size[0], (y + h) * size[1])
    return Annotation(str(value["rectanglelabels"][0]), box, place=where)
