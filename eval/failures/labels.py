"""Export failing frames for a labelling tool."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import cv2

from crosscue.datasets.labels.table import LABEL_FORMATS, ToolFormat
from crosscue.datasets.truth.annotations import Annotation, Annotations, Picture
from crosscue.detectors.images import Encoded, check, decode
from crosscue.eval.failures.record import Failure, read_failures
from crosscue.eval.pipeline.run import moved_to
from crosscue.eval.runs import owned
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.runs.stored_images import pictures_at, run_camera
from crosscue.eval.runs.tables.stored_frames import stored_frames
from crosscue.eval.scoring.pooling import sum_counts
from crosscue.replay.errors import (
    CrosscueError,
    EmptyResultError,
    OutputError,
    UsageError,
)
from crosscue.replay.files.tree_text import spelled
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.limits import DEFAULT_LIMITS, Limits, LimitsGiven
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted, visible
from crosscue.results import Result
from crosscue.verb import Option

INDEX: Final = "crosscue_export.json"

# Encodings that every tool reads; others are converted to PNG, which is lossless.
ENDINGS: Final = {"jpeg": ".jpg", "png": ".png"}
NO_PICTURE: Final = "frames whose picture cannot be read"
OTHER: Final = "detections of labels that no cue is made of"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ExportedLabels(Result):
    """Pictures exported for a labelling tool; its text is the output of ``crosscue export``.

    Attributes:
        file: File or folder to import into the tool.
        format: Name of the format.
        pictures: Number of pictures.
        boxes: Number of detections in them, as pre-labels.
        labels: Classes to choose from.
        left_out: Numbers of frames that were not exported, by reason.
        failed: Errors of the runs that could not be read.
    """

    file: Path
    format: ToolFormat
    pictures: int
    boxes: int
    labels: tuple[str, ...]
    left_out: Mapping[str, int]
    failed: Mapping[str, CrosscueError]

    @property
    def exit_status(self) -> int:
        """3 when a run could not be read, else 0."""
        return 3 if self.failed else 0

    def lines(self) -> Iterator[str]:
        """Yield counts, classes, what was left out, and the file to import."""
        title = LABEL_FORMATS[self.format].title
        boxes = counted(self.boxes, "box", "boxes")
        yield f"pictures   {self.pictures:,} with {boxes} to correct, for {title}"
        yield f"classes    {visible(', '.join(self.labels))}"
        yield from (f"left out   {count:,} {visible(why)}" for why, count in self.left_out.items())
        yield from (f"left out   {visible(str(error))}" for error in self.failed.values())
        yield f"written to {visible(str(self.file))}"


def export(
    failures: Annotated[Path | str | Sequence[Failure], Option(metavar="FAILURES")],
    output: Path | str,
    to: ToolFormat = "coco",
    *,
    classes: Sequence[str] = (),
    logs: Annotated[Path | str | None, Option(metavar="DIR")] = None,
    limits: LimitsGiven = DEFAULT_LIMITS,
    overwrite: bool = False,
) -> ExportedLabels:
    """Export pictures of failures for a labelling tool.

    The detections in them are pre-labels: correct them before you use them as labels. FAILURES is a
    table from crosscue failures -o. Each frame is exported once, with its picture as recorded. File
    names contain drive and time, which crosscue truth import --export uses to find the frames
    again.

    Examples:
        crosscue failures runs --top 10 -o worst.parquet
        crosscue export worst.parquet --to cvat -o labelling

    Args:
        failures: Table of failures.
        output: Folder of the export.
        to: Format.
        classes: Labels to choose from (default: the labels that the runs' cues use).
        logs: Folder that the run's logs have moved to; they are recognised by content.
        limits: Limits for reading the logs.
        overwrite: Replace an earlier export.

    Raises:
        UsageError: The format is not supported.
        EmptyResultError: There is no picture to export; nothing is written.
        CrosscueError: No run could be read.
        UsageError: ``overwrite`` would delete files that an earlier call did not write.
        OutputError: The folder is not empty, or cannot be written.
    """
    if to not in LABEL_FORMATS:
        raise UsageError(f"to: {to}, expected one of {', '.join(LABEL_FORMATS)}")
    where, chosen = "failures", failures
    if isinstance(chosen, Path | str):
        where, chosen = str(chosen), read_failures(chosen)
    folder, kind = Path(output), LABEL_FORMATS[to]
    owned.check_place(folder, INDEX, overwrite=overwrite)
    moved = moved_to(logs)
    by_run: dict[str, set[int]] = {}
    for one in chosen:
        by_run.setdefault(one.run, set()).add(one.t_ns)
    runs: list[ExportedRun] = []
    failed: dict[str, CrosscueError] = {}
    with owned.new_folder(folder, INDEX) as made:
        (made / kind.pictures).mkdir(exist_ok=True)
        for done, (run, times) in enumerate(by_run.items(), 1):
            try:
                images = made / kind.pictures
                wanted = sorted(times), images, classes or None
                runs.append(export_run(Path(run), *wanted, moved, limits))
            except OutputError:
                raise
            except CrosscueError as error:
                failed[run] = error
            emit(Progress("exporting", done, len(by_run), "runs"))
        found = _together(where, runs)
        if not found.pictures:
            if failed:
                raise next(iter(failed.values()))
            why = "no frame has a picture" if by_run else "the table has no failure"
            raise EmptyResultError(f"{where}: no picture to export: {why}")
        file = kind.write(made, found)
        index = [one.as_index(folder) for one in runs if one.pictures]
        owned.write_marker(made / INDEX, {"format": 1, "to": to, "drives": index})
    left_out = sum_counts(part.left_out for part in runs)
    boxes = sum(len(one.things) for one in found.pictures)
    return ExportedLabels(
        folder / file.name, to, len(found.pictures), boxes, found.labels, left_out, failed
    )


def _together(where: str, runs: Sequence[ExportedRun]) -> Annotations:
    """Join the pictures of all runs.

    Raises:
        UsageError: Two runs of the same name have a frame in common.
    """
    names = [one.name for run in runs for one in run.pictures]
    twice = sorted({name for name in names if names.count(name) > 1}) if len(runs) > 1 else []
    if twice:
        raise UsageError(f"{where}: two runs would write {twice[0]}; export them one by one")
    labels = dict.fromkeys(label for run in runs for label in run.labels)
    return Annotations(where, tuple(labels), tuple(one for run in runs for one in run.pictures))


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
    pixels, size = decode(picture)
    _, content = cv2.imencode(".png", pixels)
    return content.tobytes(), ".png", size
