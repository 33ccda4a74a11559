"""Score a detector's boxes in a run against labelled boxes of its pictures."""

import base64
import re
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, ClassVar, Final

import cv2
import numpy as np
import pyarrow as pa

from crosscue.datasets.truth.box_labels import BoxLabels, LabelFormat, Meanings, read_box_labels
from crosscue.detectors.base import View
from crosscue.detectors.catalog.class_names import class_names_given
from crosscue.detectors.images import Encoded, decode
from crosscue.detectors.overlay import FOUND, TRUE, write_label
from crosscue.eval.pipeline.run import Run, open_run
from crosscue.eval.report.html import write_page
from crosscue.eval.report.scene_figures import draw_calibration
from crosscue.eval.runs.stored_images import StoredCamera, picture_at, run_camera
from crosscue.eval.scoring.boxes.labelled_run import LabelledRun, labelled_run
from crosscue.eval.scoring.boxes.matching import match
from crosscue.eval.scoring.boxes.reliability import Reliability, class_calibration
from crosscue.eval.scoring.boxes.scores import SEED, IntervalEstimate, PartScore, score_parts
from crosscue.eval.scoring.intervals import MIN_CLUSTERS
from crosscue.replay import colours
from crosscue.replay.columns import Bytes, Floats
from crosscue.replay.errors import CrosscueError, UsageError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.safe_text import counted, visible
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option, keywords

FOLDER: Final = "score"
MEASURES: Final = ("ap50", "ap", "precision", "recall")

# Pictures closer in time than this show the same mistakes, so only the worst is shown.
APART_NS: Final = 1_000_000_000
# Min IoU of a right detection, for precision, recall and calibration.
OVERLAP: Final = 0.5
WIDTH_PX: Final = 960
QUALITY: Final = 80
WRONG: Final = colours.bgr(colours.WRONG)
GREY: Final = (150, 150, 150)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DetectorScore(Result):
    """Scores of a detector; its text is the output of ``crosscue score detector``.

    Attributes:
        labelled: Detections and labels that were compared.
        labels: The labels as read.
        scores: Scores of each class and part.
        calibration: Calibration of each class.
        block_s: Pictures within this time count as one block.
        report: Page with the scores.
    """

    labelled: LabelledRun = field(metadata=HIDDEN)
    labels: BoxLabels = field(metadata=HIDDEN)
    scores: tuple[PartScore, ...] = field(metadata=HIDDEN)
    calibration: tuple[Reliability, ...]
    block_s: float = field(metadata=HIDDEN)
    report: Path

    also: ClassVar = {
        "run": "labelled.run.path",
        "detector": "labelled.detector.name",
        "labels": "labels.where",
        "format": "labels.format",
        "images": "images",
        "images_labelled": "images_labelled",
        "frames": "labelled.frames",
        "placed": "labelled.rule",
        "left_out": "labelled.left_out",
        "not_judged": "labelled.not_judged",
        "classes": "classes",
        "parts": "part_rows",
    }

    @property
    def images(self) -> int:
        """Number of pictures of the run that are labelled."""
        return len(self.labelled.names)

    @property
    def classes(self) -> dict[str, tuple[str, ...]]:
        """Labels of the detector, by class that they count as."""
        return {name: self.labelled.members[name] for name in self.labelled.classes}

    @property
    def images_labelled(self) -> int:
        """Number of labelled pictures."""
        return len(self.labels.pictures)

    @property
    def part_rows(self) -> list[dict[str, object]]:
        """One row per class and part, with 95 % intervals."""
        return [_row(one) for one in self.scores]

    @property
    def is_whole(self) -> bool:
        """True if nothing was dropped when the run was made."""
        return self.labelled.is_whole

    @property
    def parts(self) -> pa.Table:
        """Table with one row per class and part, with 95 % intervals."""
        return pa.Table.from_pylist(self.part_rows)

    @property
    def bins(self) -> pa.Table:
        """Table of detections, and of those that are correct, by class and tenth of the score."""
        return pa.Table.from_pylist(
            [
                {
                    "class": one.label,
                    "score_from": each.low,
                    "score_to": each.high,
                    "detections": each.detections,
                    "right": each.right,
                    "mean_score": each.mean_score,
                    "fraction_right": each.fraction,
                }
                for one in self.calibration
                for each in one.bins
            ]
        )

    def lines(self) -> Iterator[str]:
        """Yield what was compared, the scores of each class and part, and the calibration."""
        of = self.labelled
        asked = int((~of.truth.is_ignored).sum())
        yield f"run        {of.run.path}"
        yield f"detector   {of.detector.name}"
        yield (
            f"labels     {self.labels.where} ({self.labels.format}): {len(of.names)} of "
            f"{counted(len(self.labels.pictures), 'image')} in the run, {of.rule};"
        )
        boxes = counted(asked, "box", "boxes")
        yield (
            f"           {boxes} to detect, {len(of.truth) - asked:,} not judged; "
            f"{counted(of.frames - len(of.names), 'frame')} without labels"
        )
        yield from (f"left out   {count:,} {why}" for why, count in of.left_out.items())
        others = ", ".join(f"{n:,} {label}" for label, n in of.not_judged.items())
        if others:
            yield f"not judged {others}: the labels have no such class"
        yield ""
        yield (
            f"{'class':14} {'part':11} {'labels':>6} {'AP50':>6} {'AP':>6}   above  "
            f"{'precision':>17} {'recall':>17}"
        )
        yield from map(_line, self.scores)
        yield ""
        for one in self.calibration:
            if one.detections:
                yield (
                    f"calibration error {one.error:.3f} of {one.label}, "
                    f"{counted(one.detections, 'detection')}"
                )
        unit = f"blocks of {self.block_s:g} s" if self.block_s > 0.0 else "single images"
        yield f"intervals  95 %, bootstrap over {unit}, seed {SEED}"
        if any(np.isnan(one.ap50.low) and one.labels for one in self.scores):
            yield f"no intervals below {MIN_CLUSTERS} blocks or images"
        yield f"written to {self.report}"


