"""Choice of the sign threshold for a required precision, measured on other pictures."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Final

import numpy as np

from crosscue.detectors.signs.detector import build
from crosscue.detectors.signs.templates import AMERICAN, KINDS, Kind
from crosscue.detectors.training.operating_point import (
    Verdicts,
    concatenate_verdicts,
    rates_at,
    threshold_at_precision,
)
from crosscue.eval.fit.signs.labels import ScoringRules, judged_pictures
from crosscue.eval.fit.vehicle_output import Fitted
from crosscue.eval.report.chart import Chart, precision_and_recall
from crosscue.eval.scoring.intervals import Proportion, between, fraction
from crosscue.replay.errors import EmptyResultError, UsageError
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted
from crosscue.results import HIDDEN, json_key
from crosscue.verb import Option, keywords

LOWEST: Final = 0.05
# Min IoU of a right detection with a sign.
OVERLAP: Final = 0.4


@dataclass(frozen=True, slots=True)
class SignRates:
    """Precision and recall, with intervals over rows and over files or drives."""

    precision: Proportion
    recall: Proportion

    def as_json(self) -> dict[str, object]:
        """Return counts, rates and intervals."""
        found: dict[str, object] = {
            "found": self.precision.of,
            "right": self.recall.right,
            "signs": self.recall.of,
        }
        for name, part in (("precision", self.precision), ("recall", self.recall)):
            found[name] = part.value
            found[f"{name}_interval"] = (part.low, part.high)
            found[f"{name}_interval_by_drive"] = (part.clusters_low, part.clusters_high)
        return found


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SignFit(Fitted):
    """A threshold and the judged detections behind it.

    Attributes:
        threshold: Value for ``min_score``; None if no threshold is precise enough.
        chosen_on: Detections on which it was chosen, a part for each file or drive.
        others: Detections on which it is measured, in the same form.
    """

    threshold: float | None = field(metadata=json_key("min_score"))
    chosen_on: Sequence[Verdicts] = field(metadata=HIDDEN)
    others: Sequence[Verdicts] = field(metadata=HIDDEN)

    also: ClassVar = {"chosen_on": "chosen_rates", "other_frames": "other_rates"}

    @property
    def exit_status(self) -> int:
        """1 when no threshold is precise enough, else 0."""
        return 1 if self.threshold is None else 0

    @property
    def chosen_rates(self) -> SignRates | None:
        """Rates on the pictures of the choice."""
        return None if self.threshold is None else self.rates(self.threshold, on_others=False)

    @property
    def other_rates(self) -> SignRates | None:
        """Rates on the held-out pictures."""
        return None if self.threshold is None else self.rates(self.threshold)

    def rates(self, threshold: float, *, on_others: bool = True) -> SignRates:
        """Return precision and recall at any threshold, by default on the held-out pictures."""
        parts = self.others if on_others else self.chosen_on
        counts = [rates_at(part, threshold) for part in parts]
        return SignRates(
            _fraction([(one.right, one.found) for one in counts]),
            _fraction([(one.right, one.signs) for one in counts]),
        )

    @property
    def toml(self) -> str:
        """The detector's settings in a vehicle file."""
        if self.threshold is None:
            return ""
        return f"[detectors.signs.settings]\nmin_score = {self.threshold:g}\n"

    def charts(self) -> Iterator[Chart]:
        """Yield precision and recall on both halves."""
        parts = ("chosen on", self.chosen_on), ("other frames", self.others)
        judged = [(name, concatenate_verdicts([*part])) for name, part in parts]
        yield precision_and_recall(
            "Precision and recall above each score",
            [(name, one.scores, one.is_right, one.signs) for name, one in judged],
        )

    def report(self) -> Iterator[str]:
        """Yield the threshold, and precision and recall on both halves."""
        if self.threshold is None:
            signs = sum(part.signs for part in self.chosen_on)
            yield f"no threshold is precise enough on {counted(signs, 'sign')}"
            return
        yield f"min_score = {self.threshold:g}"
        for name, on_others in (("chosen on", False), ("other frames", True)):
            rates = self.rates(self.threshold, on_others=on_others)
            yield f"{name:13} {_proportion_text('precision', rates.precision)}"
            yield f"{'':13} {_proportion_text('recall', rates.recall)}"


Fraction = Annotated[float, Option(metavar="FRACTION")]


