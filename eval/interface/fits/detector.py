"""Fit a detector's thresholds and calibrations to labelled boxes, and write them to its card."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.datasets.truth.box_labels import class_names_given, read_box_labels
from crosscue.detectors.catalog.card import read_card
from crosscue.detectors.catalog.places import card_path, names
from crosscue.eval.fit.detector.card_text import check_place, with_fit
from crosscue.eval.fit.detector.class_fit import (
    CALIBRATIONS,
    CalibrationKind,
    ClassFit,
    Judged,
    fit_class,
)
from crosscue.eval.pipeline.run import Run, open_run
from crosscue.eval.runs.manifest import DetectorRow
from crosscue.eval.scoring.boxes.labelled_run import LabelledRun, labelled_run
from crosscue.eval.scoring.boxes.matching import match
from crosscue.replay.base import DEFAULT_LIMITS, Limits, UsageError, visible, write_text

CONFIDENCE: Final = 0.95
YEAR_2000_NS: Final = 946_684_800_000_000_000


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedDetector:
    """Thresholds and calibrations by class; its repr is the output of ``crosscue fit detector``.

    Attributes:
        detector: The detector, as it ran.
        classes: Fits of all classes that the labels and the detector have in common.
        precision: Required precision.
        fitted_to: Number of pictures that were fitted to.
        held_out: Number of pictures that were held out.
        left_out: Numbers of labels that were left out, by reason.
        card: Card that was written; None without one.
        is_whole: True if nothing was dropped when the runs were made.
    """

    detector: DetectorRow
    classes: tuple[ClassFit, ...]
    precision: float
    fitted_to: int
    held_out: int
    left_out: Mapping[str, int]
    card: Path | None
    is_whole: bool = True

    @property
    def has_threshold(self) -> bool:
        """True if at least one class has a threshold."""
        return any(one.scores and one.scores.threshold is not None for one in self.classes)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue fit detector``."""
        return {
            "detector": self.detector.name,
            "precision": self.precision,
            "confidence": CONFIDENCE,
            "images_fitted_to": self.fitted_to,
            "images_held_out": self.held_out,
            "left_out": dict(self.left_out),
            "classes": [_class_tree(one) for one in self.classes],
            "card": None if self.card is None else str(self.card),
        }

    def __repr__(self) -> str:
        lines = [
            f"detector   {visible(self.detector.name)}, fitted to {self.fitted_to:,} images, "
            f"{self.held_out:,} others held out",
            *(f"left out   {count:,} {visible(why)}" for why, count in self.left_out.items()),
        ]
        for one in self.classes:
            lines += ["", *_class_lines(one, self.precision)]
        if self.card is not None:
            lines += ["", f"written to {visible(str(self.card))}"]
        return "\n".join(lines)


def _class_lines(one: ClassFit, precision: float) -> list[str]:
    lines = [
        f"{visible(one.name):10} {one.labels:,} boxes, {one.detections:,} detections, "
        f"{one.right:,} right"
    ]
    if one.scores is not None and one.scores.threshold is not None:
        lines.append(
            f"  threshold   {one.scores.threshold:g}: precision at least {one.bound:.3f} with "
            f"{CONFIDENCE:.0%} confidence (required: {precision:g})"
        )
    if one.scores is not None and one.scores.calibration is not None:
        lines.append(f"  calibration {_calibration_text(one)}")
    held = one.held_out
    if held is not None and held.of:
        lines.append(
            f"  held out    precision {held.precision:.3f} ({held.interval.low:.3f} to "
            f"{held.interval.high:.3f}; {held.right:,} of {held.of:,}), recall {held.recall:.3f} "
            f"({held.right:,} of {held.labels:,})"
        )
        is_shown = "is" if held.bound >= precision else "is not"
        lines.append(
            f"              precision at least {held.bound:.3f} with {CONFIDENCE:.0%} confidence: "
            f"{precision:g} {is_shown} shown"
        )
        lines.append(
            f"              calibration error {held.error_before:.3f} before, "
            f"{held.error_after:.3f} after, {held.detections:,} detections"
        )
    return lines + [f"  {note}" for note in one.notes]


def _calibration_text(one: ClassFit) -> str:
    assert one.scores is not None
    found = one.scores.calibration
    assert found is not None
    if found.kind == "platt":
        return f"platt, slope {found.slope:g}, offset {found.offset:g}"
    return f"isotonic, {len(found.scores)} points"


