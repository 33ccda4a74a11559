"""Import annotated pictures of a log, or of an export of many drives, as truth."""

import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

from crosscue.datasets.labels.table import LABEL_FORMATS, ToolFormat, read_tool_labels
from crosscue.datasets.truth import truth as truth_file
from crosscue.datasets.truth.annotations import (
    Annotations,
    LogPictures,
    Picture,
    check_boxes,
    cue_truths,
    cues_by_label,
    match_frames,
)
from crosscue.datasets.truth.box_labels import Meanings
from crosscue.datasets.truth.coco import OBJECTS_FILE, WRITTEN, write_coco, write_imported
from crosscue.datasets.truth.truth import Truth
from crosscue.eval.failures.labels import INDEX
from crosscue.eval.fit.log_images import log_pictures
from crosscue.replay.errors import (
    AnnotationError,
    EmptyResultError,
    OutputError,
    SchemaError,
    UsageError,
)
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, strict_json, unspelled
from crosscue.replay.files.whole_file import sha256_of, write_text
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.safe_text import counted, visible
from crosscue.replay.vehicle.vehicle import CUES, Vehicle, vehicle_given
from crosscue.results import Result
from crosscue.verb import Option, keywords


@dataclass(frozen=True, slots=True, eq=False)
class TruthImport:
    """What was annotated, and how labels become cues.

    Attributes:
        log: The log that was annotated.
        export: Folder of crosscue export that was annotated.
        kind: Format of the annotations (default: detected).
        vehicle: Vehicle file: camera topic and your own cues.
        meanings: Cue by label; an empty cue ignores the label.
        add: Keep the approaches and the track of an existing truth file.
        overwrite: Replace an existing truth file.
        limits: Limits for reading the logs.
    """

    log: Annotated[Path | str | None, Option(group="what")] = None
    export: Annotated[Path | str | None, Option(metavar="DIR", group="what")] = None
    kind: Annotated[ToolFormat | None, Option("--format")] = None
    vehicle: Vehicle | Path | str | None = None
    meanings: Meanings = field(default_factory=lambda: MappingProxyType({}))
    add: bool = False
    overwrite: bool = False
    limits: LimitsGiven = DEFAULT_LIMITS


@dataclass(frozen=True, slots=True, repr=False)
class ImportedTruth(Result):
    """Result of an import.

    Attributes:
        truth: Path of the truth file.
        objects: Path of the COCO file next to it.
        pictures: Number of annotated pictures.
        things: Number of annotated objects.
        rule: Rule by which pictures were matched to frames.
        cues: Number of pictures in which a cue is present, by cue.
        ignored: Number of shapes that were not imported, by kind.
    """

    truth: Path
    objects: Path
    pictures: int
    things: int
    rule: str
    cues: dict[str, int]
    ignored: Mapping[str, int]

    def lines(self) -> Iterator[str]:
        """Yield the numbers of pictures, objects and cues, and the files."""
        things = counted(self.things, "object")
        yield f"pictures   {self.pictures} with {things}, matched {self.rule}"
        yield from (f"           {cue}: present in {count}" for cue, count in self.cues.items())
        if not self.cues:
            yield "           no label is a cue; only objects were imported"
        yield from (f"ignored    {count} {kind}" for kind, count in self.ignored.items())
        yield f"written to {self.truth}"
        yield f"           {self.objects}"


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
        things = counted(sum(one.things for one in self.drives.values()), "object")
        drives = counted(len(self.drives), "drive")
        yield f"pictures   {pictures:,} with {things}, of {drives}"
        if self.missing:
            missing = counted(self.missing, "exported picture is", "exported pictures are")
            yield f"missing    {missing} not in the annotations"
        yield from (f"ignored    {count:,} {visible(kind)}" for kind, count in self.ignored.items())
        yield from (f"truth      {visible(str(one.truth))}" for one in self.drives.values())
        yield f"to train   --data {visible(str(self.coco))} --images {self.images}"


@keywords(TruthImport, 2)
def import_truth(
    annotations: Annotated[Path | str, Option(metavar="ANNOTATIONS")],
    output: Annotated[Path | str, Option(metavar="T.json")],
    settings: TruthImport,
) -> ImportedTruth | ImportedLabels:
    """Import annotations of labelling tools as truth.

    Supported formats are COCO and FiftyOne (.json), CVAT for images or video, XML 1.1 (.xml), and
    folders of YOLO and FiftyOne. Pictures are matched to frames by t_ns, by file name,
    or by frame number. With --export, they are matched by the export, which may contain many
    drives: the truth file of each is written below the output folder, and coco.json there contains
    all pictures, for training.

    A label that is a cue's name ("stop sign", "parked_left") means that the cue is present. A
    picture annotated without it means that the cue is absent. --map assigns other labels to cues.
    Annotation files contain no approaches: write these into the truth file by hand (see crosscue
    truth schema), and use --add to keep them. Your own cues are those that the vehicle file defines
    under [cues.own].

    Examples:
        crosscue truth import coco.json --log drive.mcap -o truth.json
        crosscue truth import corrected.json --export labelling -o labelled
        crosscue truth import voc.xml --log drive.mcap -o truth.json --map 'halt=stop_sign' 'dog='

    Args:
        annotations: File or folder of annotations.
        output: Truth file, or its folder; with --export, the folder of all truth files.
        settings: What was annotated, and how labels become cues.

    Raises:
        UsageError: Neither ``log`` nor ``export`` is set, or both are.
        SchemaError: The annotations do not fit the log or the export.
        OutputError: A truth file exists, or the files cannot be written.
    """
    if (settings.log is None) == (settings.export is None):
        raise UsageError("log, export: expected one of them")
    if settings.export is None:
        return _of_log(Path(annotations), Path(output), settings)
    return _of_export(Path(annotations), Path(settings.export), Path(output), settings)