@dataclass(frozen=True, slots=True)
class SignFitSettings:
    """Which signs are searched for, how, and how the threshold is chosen.

    Attributes:
        label: Labels that share the threshold.
        test: Other files or drives to measure on.
        test_every: Measure on every Nth image.
        kinds: Templates to search for: one way left, one way right, do not enter, or no entry.
        crop_top: Top fraction of the image to skip.
        crop_bottom: Bottom fraction of the image to skip.
        precision: Required precision.
        threshold: Measure this threshold instead of choosing one.
        min_height_px: Ignore true signs lower than this, in pixels.
        limits: Limits for reading drives' logs.
    """

    label: Annotated[Sequence[str], Option("--label", metavar="LABEL")]
    _: KW_ONLY
    test: Annotated[Sequence[Path | str], Option(metavar="LABELS")] = ()
    test_every: int = 1
    kinds: Annotated[Sequence[Kind], Option(metavar="KIND")] = AMERICAN
    crop_top: Fraction = 0.0
    crop_bottom: Fraction = 0.25
    precision: float = 0.95
    threshold: float | None = None
    min_height_px: Annotated[float, Option("--min-height")] = 0.0
    limits: LimitsGiven = DEFAULT_LIMITS

    def __post_init__(self) -> None:
        """Check numbers and names.

        Raises:
            UsageError: A value is out of range.
        """
        if not 0.0 < self.precision <= 1.0:
            raise UsageError(f"precision: {self.precision}, expected above 0, at most 1")
        if self.test_every < 1:
            raise UsageError(f"test_every: {self.test_every}, expected 1 or more")
        if self.threshold is not None and not LOWEST <= self.threshold <= 1.0:
            raise UsageError(f"threshold: {self.threshold}, expected {LOWEST} to 1")
        for kind in self.kinds:
            if kind not in KINDS:
                raise UsageError(f"kinds: {kind}, expected one of {', '.join(KINDS)}")


@keywords(SignFitSettings)
def fit_signs(labels: Sequence[Path | str], settings: SignFitSettings) -> SignFit:
    """Fit the sign threshold to a required precision.

    LABELS is a CSV file with the columns picture,label,x0,y0,x1,y1 and one row per sign (an empty
    label for a picture without signs), a COCO file as crosscue train frames writes it, or the
    folder of a drive with annotated objects. The threshold is chosen on every second picture and
    measured on the others, unless --test names other files or drives. --threshold measures the
    given threshold instead.

    Examples:
        crosscue fit signs labels.csv --label "do not enter" --kinds "no entry" --precision 0.95
        crosscue fit signs fit/coco.json --test drives/* --label "one way left" "one way right"

    Args:
        labels: CSV or COCO files of boxes, or folders of drives.
        settings: Which signs are searched for, and how.

    Raises:
        UsageError: A value is out of range.
        EmptyResultError: The pictures contain no such sign.
    """
    threshold, test = settings.threshold, settings.test
    detector = build(
        kinds=tuple(settings.kinds),
        min_score=LOWEST,
        crop_top=settings.crop_top,
        crop_bottom=settings.crop_bottom,
    )
    rules = ScoringRules(settings.label, OVERLAP, settings.min_height_px)
    fit = slice(0, None, 1 if test else 2)
    rest = slice(0 if test else 1, None, settings.test_every * fit.step)
    work = [(Path(path), fit) for path in labels]
    work += [(Path(path), rest) for path in test or labels]
    parts: list[Verdicts] = []
    for path, which in work:
        parts.append(judged_pictures(path, detector, rules, which, settings.limits))
        emit(Progress("looking", len(parts), len(work), "sets"))
    chosen_on, others = parts[: len(labels)], parts[len(labels) :]
    if not sum(part.signs for part in chosen_on):
        wanted = " or ".join(settings.label)
        raise EmptyResultError(f"{labels[0]}: no {wanted} in the pictures to choose on; add some")
    if threshold is None:
        threshold = _shown(
            threshold_at_precision(concatenate_verdicts(chosen_on), settings.precision)
        )
    return SignFit(threshold, chosen_on, others)


def _shown(score: float | None) -> float | None:
    """Round a score down to the printed digits, so that rates belong to the printed number."""
    return None if score is None else math.floor(score * 1e6) / 1e6


def _fraction(counts: Sequence[tuple[int, int]]) -> Proportion:
    is_right = [np.arange(of) < right for right, of in counts]
    which = np.repeat(np.arange(len(counts)), [of for _, of in counts])
    return fraction(np.concatenate(is_right), which)


def _proportion_text(name: str, part: Proportion) -> str:
    if not part.of:
        return f"{name:9} none (0 of 0)"
    interval = f"95 % interval {between(part.low, part.high)}"
    interval += f", by drive {between(part.clusters_low, part.clusters_high)}"
    return f"{name:9} {part.value:.2f} ({part.right} of {part.of}; {interval})"