def _line(one: PartScore) -> str:
    if not one.labels and one.part == "all":
        why = f"not labelled: {counted(one.wrong, 'detection')} not judged"
        return f"{visible(one.label)[:14]:14} {one.part:11} {0:6}  {why}"
    threshold = _number(one.threshold)
    return (
        f"{visible(one.label)[:14]:14} {one.part:11} {one.labels:6,} {_number(one.ap50.value):>6} "
        f"{_number(one.ap.value):>6}  {threshold:>6}  {_span(one.precision):>17} "
        f"{_span(one.recall):>17}"
    )


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.3f}"


def _span(one: IntervalEstimate) -> str:
    if np.isnan(one.value):
        return "-"
    ends = "" if np.isnan(one.low) else f" ({one.low:.2f}-{one.high:.2f})"
    return f"{one.value:.3f}{ends}"


def _row(one: PartScore) -> dict[str, object]:
    row: dict[str, object] = {
        "class": one.label,
        "part": one.part,
        "labels": one.labels,
        "right": one.right,
        "wrong": one.wrong,
        "threshold": one.threshold,
    }
    for name in MEASURES:
        found: IntervalEstimate = getattr(one, name)
        row |= {name: found.value, f"{name}_low": found.low, f"{name}_high": found.high}
    return row


@dataclass(frozen=True, slots=True)
class DetectorScoreSettings:
    """How a detector is compared with labels.

    Attributes:
        output: Folder for the page and its numbers (default: RUN/score).
        detector: Name of the detector, if the run has several.
        kind: Format of the labels (default: detected).
        class_names: Class names, one per line: for YOLO in index order, for VOC and KITTI all
            classes.
        meanings: Class that a label of the file or detector counts as; an empty one ignores it.
        block_s: Count images within this many seconds as one, because they are similar.
        draw: Draw the N worst images.
        logs: Folder that the run's logs have moved to; they are recognised by content.
        without_images: Leave out camera images, so the run's logs are not needed.
        has_figures: Omit the reliability diagram.
        limits: Limits for reading the logs.
    """

    output: Path | str | None = None
    _: KW_ONLY
    detector: str | None = None
    kind: Annotated[LabelFormat | None, Option("--format")] = None
    class_names: Annotated[Path, Option(metavar="FILE")] | Sequence[str] | str = ()
    meanings: Meanings = field(default_factory=lambda: MappingProxyType({}))
    block_s: float = 1.0
    draw: int = 8
    logs: Annotated[Path | str | None, Option(metavar="DIR")] = None
    without_images: bool = False
    has_figures: bool = True
    limits: LimitsGiven = DEFAULT_LIMITS

    def __post_init__(self) -> None:
        """Check numbers.

        Raises:
            UsageError: A number is out of range.
        """
        if not 0.0 <= self.block_s < 1e6:
            raise UsageError(f"block_s: {self.block_s}, expected seconds from 0")
        if self.draw < 0:
            raise UsageError(f"draw: {self.draw}, expected 0 or more")


