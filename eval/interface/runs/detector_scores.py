"""Score a detector's boxes in a run against labelled boxes of its pictures."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from crosscue.datasets.truth.box_labels import BoxLabels, class_names_given, read_box_labels
from crosscue.eval.pipeline.run import Run, open_run
from crosscue.eval.report.detector_page import write_detector_page
from crosscue.eval.report.worst_boxes import worst_pictures
from crosscue.eval.scoring.boxes.labelled_run import LabelledRun, labelled_run
from crosscue.eval.scoring.boxes.matching import match
from crosscue.eval.scoring.boxes.reliability import Reliability, class_calibration
from crosscue.eval.scoring.boxes.scores import SEED, IntervalEstimate, PartScore, score_parts
from crosscue.eval.scoring.intervals import MIN_CLUSTERS, TOO_FEW
from crosscue.replay.errors import UsageError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.safe_text import visible

if TYPE_CHECKING:
    import pyarrow as pa

FOLDER: Final = "score"
MEASURES: Final = ("ap50", "ap", "precision", "recall")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class DetectorScore:
    """Scores of a detector; its repr is the output of ``crosscue score detector``.

    Attributes:
        labelled: Detections and labels that were compared.
        labels: The labels as read.
        scores: Scores of each class and part.
        calibration: Calibration of each class.
        block_s: Pictures within this time count as one block.
        report: Page with the scores.
    """

    labelled: LabelledRun
    labels: BoxLabels
    scores: tuple[PartScore, ...]
    calibration: tuple[Reliability, ...]
    block_s: float
    report: Path

    @property
    def is_whole(self) -> bool:
        """True if nothing was dropped when the run was made."""
        return self.labelled.is_whole

    @property
    def parts(self) -> pa.Table:
        """Table with one row per class and part, with 95 % intervals."""
        import pyarrow as pa

        return pa.Table.from_pylist([_row(one) for one in self.scores])

    @property
    def bins(self) -> pa.Table:
        """Table of detections, and of those that are correct, by class and tenth of the score."""
        import pyarrow as pa

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

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue score detector``."""
        of = self.labelled
        return {
            "run": str(of.run.path),
            "detector": of.detector.name,
            "labels": self.labels.where,
            "format": self.labels.format,
            "images": len(of.names),
            "images_labelled": len(self.labels.pictures),
            "frames": of.frames,
            "placed": of.rule,
            "left_out": dict(of.left_out),
            "not_judged": dict(of.not_judged),
            "classes": {name: list(of.members[name]) for name in of.classes},
            "parts": [_row(one) for one in self.scores],
            "calibration": [asdict(one) for one in self.calibration],
            "report": str(self.report),
        }

    def __repr__(self) -> str:
        of = self.labelled
        asked = int((~of.truth.is_ignored).sum())
        lines = [
            f"run        {visible(str(of.run.path))}",
            f"detector   {visible(of.detector.name)}",
            f"labels     {visible(self.labels.where)} ({self.labels.format}): {len(of.names)} of "
            f"{len(self.labels.pictures)} images in the run, {of.rule};",
            f"           {asked:,} boxes to detect, {len(of.truth) - asked:,} not judged; "
            f"{of.frames - len(of.names):,} frames without labels",
            *(f"left out   {count:,} {visible(why)}" for why, count in of.left_out.items()),
        ]
        others = ", ".join(f"{n:,} {visible(label)}" for label, n in of.not_judged.items())
        if others:
            lines.append(f"not judged {others}: the labels have no such class")
        lines += [
            "",
            f"{'class':14} {'part':11} {'labels':>6} {'AP50':>6} {'AP':>6}   above  "
            f"{'precision':>17} {'recall':>17}",
            *map(_line, self.scores),
            "",
        ]
        lines += [
            f"calibration error {one.error:.3f} of {visible(one.label)}, "
            f"{one.detections:,} detections"
            for one in self.calibration
            if one.detections
        ]
        unit = f"blocks of {self.block_s:g} s" if self.block_s > 0.0 else "single images"
        lines.append(f"intervals  95 %, bootstrap over {unit}, seed {SEED}")
        if any(np.isnan(one.ap50.low) and one.labels for one in self.scores):
            lines.append(f"{TOO_FEW}: no intervals below {MIN_CLUSTERS} blocks or images")
        lines.append(f"written to {visible(str(self.report))}")
        return "\n".join(lines)