def _class_tree(one: ClassFit) -> dict[str, Any]:
    held = one.held_out
    return {
        "class": one.name,
        "labels": list(one.members),
        "boxes": one.labels,
        "detections": one.detections,
        "right": one.right,
        "scores": None if one.scores is None else one.scores.model_dump(mode="json"),
        "bound": one.bound,
        "held_out": None
        if held is None
        else asdict(held) | {"precision": held.precision, "recall": held.recall},
        "notes": list(one.notes),
    }


def fit_detector(
    runs: Sequence[Run | Path | str] | Run | Path | str,
    labels: Sequence[Path | str] | Path | str,
    output: Path | str | None = None,
    *,
    precision: float = 0.95,
    calibration: CalibrationKind = "platt",
    test: Sequence[Run | Path | str] = (),
    test_labels: Sequence[Path | str] = (),
    hold_out: float = 0.5,
    card: Path | str | None = None,
    detector: str | None = None,
    kind: str | None = None,
    class_names: Sequence[str] | Path | str = (),
    meanings: Mapping[str, str] | None = None,
    overlap: float = 0.5,
    date: str = "",
    overwrite: bool = False,
    logs: Path | str | None = None,
    limits: Limits = DEFAULT_LIMITS,
) -> FittedDetector:
    """Fit a detector's thresholds and calibrations to labelled boxes.

    Each class gets the lowest threshold whose one-sided bound on precision is high enough, and a
    calibration from scores to probabilities. The result is tested on held-out pictures: those of
    ``test``, or the last ones of each run.

    Args:
        runs: Runs with stored, uncalibrated detections of one detector.
        labels: Labels of each run, in the same order; see ``score_detector``.
        output: Card to write; None for none.
        precision: Required precision, in (0, 1).
        calibration: ``platt``, ``isotonic`` or ``none``.
        test: Other runs to test the result on.
        test_labels: Labels of each run of ``test``, in the same order.
        hold_out: Fraction of each run's pictures, at its end, to hold out if ``test`` is empty.
        card: Card of the detector, if the run does not name it.
        detector: Name of the detector, if the runs have several.
        kind: Format of the labels; default: detected.
        class_names: Class names of YOLO labels in their order, or a file with one per line.
        meanings: Class that a class of the labels or of the detector counts as.
        overlap: Min IoU of a correct detection with a label.
        date: Date of the fit, for the card; default: the date of the first picture.
        overwrite: Replace an existing card.
        logs: Folder that the runs' logs have moved to.
        limits: Limits for reading the logs.

    Raises:
        UsageError: A value is out of range, runs have different detectors, or scores are already
            calibrated.
        SchemaError: Labels cannot be read, or do not belong to the run.
        VehicleError: The card cannot be read.
        OutputError: The card cannot be written.
    """
    _check(precision, calibration, hold_out, overlap)
    given = [runs] if isinstance(runs, Run | Path | str) else list(runs)
    theirs = [labels] if isinstance(labels, Path | str) else list(labels)
    if len(theirs) != len(given) or len(test_labels) != len(test):
        raise UsageError(
            f"--labels: {len(theirs)} for {len(given)} runs, --test-labels: {len(test_labels)} for "
            f"{len(test)}; expected one for each, in the same order"
        )

    if card is not None:
        # Errors in the card are reported before any run is opened.
        read_card(Path(card))
    places = [run.path if isinstance(run, Run) else run for run in (*given, *test)]
    folders = [open_run(place, logs, limits=limits).folder for place in places]
    listed = class_names_given(class_names)
    read = [read_box_labels(Path(path), kind, listed) for path in (*theirs, *test_labels)]
    whole = [
        labelled_run(folder, one, detector, meanings)
        for folder, one in zip(folders, read, strict=True)
    ]
    row = _one_detector(whole)
    source = _card_of(row, card, is_needed=output is not None)
    if output is not None and source is not None:
        check_place(read_card(source), source, Path(output), overwrite=overwrite)
    fitted, held = _split(whole[: len(given)], whole[len(given) :], hold_out)
    fits = tuple(
        fit_class(
            name,
            whole[0].members[name],
            fitted.judged(name, overlap),
            held.judged(name, overlap),
            precision,
            CONFIDENCE,
            calibration,
        )
        for name in _common(whole)
    )
    written = None
    if output is not None and source is not None and any(one.scores for one in fits):
        written = Path(output)
        counts = f"{len(fitted)} images fitted to, {len(held)} held out"
        pictures = f"{counts}, of {_log_names(whole)}{_date_of(fitted.runs)}"
        aim = f"precision {precision:g} with {CONFIDENCE:.0%} confidence"
        text = with_fit(source.read_text(encoding="utf-8"), fits, pictures, date, aim)
        write_text(written, text)
    left_out = sum((Counter(part.left_out) for part in whole), Counter[str]())
    is_whole = all(part.is_whole for part in whole)
    return FittedDetector(row, fits, precision, len(fitted), len(held), left_out, written, is_whole)