@keywords(DetectorScoreSettings, 2)
def score_detector(
    run: Annotated[Path | str, Option(metavar="RUN")] | Run,
    labels: Annotated[Path | str, Option("--labels", metavar="LABELS")],
    settings: DetectorScoreSettings,
) -> DetectorScore:
    """Score a detector of a run against labelled boxes of its images.

    LABELS is a COCO .json, or a folder of YOLO .txt, Pascal VOC .xml or KITTI .txt files. Images
    are matched to frames by file name if the log is a folder of images, else by log time (t_ns of a
    COCO file, or a file name that is a time in nanoseconds), else by the frame number, from 0, at
    the end of the file name. Frames without labels are not judged.

    Prints AP50 and AP (COCO), precision and recall above the detector's threshold, by class, size
    and range, and the calibration of scores. The page in RUN/score shows the worst images.

    Examples:
        crosscue score detector runs/A-01 --labels labels.json
        crosscue score detector runs/A-01 --labels labels.json --map car=vehicle truck=vehicle

    Args:
        run: Run folder with detections.
        labels: Labelled boxes of its images.
        settings: How to compare.

    Raises:
        UsageError: A value is out of range, the detector does not exist, or neither labels nor
            detections have a class.
        SchemaError: The labels cannot be read, or do not belong to the run.
        EmptyResultError: No labelled box has a class that the detector reports.
        RunError: The run does not exist or is damaged, or its log is missing.
    """
    output = settings.output
    path = run.path if isinstance(run, Run) else run
    folder = open_run(
        path, settings.logs, without_images=settings.without_images, limits=settings.limits
    ).folder
    read = read_box_labels(Path(labels), settings.kind, class_names_given(settings.class_names))
    if read.is_by_picture:
        raise UsageError(
            f"{read.where}: says what pictures show, and has no boxes to score; use crosscue fit "
            "detector"
        )
    of = labelled_run(folder, read, settings.detector, dict(settings.meanings))
    scores = score_parts(
        of.truth,
        of.found,
        of.classes,
        {name: of.threshold(name) for name in of.classes},
        of.blocks(settings.block_s),
        OVERLAP,
    )
    place = folder.file(FOLDER) if output is None else Path(output)
    stem = "detector_" + re.sub(r"[^\w.-]", "_", of.detector.name)
    found = DetectorScore(
        of,
        read,
        tuple(scores),
        calibration_of(of),
        settings.block_s,
        place / f"{stem}.html",
    )
    worst = [] if settings.without_images else worst_pictures(of, settings.draw)
    place.mkdir(parents=True, exist_ok=True)
    content = {
        "title": of.detector.name,
        "one": found,
        "of": of,
        "worst": worst,
        "boxes": int((~of.truth.is_ignored).sum()),
        "lowest": float(of.found.scores.min()) if len(of.found.scores) else None,
        "overlap": OVERLAP,
        "seed": SEED,
        "figure": draw_calibration(found.calibration) if settings.has_figures else None,
    }
    write_page(found.report, "detector.html.j2", content)
    write_text(place / f"{stem}.json", strict_json(found.as_dict()) + "\n")
    return found


