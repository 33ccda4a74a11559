"""Fit a detector's thresholds and calibrations to labelled boxes, and write them to its card."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, ClassVar, Final

import numpy as np

from crosscue.datasets.truth.box_labels import LabelFormat, Meanings, read_box_labels
from crosscue.detectors.catalog.card import read_card
from crosscue.detectors.catalog.class_names import class_names_given
from crosscue.detectors.catalog.places import card_path, names
from crosscue.eval.fit.detector.card_text import check_card_place, scores_text, with_fit
from crosscue.eval.fit.detector.class_fit import (
    CALIBRATIONS,
    NOT_LABELLED,
    CalibrationKind,
    ClassDetections,
    ClassFit,
    LabelUnit,
    fit_class,
)
from crosscue.eval.fit.vehicle_output import Fitted
from crosscue.eval.pipeline.run import Run, open_run
from crosscue.eval.report.chart import Chart, precision_and_recall
from crosscue.eval.runs.manifest import DetectorRow
from crosscue.eval.scoring.boxes.labelled_run import LabelledRun, labelled_run
from crosscue.eval.scoring.boxes.matching import match
from crosscue.replay.clocks.findings import is_date
from crosscue.replay.columns import Floats
from crosscue.replay.errors import FitError, UsageError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.safe_text import counted, visible
from crosscue.results import HIDDEN, json_key
from crosscue.verb import Option, keywords

CONFIDENCE: Final = 0.95
# Min IoU of a right detection with a label.
OVERLAP: Final = 0.5
MAX_CHARTS: Final = 12


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedDetector(Fitted):
    """Thresholds and calibrations of a detector, by class.

    Attributes:
        detector: The detector, as it ran.
        classes: Fits of all classes that the labels and the detector have in common.
        precision: Required precision.
        fitted_to: Number of pictures that were fitted to.
        held_out: Number of pictures that were held out.
        left_out: Numbers of labels that were left out, by reason.
        is_whole: True if nothing was dropped when the runs were made.
    """

    detector: DetectorRow = field(metadata=HIDDEN)
    classes: tuple[ClassFit, ...]
    precision: float
    fitted_to: int = field(metadata=json_key("images_fitted_to"))
    held_out: int = field(metadata=json_key("images_held_out"))
    left_out: Mapping[str, int]
    is_whole: bool = field(default=True, metadata=HIDDEN)

    belongs_in: ClassVar = "model card"
    also: ClassVar = {"card": "path", "detector": "detector.name", "confidence": "confidence"}

    @property
    def has_threshold(self) -> bool:
        """True if at least one class has a threshold."""
        return any(one.scores and one.scores.threshold is not None for one in self.classes)

    @property
    def exit_status(self) -> int:
        """1 when no class gets a threshold, 3 when runs have drops."""
        if not self.has_threshold:
            return 1
        return 0 if self.is_whole else 3

    @property
    def confidence(self) -> float:
        """Confidence of the bounds on precision."""
        return CONFIDENCE

    @property
    def toml(self) -> str:
        """The sections of the card."""
        return scores_text(self.classes)

    def charts(self) -> Iterator[Chart]:
        """Yield precision and recall of the first classes that were fitted."""
        for one in [one for one in self.classes if one.scores is not None][:MAX_CHARTS]:
            parts = zip(("fitted to", "held out"), one.seen, strict=True)
            yield precision_and_recall(
                f"{visible(one.name)}: precision and recall above each score of the network",
                [(name, part.scores, part.is_right, part.labels) for name, part in parts],
            )

    def report(self) -> Iterator[str]:
        """Yield the numbers of pictures, and the fit of each class."""
        yield (
            f"detector   {self.detector.name}, fitted to {counted(self.fitted_to, 'image')}, "
            f"{self.held_out:,} held out"
        )
        yield from (f"left out   {count:,} {why}" for why, count in self.left_out.items())
        for one in self.classes:
            yield from ("", *_class_lines(one, self.precision))


def _class_lines(one: ClassFit, precision: float) -> list[str]:
    if one.notes == (NOT_LABELLED,):
        return [f"{visible(one.name):10} {NOT_LABELLED}, {counted(one.detections, 'detection')}"]
    what, found = one.counted
    lines = [f"{visible(one.name):10} {what}, {found}, {one.right:,} right"]
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
    has_threshold = one.scores is not None and one.scores.threshold is not None
    if held is not None and has_threshold and not held.of:
        lines.append(f"  held out    no detection above it, recall 0.000 (0 of {held.labels:,})")
    if held is not None:
        start = "" if has_threshold else "held out"
        lines.append(
            f"  {start:11} calibration error {held.error_before:.3f} before, "
            f"{held.error_after:.3f} after, {counted(held.detections, 'detection')}"
        )
    return lines + [f"  {note}" for note in one.notes]


def _calibration_text(one: ClassFit) -> str:
    assert one.scores is not None
    found = one.scores.calibration
    assert found is not None
    return f"platt, slope {found.slope:g}, offset {found.offset:g}"


@dataclass(frozen=True, slots=True)
class DetectorFitSettings:
    """How a detector is fitted to labels, and where the result is written.

    Attributes:
        output: Card to write; may be the same file (default: write none).
        test: Other runs to test the result on.
        test_labels: Labelled boxes of each run of --test, in the same order.
        precision: Required precision.
        calibration: Calibration from scores to probabilities.
        hold_out: Last fraction of each run's images, held out to test the result.
        card: The detector's card (default: the run's).
        detector: Name of the detector, if the run has several.
        kind: Format of the labels (default: detected).
        class_names: Class names, one per line: for YOLO in index order, for VOC and KITTI all
            classes.
        meanings: Class that a label of the file or detector counts as; an empty one ignores it.
        logs: Folder that the run's logs have moved to; they are recognised by content.
        limits: Limits for reading the logs.
        keep: Accept calibrations that are worse on the held-out images.
        overwrite: Replace another existing card.
    """

    output: Annotated[Path | str | None, Option(metavar="CARD.toml")] = None
    _: KW_ONLY
    test: Annotated[Sequence[Run | Path | str], Option(metavar="RUN")] = ()
    test_labels: Annotated[Sequence[Path | str], Option(metavar="LABELS")] = ()
    precision: float = 0.95
    calibration: CalibrationKind = "platt"
    hold_out: Annotated[float, Option(metavar="FRACTION")] = 0.5
    card: Annotated[Path | str | None, Option(metavar="CARD.toml")] = None
    detector: str | None = None
    kind: Annotated[LabelFormat | None, Option("--format")] = None
    class_names: Annotated[Path, Option(metavar="FILE")] | Sequence[str] | str = ()
    meanings: Meanings = field(default_factory=lambda: MappingProxyType({}))
    logs: Annotated[Path | str | None, Option(metavar="DIR")] = None
    limits: LimitsGiven = DEFAULT_LIMITS
    keep: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Check numbers and names.

        Raises:
            UsageError: A value is out of range.
        """
        for name in ("precision", "hold_out"):
            value: float = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise UsageError(f"{name}: {value}, expected above 0 and below 1")
        if self.calibration not in CALIBRATIONS:
            names = ", ".join(CALIBRATIONS)
            raise UsageError(f"calibration: {self.calibration}, expected one of {names}")
        if len(self.test_labels) != len(self.test):
            raise UsageError(
                f"test_labels: got {len(self.test_labels)} for {len(self.test)}; "
                "expected one for each run, in the same order"
            )


