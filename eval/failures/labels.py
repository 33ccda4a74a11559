"""Export failing frames for a labelling tool."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

from crosscue.datasets.labels.table import LABEL_FORMATS, ToolFormat
from crosscue.datasets.truth.annotations import Annotations
from crosscue.eval.failures.export import ExportedRun, export_run
from crosscue.eval.failures.record import Failure, read_failures
from crosscue.eval.pipeline.run import moved_to
from crosscue.eval.runs import owned
from crosscue.replay.errors import (
    CrosscueError,
    EmptyResultError,
    OutputError,
    UsageError,
)
from crosscue.replay.files.whole_file import cannot_write
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import visible
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
        yield f"pictures   {self.pictures:,} with {self.boxes:,} boxes to correct, for {title}"
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
    given = isinstance(failures, Path | str)
    chosen = read_failures(Path(failures)) if isinstance(failures, Path | str) else failures
    where = str(failures) if given else "failures"
    folder, kind = Path(output), LABEL_FORMATS[to]
    owned.check_place(folder, INDEX, overwrite=overwrite)
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