def calibration_of(of: LabelledRun) -> tuple[Reliability, ...]:
    """Return the reliability of each class's scores as probabilities."""
    found = []
    for k, name in enumerate(of.classes):
        matched = match(of.truth, of.found, k, overlaps=np.array([OVERLAP]))
        judged = ~matched.is_out[0] & bool(len(matched.labels))
        found.append(class_calibration(name, matched.scores[judged], matched.is_right[0][judged]))
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A box to draw."""

    box_px: Floats
    colour: tuple[int, int, int]
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class WorstPicture:
    """One picture with mistakes.

    Attributes:
        name: Name of the picture in the labels.
        t_ns: Time of the frame.
        wrong: Number of detections above the threshold that match no label.
        missed: Number of labels that no detection above the threshold matches.
        picture: JPEG in base64, or None if it cannot be read.
    """

    name: str
    t_ns: int
    wrong: int
    missed: int
    picture: str | None = None


def worst_pictures(labelled: LabelledRun, max_count: int) -> list[WorstPicture]:
    """Return the pictures with the most mistakes, at most one for each moment.

    Raises:
        RunError: The log with the pictures is not found.
        LogError: That log cannot be opened.
    """
    marks = _marks(labelled)
    order = sorted(
        (i for i in range(len(marks)) if any(one.colour in (WRONG, TRUE) for one in marks[i])),
        key=lambda i: (-sum(one.colour in (WRONG, TRUE) for one in marks[i]), i),
    )
    chosen: list[int] = []
    for i in order:
        if len(chosen) < max_count and all(
            abs(int(labelled.t_ns[i] - labelled.t_ns[k])) >= APART_NS for k in chosen
        ):
            chosen.append(i)
    camera = run_camera(labelled.run) if chosen else None
    return [
        WorstPicture(
            labelled.names[i],
            int(labelled.t_ns[i]),
            sum(one.colour == WRONG for one in marks[i]),
            sum(one.colour == TRUE for one in marks[i]),
            _picture(camera, int(labelled.t_ns[i]), marks[i]),
        )
        for i in chosen
    ]


def _marks(labelled: LabelledRun) -> list[list[Drawn]]:
    """Return the ignored, right, missed and wrong boxes of each picture."""
    truth, found = labelled.truth, labelled.found
    marks: list[list[Drawn]] = [[] for _ in labelled.names]
    for row in np.flatnonzero(truth.is_ignored).tolist():
        marks[truth.picture[row]].append(Drawn(truth.boxes_px[row], GREY, ""))
    for k, name in enumerate(labelled.classes):
        matched = match(truth, found, k, overlaps=np.array([OVERLAP]))
        sure = matched.scores > labelled.threshold(name)
        hit = set(matched.took[0][sure].tolist())
        for row in np.flatnonzero((truth.label == k) & ~truth.is_ignored).tolist():
            if row not in hit:
                missed = Drawn(truth.boxes_px[row], TRUE, f"missed {name}")
                marks[truth.picture[row]].append(missed)
        for is_some, colour in ((matched.is_right[0], FOUND), (matched.is_wrong[0], WRONG)):
            for i in np.flatnonzero(is_some & sure).tolist():
                row = matched.row[i]
                text = f"{name} {matched.scores[i]:.2f}"
                marks[found.picture[row]].append(Drawn(found.boxes_px[row], colour, text))
    return marks


def _picture(camera: StoredCamera | None, t_ns: int, marks: Sequence[Drawn]) -> str | None:
    if camera is None:
        return None
    try:
        found = picture_at(camera, t_ns)
        return None if found is None else _drawn(found, marks)
    except CrosscueError:
        # The page states that this picture cannot be read.
        return None


def _drawn(picture: Encoded, marks: Sequence[Drawn]) -> str | None:
    pixels, whole = decode(picture, View(min_width_px=WIDTH_PX))
    size = (WIDTH_PX, round(whole[1] * WIDTH_PX / whole[0]))
    canvas: Bytes = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    for one in marks:
        x0, y0, x1, y1 = np.rint(one.box_px * (size[0] / whole[0])).astype(int).tolist()
        thick = 1 if one.colour in (GREY, FOUND) else 2
        cv2.rectangle(canvas, (x0, y0), (x1, y1), one.colour, thick)
        if thick == 2:
            write_label(canvas, one.text, (x0, max(y0 - 4, 12)), one.colour, 0.4)
    ok, jpeg = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return base64.b64encode(jpeg.tobytes()).decode() if ok else None