def _line(one: PartScore) -> str:
    if not one.labels and one.part == "all":
        why = f"not labelled: {one.wrong:,} detections not judged"
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


def score_detector(
    run: Run | Path | str,
    labels: Path | str,
    output: Path | str | None = None,
    *,
    detector: str | None = None,
    kind: str | None = None,
    class_names: Sequence[str] | Path | str = (),
    meanings: Mapping[str, str] | None = None,
    overlap: float = 0.5,
    block_s: float = 1.0,
    draw: int = 8,
    logs: Path | str | None = None,
    without_images: bool = False,
    has_figures: bool = True,
    limits: Limits = DEFAULT_LIMITS,
) -> DetectorScore:
    """Score a detector's boxes in a run against labelled boxes.

    Args:
        run: Run with stored detections.
        labels: A COCO file, or a folder of YOLO, Pascal VOC or KITTI files.
        output: Folder for the page and its numbers; default: ``RUN/score``.
        detector: Name of the detector, if the run has several.
        kind: Format of the labels; default: detected.
        class_names: Class names of YOLO labels in their order, or a file with one per line.
        meanings: Class that a class of the labels or of the detector counts as; empty for a class
            to ignore.
        overlap: Min IoU of a correct detection, for precision, recall and calibration.
        block_s: Pictures within this time count as one block, because they are similar.
        draw: Number of the worst pictures to draw.
        logs: Folder that the run's logs have moved to.
        without_images: Draw no pictures, so that the logs are not needed.
        has_figures: Draw the reliability diagram, which needs matplotlib.
        limits: Limits for reading the logs.

    Raises:
        UsageError: A value is out of range, the detector does not exist, or neither labels nor
            detections have a class.
        SchemaError: The labels cannot be read, or do not belong to the run.
        EmptyResultError: No labelled box has a class that the detector reports.
        RunError: The run does not exist or is damaged, or its log is missing.
    """
    if not 0.0 < overlap <= 1.0:
        raise UsageError(f"--overlap {overlap}: expected above 0, at most 1")
    if not 0.0 <= block_s < 1e6:
        raise UsageError(f"--block-s {block_s}: expected seconds from 0")
    if draw < 0:
        raise UsageError(f"--draw {draw}: expected 0 or more")
    path = run.path if isinstance(run, Run) else run
    folder = open_run(path, logs, without_images=without_images, limits=limits).folder
    read = read_box_labels(Path(labels), kind, class_names_given(class_names))
    of = labelled_run(folder, read, detector, meanings)
    scores = score_parts(
        of.truth,
        of.found,
        of.classes,
        {name: of.threshold(name) for name in of.classes},
        of.blocks(block_s),
        overlap,
    )
    place = folder.file(FOLDER) if output is None else Path(output)
    stem = "detector_" + re.sub(r"[^\w.-]", "_", of.detector.name)
    found = DetectorScore(
        of, read, tuple(scores), calibration_of(of, overlap), block_s, place / f"{stem}.html"
    )
    worst = [] if without_images else worst_pictures(of, overlap, draw)
    content: dict[str, Any] = {
        "detector": of.detector.name,
        "run": str(folder.path),
        "labels": read.where,
        "format": read.format,
        "rule": of.rule,
        "images": len(of.names),
        "boxes": int((~of.truth.is_ignored).sum()),
        "ignored": int(of.truth.is_ignored.sum()),
        "left_out": of.left_out,
        "not_judged": of.not_judged,
        "parts": scores,
        "lowest": float(of.found.scores.min(initial=1.0)),
        "overlap": overlap,
        "block_s": block_s,
        "seed": SEED,
        "worst": worst,
    }
    place.mkdir(parents=True, exist_ok=True)
    write_detector_page(found.report, content, found.calibration, has_figures=has_figures)
    write_text(place / f"{stem}.json", strict_json(found.as_dict()) + "\n")
    return found


def calibration_of(of: LabelledRun, overlap: float) -> tuple[Reliability, ...]:
    """Return the reliability of each class's scores as probabilities."""
    found = []
    for k, name in enumerate(of.classes):
        matched = match(of.truth, of.found, k, overlaps=np.array([overlap]))
        judged = ~matched.is_out[0] & bool(len(matched.labels))
        found.append(class_calibration(name, matched.scores[judged], matched.is_right[0][judged]))
    return tuple(found)