@keywords(DetectorFitSettings, 2)
def fit_detector(
    runs: Annotated[Sequence[Run | Path | str], Option()] | Run | Path | str,
    labels: Annotated[Sequence[Path | str], Option("--labels")] | Path | str,
    settings: DetectorFitSettings,
) -> FittedDetector:
    """Fit a detector's thresholds and calibration to labels.

    Each class gets the lowest threshold that reaches the required precision. Precision is judged by
    Clopper and Pearson's one-sided 95 % bound, corrected for the choice among eight thresholds.
    Each class also gets a calibration, so that a score is the probability that a detection is
    correct. The last part of each run's images is held out to test the result, unless --test names
    other runs. A class with too few labelled boxes is reported and keeps its values. The result is
    written into the detector's card.

    LABELS may also be a .csv or .tsv file that says what each picture shows: a heading, with the
    column of the pictures and the classes, and yes or no for each picture and class. The best
    detection of each picture is then right if the picture shows such an object.

    The bounds assume that detections are independent, but those of neighbouring images are not.
    Therefore, use several drives.

    Examples:
        crosscue fit detector runs/A-01 --labels labels.json -o my.toml
        crosscue fit detector runs/* --labels labels/*.json --precision 0.98 -o my.toml

    Args:
        runs: Runs with stored, uncalibrated detections of one detector.
        labels: Labelled boxes of each run's images, in the same order.
        settings: How to fit.

    Raises:
        UsageError: A value is out of range, runs have different detectors, or scores are already
            calibrated.
        SchemaError: Labels cannot be read, or do not belong to the run.
        VehicleError: The card cannot be read.
        OutputError: The card cannot be written.
        FitError: The calibration of a class is worse on the held-out images.
    """
    given = [runs] if isinstance(runs, Run | Path | str) else list(runs)
    theirs = [labels] if isinstance(labels, Path | str) else list(labels)
    if len(theirs) != len(given):
        raise UsageError(
            f"labels: got {len(theirs)} for {len(given)}; expected one for each run, in this order"
        )
    output, card = settings.output, settings.card
    if card is not None:
        # Errors in the card are reported before any run is opened.
        read_card(Path(card))
    places = [run.path if isinstance(run, Run) else run for run in (*given, *settings.test)]
    folders = [open_run(place, settings.logs, limits=settings.limits).folder for place in places]
    listed = class_names_given(settings.class_names)
    theirs += settings.test_labels
    read = [read_box_labels(Path(path), settings.kind, listed) for path in theirs]
    whole = [
        labelled_run(folder, one, settings.detector, dict(settings.meanings))
        for folder, one in zip(folders, read, strict=True)
    ]
    row = _one_detector(whole)
    source = _card_of(row, card, is_needed=output is not None)
    if output is not None and source is not None:
        check_card_place(read_card(source), source, Path(output), overwrite=settings.overwrite)
    fitted, held = _split(whole[: len(given)], whole[len(given) :], settings.hold_out)
    fits = tuple(
        fit_class(
            name,
            whole[0].members[name],
            fitted.judged(name),
            held.judged(name),
            settings.precision,
            CONFIDENCE,
            settings.calibration,
        )
        for name in _common(whole)
    )
    if len({part.is_by_picture for part in whole}) > 1:
        raise UsageError("labels: some are of boxes, others of pictures; expected one kind")
    worse = [one for one in fits if one.held_out and one.held_out.is_worse]
    if worse and not settings.keep:
        errors = ", ".join(
            f"{one.name} {of.error_after:.4f} after, {of.error_before:.4f} before"
            for one in worse
            if (of := one.held_out)
        )
        raise FitError(
            f"fit detector: the calibration error on the held-out images is larger: {errors}; "
            "use more images, --calibration none, or --keep the fit"
        )
    written = None
    if output is not None and source is not None and any(one.scores for one in fits):
        written = Path(output)
        numbers = f"{counted(len(fitted), 'image')} fitted to, {len(held)} held out"
        pictures = f"{numbers}, of {_log_names(whole)}{_date_of(fitted.runs)}"
        aim = f"precision {settings.precision:g} with {CONFIDENCE:.0%} confidence"
        text = with_fit(source.read_text(encoding="utf-8"), fits, pictures, aim)
        write_text(written, text)
    left_out = sum((Counter(part.left_out) for part in whole), Counter[str]())
    is_whole = all(part.is_whole for part in whole)
    counts = len(fitted), len(held), left_out
    return FittedDetector(row, fits, settings.precision, *counts, is_whole, path=written)


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
        raise UsageError(f"card: {row.name} has no model card; name one, or omit the output")
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

    def judged(self, name: str) -> ClassDetections:
        """Match the detections of one class to labels."""
        scores, right, labels = [np.empty(0)], [np.empty(0, np.bool_)], 0
        for run, chosen in zip(self.runs, self.chosen, strict=True):
            if run.is_by_picture:
                best, has = _best_of_pictures(run, chosen, run.classes.index(name))
                found = np.isfinite(best)
                scores.append(best[found])
                right.append(has[found])
                labels += int(has.sum())
                continue
            matched = match(
                *run.part(chosen), run.classes.index(name), overlaps=np.array([OVERLAP])
            )
            judged = ~matched.is_out[0]
            scores.append(matched.scores[judged])
            right.append(matched.is_right[0][judged])
            labels += len(matched.labels)
        unit: LabelUnit = "pictures" if self.runs[0].is_by_picture else "boxes"
        return ClassDetections(np.concatenate(scores), np.concatenate(right), labels, unit)


def _best_of_pictures(
    run: LabelledRun, chosen: np.typing.NDArray[np.bool_], label: int
) -> tuple[Floats, np.typing.NDArray[np.bool_]]:
    """Best score of a class in each chosen picture, and whether the picture shows such an object.

    The score is -inf in a picture without a detection.
    """
    truth, found = run.truth, run.found
    best = np.full(len(chosen), -np.inf)
    is_of = found.label == label
    np.maximum.at(best, found.picture[is_of], found.scores[is_of])
    has = np.zeros(len(chosen), np.bool_)
    has[truth.picture[(truth.label == label) & ~truth.is_ignored]] = True
    return best[chosen], has[chosen]


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
    if not is_date(first):
        return ""
    return f" ({datetime.fromtimestamp(first // 1_000_000_000, UTC):%Y-%m-%d})"