def _check(precision: float, calibration: str, hold_out: float, overlap: float) -> None:
    if not 0.0 < precision < 1.0:
        raise UsageError(f"--precision {precision}: expected above 0 and below 1")
    if calibration not in CALIBRATIONS:
        raise UsageError(f"--calibration {calibration}: expected one of {', '.join(CALIBRATIONS)}")
    if not 0.0 < hold_out < 1.0:
        raise UsageError(f"--hold-out {hold_out}: expected above 0 and below 1")
    if not 0.0 < overlap <= 1.0:
        raise UsageError(f"--overlap {overlap}: expected above 0, at most 1")


def _one_detector(parts: Sequence[LabelledRun]) -> DetectorRow:
    row = parts[0].detector
    for part in parts:
        if part.detector.identity != row.identity:
            raise UsageError(
                f"{part.run.path}: {part.detector.name} differs from the detector of "
                f"{parts[0].run.path}, or has other settings or weights; replay both with the same"
            )
        if part.detector.calibrated:
            raise UsageError(
                f"{part.run.path}: scores of {', '.join(part.detector.calibrated)} are calibrated "
                "already; replay with the card from before the fit"
            )
    return row


def _card_of(row: DetectorRow, card: Path | str | None, *, is_needed: bool) -> Path | None:
    if card is not None:
        return Path(card)
    named = row.settings.get("card")
    if named is not None:
        return Path(str(named))
    if row.kind in names():
        return card_path(row.kind)
    if is_needed:
        raise UsageError(f"-o: {row.name} has no model card; name one with --card, or omit -o")
    return None


def _common(parts: Sequence[LabelledRun]) -> list[str]:
    return sorted(set(parts[0].classes).intersection(*(part.classes for part in parts)))


@dataclass(frozen=True, slots=True, eq=False)
class _Pictures:
    """Chosen pictures of labelled runs.

    Attributes:
        runs: The runs.
        chosen: Mask of the pictures of each run, shape (P,).
    """

    runs: Sequence[LabelledRun]
    chosen: Sequence[np.typing.NDArray[np.bool_]]

    def __len__(self) -> int:
        return sum(int(one.sum()) for one in self.chosen)

    def judged(self, name: str, overlap: float) -> Judged:
        """Match the detections of one class to labels."""
        scores, right, labels = [np.empty(0)], [np.empty(0, np.bool_)], 0
        for run, chosen in zip(self.runs, self.chosen, strict=True):
            matched = match(
                *run.part(chosen), run.classes.index(name), overlaps=np.array([overlap])
            )
            judged = ~matched.is_out[0]
            scores.append(matched.scores[judged])
            right.append(matched.is_right[0][judged])
            labels += len(matched.labels)
        return Judged(np.concatenate(scores), np.concatenate(right), labels)


def _split(
    parts: Sequence[LabelledRun], others: Sequence[LabelledRun], hold_out: float
) -> tuple[_Pictures, _Pictures]:
    """Return the pictures to fit to, and the held-out ones: ``others``, or the last of each run."""
    if others:
        fitted, held = (
            _Pictures(runs, [np.ones(len(run.names), np.bool_) for run in runs])
            for runs in (parts, others)
        )
        return fitted, held
    counts = [len(part.names) for part in parts]
    first = [np.arange(n) < n - round(hold_out * n) for n in counts]
    return _Pictures(parts, first), _Pictures(parts, [~one for one in first])


def _log_names(parts: Sequence[LabelledRun]) -> str:
    return ", ".join(sorted({log.name for one in parts for log in one.run.drive_manifest().logs}))


def _date_of(parts: Sequence[LabelledRun]) -> str:
    """Return the date of the first picture in parentheses, or "" if the log has no real time."""
    first = min(int(part.t_ns[0]) for part in parts)
    if first < YEAR_2000_NS:
        return ""
    return f" ({datetime.fromtimestamp(first // 1_000_000_000, UTC):%Y-%m-%d})"
