"""Export failing frames for a labelling tool, and import the corrected labels."""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal

from crosscue.datasets.labels.table import LABEL_FORMATS, read_tool_labels
from crosscue.datasets.truth.annotations import Annotations, Picture, cues_by_label
from crosscue.datasets.truth.coco import WRITTEN, write_coco
from crosscue.eval.failures.export import ExportedRun, export_run
from crosscue.eval.failures.record import Failure, read_failures
from crosscue.eval.fit.truth_check import FILE, ImportedTruth, import_part
from crosscue.eval.pipeline.run import moved_to
from crosscue.eval.runs import owned
from crosscue.replay.errors import (
    AnnotationError,
    CrosscueError,
    EmptyResultError,
    OutputError,
    SchemaError,
    UsageError,
)
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, unspelled
from crosscue.replay.files.whole_file import cannot_write
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import visible
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import Result
from crosscue.verb import Option

INDEX: Final = "crosscue_export.json"


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
    format: str
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
        yield f"pictures   {self.pictures:,} with {self.boxes:,} boxes to correct, for {title}"
        yield f"classes    {visible(', '.join(self.labels))}"
        yield from (f"left out   {count:,} {visible(why)}" for why, count in self.left_out.items())
        yield from (f"left out   {visible(str(error))}" for error in self.failed.values())
        yield f"written to {visible(str(self.file))}"