def _of_log(source: Path, output: Path, settings: TruthImport) -> ImportedTruth:
    """Import annotated pictures of one log."""
    assert settings.log is not None
    target = output / truth_file.FILE if output.is_dir() else output
    _refuse_existing([target], settings)
    vehicle, log = vehicle_given(settings.vehicle), Path(settings.log)
    pictures = log_pictures(log, vehicle, settings.limits)
    read = read_tool_labels(source, {"*": pictures.size_px}, settings.kind)
    cues = cues_by_label(read, settings.meanings, tuple(vehicle.cues.own))
    return _write(read, cues, pictures, log, target, add=settings.add)


def _refuse_existing(files: Sequence[Path], settings: TruthImport) -> None:
    for path in files:
        if path.exists() and not (settings.add or settings.overwrite):
            raise OutputError(f"{path}: exists; use --add, --overwrite, or another name")


def _of_export(source: Path, folder: Path, target: Path, settings: TruthImport) -> ImportedLabels:
    """Import corrected labels of an export: truth and objects of each drive, and one COCO file."""
    drives = _read_index(folder)
    known = {
        Path(name).stem: (name, row) for one in drives for name, row in one["pictures"].items()
    }
    sizes = {stem: (row["width"], row["height"]) for stem, (_, row) in known.items()}
    read = read_tool_labels(source, sizes, settings.kind)
    placed = tuple(_placed(one, known, read.where) for one in read.pictures)
    for name, count in Counter(one.name for one in placed).items():
        if count > 1:
            raise SchemaError(f"{read.where}: {name}: expected once, found {count} times")
    vehicle = vehicle_given(settings.vehicle)
    exported_as = {label: cue for one in drives for label, cue in one["labels"].items()}
    meant = {label: cue for label, cue in exported_as.items() if label in read.labels}
    meant |= settings.meanings
    cues = cues_by_label(read, meant, tuple(vehicle.cues.own), any_thing=True)
    wanted = {name for one in drives for name in one["pictures"]}
    there = {one["drive"]: target / one["drive"] / truth_file.FILE for one in drives}
    _refuse_existing([target / "coco.json", target / WRITTEN, *there.values()], settings)
    done: dict[str, ImportedTruth] = {}
    for one in drives:
        mine = tuple(picture for picture in placed if picture.name in one["pictures"])
        if not mine:
            continue
        log = Path(os.path.normpath(folder / unspelled(one["log"])))
        pictures = log_pictures(log, vehicle, settings.limits)
        path = there[one["drive"]]
        keeps = settings.add and path.exists()
        part = replace(read, pictures=mine)
        done[one["drive"]] = _write(part, cues, pictures, log, path, add=keeps)
    if not done:
        raise EmptyResultError(f"{source}: contains no labelled picture of the export")
    whole = replace(read, pictures=placed)
    coco = write_coco(target, whole).replace(target / "coco.json")
    images = folder / LABEL_FORMATS[json_tree(door.read(folder / INDEX))["to"]].pictures
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


def _write(
    annotations: Annotations,
    cues: Mapping[str, str | None],
    pictures: LogPictures,
    log_path: Path,
    output: Path,
    *,
    add: bool,
) -> ImportedTruth:
    """Write the annotated pictures of one log as its truth, and its labelled objects beside it."""
    check_boxes(annotations)
    placed = match_frames(annotations, pictures)
    truth = Truth(
        version=1,
        log=log_path.name,
        log_sha256=sha256_of(log_path),
        start_ns=int(pictures.t_ns[0]),
        end_ns=int(pictures.t_ns[-1]) + 1,
        source=f"annotations in {Path(annotations.where).name}",
        cues=cue_truths(annotations, placed, cues),
        own_cues=tuple(sorted({cue for cue in cues.values() if cue} - {*CUES})),
        objects=OBJECTS_FILE,
    )
    if add:
        before = truth_file.read_truth(output)
        kept = {
            "start_ns": min(before.start_ns, truth.start_ns),
            "end_ns": max(before.end_ns, truth.end_ns),
            "cues": truth.cues,
            "own_cues": truth.own_cues,
            "objects": truth.objects,
            "log_sha256": truth.log_sha256,
        }
        truth = before.model_copy(update=kept)
    objects = output.parent / OBJECTS_FILE
    write_imported(objects, annotations, placed, cues)
    write_text(output, strict_json(truth.model_dump(mode="json")) + "\n")
    there = {one.cue: 0 for one in truth.cues} | Counter(c.cue for c in truth.cues if c.present)
    return ImportedTruth(
        output,
        objects,
        len(annotations.pictures),
        sum(len(picture.things) for picture in annotations.pictures),
        placed.rule,
        there,
        annotations.ignored,
    )
