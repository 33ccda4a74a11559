"""Export of failing frames for labelling: recorded pictures and their detections."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from crosscue.datasets.truth.annotations import Annotation, Picture
from crosscue.detectors.images import Encoded, check, decode
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.runs.stored_images import pictures_at, run_camera
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.replay.files.tree_text import spelled
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.limits import DEFAULT_LIMITS, Limits

# Encodings that every tool reads; others are converted to PNG, which is lossless.
ENDINGS: Final = {"jpeg": ".jpg", "png": ".png"}
NO_PICTURE: Final = "frames whose picture cannot be read"
OTHER: Final = "detections of labels that no cue is made of"


@dataclass(slots=True)
class ExportedRun:
    """Exported frames of one run.

    Attributes:
        name: Name of the run folder.
        log: Path or URL of the log with the pictures.
        labels: Available labels with the cue that each counts as; empty for objects such as cars.
        pictures: Pictures with detections as pre-labels, named after their files.
        left_out: Numbers of frames and detections not exported, by reason.
    """

    name: str
    log: Path | str = ""
    labels: Mapping[str, str] = field(default_factory=dict)
    pictures: list[Picture] = field(default_factory=list)
    left_out: dict[str, int] = field(default_factory=dict)

    def as_index(self, folder: Path) -> dict[str, Any]:
        """Return the run's entry in ``crosscue_export.json``."""
        log = str(self.log)
        if isinstance(self.log, Path):
            log = spelled(os.path.relpath(self.log.resolve(), folder.resolve()))
        pictures = {
            one.name: {"t_ns": one.t_ns, "width": one.size_px[0], "height": one.size_px[1]}
            for one in self.pictures
        }
        return {
            "drive": self.name,
            "log": log,
            "labels": dict(self.labels),
            "pictures": pictures,
        }


def export_run(
    path: Path,
    times: Sequence[int],
    images: Path,
    classes: Sequence[str] | None,
    logs: Path | None = None,
    limits: Limits = DEFAULT_LIMITS,
) -> ExportedRun:
    """Write the pictures of some frames and collect their detections.

    Args:
        path: The run.
        times: Times of the frames, as in the run's tables.
        images: Folder for the pictures.
        classes: Labels to keep; None for those that the run's cues use.
        logs: Folder to which the logs have moved, if any.
        limits: Limits on the declared size of a chunk of a log.

    Raises:
        RunError: The run or its log cannot be read.
        OutputError: A picture cannot be written.
    """
    run = open_run(path, logs, limits=limits)
    vehicle = run.drive_manifest().settings
    # A car is an object; only its orientation or motion is a cue.
    known = {
        label: "" if label in vehicle.cars.labels else cue
        for cue, labels in vehicle.cue_labels().items()
        for label in labels
    }
    wanted = {label: known.get(label, "") for label in classes or known}
    found = ExportedRun(path.resolve().name, labels=wanted)
    camera = run_camera(run)
    if camera is None:
        found.left_out[NO_PICTURE] = len(times)
        return found
    found.log = camera.log
    things, log_ns = _things(run, frozenset(times), found), _log_times(run)
    written: dict[int, Picture] = {}

    def on_picture(t_ns: int, picture: Encoded) -> None:
        content, ending, size = _content(picture)
        # Truth and labels use log time.
        at_ns = log_ns.get(t_ns, t_ns)
        name = f"{found.name}_{at_ns}ns{ending}"
        write_bytes(images / name, content)
        written[t_ns] = Picture(name, size, at_ns, None, things.get(t_ns, ()))

    pictures_at(camera, times, on_picture)
    found.pictures = [written[t_ns] for t_ns in sorted(written)]
    if len(written) < len(times):
        found.left_out[NO_PICTURE] = len(times) - len(written)
    return found


def _things(
    run: RunFolder, times: frozenset[int], found: ExportedRun
) -> Mapping[int, tuple[Annotation, ...]]:
    """Return the detections above their detector's threshold, by time."""
    manifest = run.drive_manifest()
    detected = manifest.detected
    things: dict[int, tuple[Annotation, ...]] = {}
    for frame in () if detected is None else stored_frames(run, detected, manifest.settings):
        if frame.t_ns not in times:
            continue
        kept = []
        for one in (*frame.objects, *frame.signs):
            for box, score, label in zip(one.boxes_px, one.scores, one.labels, strict=True):
                if label not in found.labels:
                    found.left_out[OTHER] = found.left_out.get(OTHER, 0) + 1
                    continue
                x0, y0, x1, y1 = _inside(box.tolist(), frame.size_px)
                if x0 < x1 and y0 < y1:
                    kept.append(Annotation(label, (x0, y0, x1, y1), score=round(float(score), 4)))
        things[frame.t_ns] = tuple(kept)
    return things


def _inside(box: Sequence[float], size_px: tuple[int, int]) -> list[float]:
    """Return a box clipped to the picture, because labelling tools refuse other boxes."""
    return [min(max(side, 0.0), float(size_px[k % 2])) for k, side in enumerate(box)]


def _log_times(run: RunFolder) -> Mapping[int, int]:
    table = run.table("frames", ["t_ns", "log_t_ns"])
    return dict(zip(table["t_ns"].to_pylist(), table["log_t_ns"].to_pylist(), strict=True))


def _content(picture: Encoded) -> tuple[bytes, str, tuple[int, int]]:
    """Return a picture's file content, file ending and size in pixels."""
    if picture.coding in ENDINGS:
        return bytes(picture.content), ENDINGS[picture.coding], check(picture)
    import cv2

    pixels, size = decode(picture)
    _, content = cv2.imencode(".png", pixels)
    return content.tobytes(), ".png", size