def export(
    failures: Annotated[Path | str | Sequence[Failure], Option(metavar="FAILURES")],
    output: Path | str,
    to: Literal["coco", "cvat", "yolo", "fiftyone", "labelstudio"] = "coco",
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
    given = isinstance(failures, Path | str)
    chosen = read_failures(Path(failures)) if isinstance(failures, Path | str) else failures
    where = str(failures) if given else "failures"
    folder, kind = Path(output), LABEL_FORMATS[to]
    _check_place(folder, overwrite)
    moved = moved_to(logs)
    made = folder.with_name(f".{folder.name}.partial")
    by_run: dict[str, set[int]] = {}
    for one in chosen:
        by_run.setdefault(one.run, set()).add(one.t_ns)
    runs: list[ExportedRun] = []
    failed: dict[str, CrosscueError] = {}
    try:
        shutil.rmtree(made, ignore_errors=True)
        (made / kind.pictures).mkdir(parents=True)
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
        owned.replace_folder(made, folder, owned.of_list(folder / INDEX))
    except OSError as error:
        raise cannot_write(Path(error.filename or folder), error) from None
    finally:
        shutil.rmtree(made, ignore_errors=True)
    left_out: dict[str, int] = {}
    for part in runs:
        for why, count in part.left_out.items():
            left_out[why] = left_out.get(why, 0) + count
    boxes = sum(len(one.things) for one in found.pictures)
    return ExportedLabels(
        folder / file.name, to, len(found.pictures), boxes, found.labels, left_out, failed
    )


def _check_place(folder: Path, overwrite: bool) -> None:
    there = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    if there and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; give another folder")
    if there and not overwrite:
        raise OutputError(f"{folder}: holds files already; give another folder or --overwrite")
    if there:
        owned.refuse_others(folder, owned.of_list(folder / INDEX))


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


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ImportedLabels(Result):
    """Corrected labels by drive; its text is the output of ``crosscue truth import --export``.

    Attributes:
        coco: COCO file with all pictures, for training and fitting.
        images: Folder of the exported pictures.
        drives: Imported truth by name of the drive.
        missing: Number of exported pictures that the annotations lack.
        ignored: Numbers of shapes and tasks that were not imported, by kind.
    """

    coco: Path
    images: Path
    drives: Mapping[str, ImportedTruth]
    missing: int
    ignored: Mapping[str, int]

    def lines(self) -> Iterator[str]:
        """Yield counts, what is missing or ignored, and the files that were written."""
        pictures = sum(one.pictures for one in self.drives.values())
        things = sum(one.things for one in self.drives.values())
        yield f"pictures   {pictures:,} with {things:,} objects, of {len(self.drives):,} drives"
        if self.missing:
            yield f"missing    {self.missing:,} exported pictures are not in the annotations"
        yield from (f"ignored    {count:,} {visible(kind)}" for kind, count in self.ignored.items())
        yield from (f"truth      {visible(str(one.truth))}" for one in self.drives.values())
        yield f"to train   --data {visible(str(self.coco))} --images {self.images}"

    def as_dict(self) -> dict[str, object]:
        """Return the files, the truth of each drive, and what was not imported."""
        drives = {name: one.as_dict() for name, one in self.drives.items()}
        return {**Result.as_dict(self), "drives": drives}


def import_labels(
    annotations: Path | str,
    exported: Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    *,
    labels: Mapping[str, str] = MappingProxyType({}),
    add: bool = False,
    overwrite: bool = False,
    kind: str | None = None,
    limits: LimitsGiven = DEFAULT_LIMITS,
) -> ImportedLabels:
    """Import corrected labels of an export: truth and objects of each drive, and one COCO file.

    Args:
        annotations: Annotations from the labelling tool, in any of the formats of ``export``.
        exported: Folder that ``export`` wrote, with an index of the time of each picture.
        output: Output folder, with one folder per drive, and ``coco.json``.
        vehicle: Vehicle file that defines your own cues.
        labels: Cue by label; an empty cue ignores the label.
        add: Replace only the cues and objects of existing truth files.
        overwrite: Replace existing truth files.
        kind: Format of the annotations; default: detected.
        limits: Limits for reading the logs.

    Raises:
        SchemaError: The labels or the export cannot be read, or a picture was not exported, has
            another size, or occurs twice.
        OutputError: A truth file exists, or cannot be written.
    """
    source, folder, target = Path(annotations), Path(exported), Path(output)
    drives = _read_index(folder)
    known = {
        Path(name).stem: (name, row) for one in drives for name, row in one["pictures"].items()
    }
    sizes = {stem: (row["width"], row["height"]) for stem, (_, row) in known.items()}
    read = read_tool_labels(source, sizes, kind)
    placed = tuple(_placed(one, known, read.where) for one in read.pictures)
    for name, count in Counter(one.name for one in placed).items():
        if count > 1:
            raise SchemaError(f"{read.where}: {name}: expected once, found {count} times")
    settings = vehicle_given(vehicle)
    exported_as = {label: cue for one in drives for label, cue in one["labels"].items()}
    meant = {label: cue for label, cue in exported_as.items() if label in read.labels}
    cues = cues_by_label(read, meant | dict(labels), tuple(settings.cues.own), any_thing=True)
    wanted = {name for one in drives for name in one["pictures"]}
    there = {one["drive"]: target / one["drive"] / FILE for one in drives}
    for path in (target / "coco.json", target / WRITTEN, *there.values()):
        if path.exists() and not (add or overwrite):
            raise OutputError(f"{path}: exists; use --add, --overwrite, or another name")
    done: dict[str, ImportedTruth] = {}
    for one in drives:
        mine = tuple(picture for picture in placed if picture.name in one["pictures"])
        if not mine:
            continue
        log = _log_of(one["log"], folder)
        part = replace(read, pictures=mine)
        keeps = add and there[one["drive"]].exists()
        path = there[one["drive"]]
        done[one["drive"]] = import_part(part, cues, log, path, settings, add=keeps, limits=limits)
    if not done:
        raise EmptyResultError(f"{source}: contains no labelled picture of the export")
    whole = replace(read, pictures=placed)
    coco = write_coco(target, whole).replace(target / "coco.json")
    images = folder / LABEL_FORMATS[_format(folder)].pictures
    missing = len(wanted - {one.name for one in placed})
    return ImportedLabels(coco, images, done, missing, read.ignored)


def _placed(
    picture: Picture, known: Mapping[str, tuple[str, Mapping[str, Any]]], where: str
) -> Picture:
    """Return a picture with its name and time in the export.

    Raises:
        SchemaError: The picture was not exported, or has another size.
    """
    stem = re.split(r"[/\\]", picture.name)[-1]
    found = known.get(stem) or known.get(re.sub(r"\.[A-Za-z]+$", "", stem))
    if found is None:
        # CVAT and Label Studio add a prefix to the names of uploaded files.
        ends = [name for name in known if re.sub(r"\.[A-Za-z]+$", "", stem).endswith(name)]
        found = known[ends[0]] if len(ends) == 1 else None
    if found is None:
        raise SchemaError(
            f"{where}: {picture.name}: not in the export; use the export that contains it"
        )
    name, row = found
    if picture.size_px != (row["width"], row["height"]):
        raise SchemaError(
            f"{where}: {picture.name}: expected {row['width']} x {row['height']} pixels, found "
            f"{picture.size_px[0]} x {picture.size_px[1]}; label pictures in their exported size"
        )
    return replace(picture, name=name, t_ns=row["t_ns"])


def _read_index(folder: Path) -> list[dict[str, Any]]:
    path = folder / INDEX
    try:
        drives = json_tree(door.read(path))["drives"]
        for one in drives:
            assert Path(one["drive"]).name == one["drive"] != ""
            assert isinstance(one["log"], str)
            assert isinstance(one["labels"], dict)
            for row in one["pictures"].values():
                assert all(isinstance(row[name], int) for name in ("t_ns", "width", "height"))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, AssertionError):
        raise AnnotationError(
            f"{path}: missing or damaged; use a folder that crosscue export wrote"
        ) from None
    return list(drives)


def _format(folder: Path) -> str:
    return str(json_tree(door.read(folder / INDEX))["to"])


def _log_of(log: str, folder: Path) -> Path:
    return Path(os.path.normpath(folder / unspelled(log)))
