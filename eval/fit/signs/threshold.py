"""Choice of the sign threshold for a required precision, measured on other pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.detectors.signs.detector import build
from crosscue.detectors.signs.templates import AMERICAN, KINDS
from crosscue.detectors.training.operating_point import Judged, rates_at, threshold_for, together
from crosscue.eval.fit.signs.scores import Rules, judged_pictures
from crosscue.eval.scoring.intervals import TOO_FEW, Proportion, fraction
from crosscue.replay.base import DEFAULT_LIMITS, EmptyResultError, Limits, UsageError

Progress = Callable[[Iterable[Judged], Callable[[], tuple[int, int]]], Iterable[Judged]]
"""Function that passes parts through and shows progress; the second argument returns the number of
parts done and the total."""

LOWEST: Final = 0.05


@dataclass(frozen=True, slots=True)
class SignRates:
    """Precision and recall, with intervals over rows and over files or drives."""

    precision: Proportion
    recall: Proportion


@dataclass(frozen=True, slots=True, eq=False)
class SignFit:
    """A threshold and the judged detections behind it.

    Attributes:
        threshold: Value for ``min_score``; None if no threshold is precise enough.
        chosen_on: Detections on which it was chosen, a part for each file or drive.
        others: Detections on which it is measured, in the same form.
    """

    threshold: float | None
    chosen_on: Sequence[Judged]
    others: Sequence[Judged]

    def rates(self, threshold: float, *, on_others: bool = True) -> SignRates:
        """Return precision and recall at any threshold, by default on the held-out pictures."""
        parts = self.others if on_others else self.chosen_on
        counts = [rates_at(part, threshold) for part in parts]
        return SignRates(
            _fraction([(one.right, one.found) for one in counts]),
            _fraction([(one.right, one.signs) for one in counts]),
        )

    def as_dict(self) -> dict[str, object]:
        """Return the object that ``crosscue fit signs --json`` prints."""
        tree: dict[str, object] = {"min_score": self.threshold}
        of = self.threshold
        for name, on_others in (("chosen_on", False), ("other_frames", True)):
            tree[name] = None if of is None else _tree(self.rates(of, on_others=on_others))
        return tree

    def __repr__(self) -> str:
        if self.threshold is None:
            signs = sum(part.signs for part in self.chosen_on)
            return f"no threshold is precise enough on {signs} signs"
        lines = [f"min_score = {self.threshold:g}"]
        for name, on_others in (("chosen on", False), ("other frames", True)):
            rates = self.rates(self.threshold, on_others=on_others)
            lines.append(f"{name:13} {_proportion_text('precision', rates.precision)}")
            lines.append(f"{'':13} {_proportion_text('recall', rates.recall)}")
        return "\n".join(lines)


def fit_signs(
    labels: Sequence[Path | str],
    label: Sequence[str],
    *,
    test: Sequence[Path | str] = (),
    test_every: int = 1,
    kinds: Sequence[str] = AMERICAN,
    precision: float = 0.95,
    threshold: float | None = None,
    overlap: float = 0.4,
    min_height_px: float = 0.0,
    crop_top: float = 0.0,
    crop_bottom: float = 0.25,
    enlarge: float = 2.5,
    levels: int = 14,
    points: int = 4000,
    limits: Limits = DEFAULT_LIMITS,
    progress: Progress = lambda parts, done: parts,
) -> SignFit:
    """Choose the sign detector's threshold for a required precision.

    The threshold is chosen on every second picture and measured on the others, unless ``test``
    names other pictures.

    Args:
        labels: CSV files ``picture,label,x0,y0,x1,y1``, COCO files, or folders of drives.
        label: The labels to choose one threshold for.
        test: Other files or drives to measure on.
        test_every: Measure on every Nth picture only.
        kinds: Drawings to search for.
        precision: Required precision, above 0 and up to 1.
        threshold: Measure this threshold instead of choosing one.
        overlap: Min intersection over union of a right detection with the true box.
        min_height_px: Min height of a true sign; smaller ones count neither as found nor as missed.
        crop_top: Fraction of the picture that is not searched, at the top.
        crop_bottom: Fraction that is not searched, at the bottom.
        enlarge: Enlargement of the first level of the pyramid, for small signs.
        levels: Number of levels of the pyramid.
        points: Number of points kept at a level.
        limits: Limits for reading drives' logs.
        progress: Function that passes the parts through and shows progress.

    Raises:
        UsageError: A value is out of range.
        EmptyResultError: The pictures contain no such sign.
    """
    _check(precision, overlap, test_every, threshold, kinds)
    detector = build(
        kinds=tuple(kinds),
        min_score=LOWEST,
        crop_top=crop_top,
        crop_bottom=crop_bottom,
        enlarge=enlarge,
        levels=levels,
        points=points,
    )
    rules = Rules(label, overlap, min_height_px)
    fit = slice(0, None, 1 if test else 2)
    rest = slice(0 if test else 1, None, test_every * fit.step)
    work = [(Path(path), fit) for path in labels]
    work += [(Path(path), rest) for path in test or labels]
    parts: list[Judged] = []
    made = (judged_pictures(path, detector, rules, which, limits) for path, which in work)
    for part in progress(made, lambda: (len(parts), len(work))):
        parts.append(part)
    chosen_on, others = parts[: len(labels)], parts[len(labels) :]
    if not sum(part.signs for part in chosen_on):
        raise EmptyResultError(
            f"{labels[0]}: no {' or '.join(label)} in the pictures to choose on; add some"
        )
    if threshold is None:
        threshold = _shown(threshold_for(together(chosen_on), precision))
    return SignFit(threshold, chosen_on, others)


def _check(
    precision: float, overlap: float, every: int, threshold: float | None, kinds: Sequence[str]
) -> None:
    for name, value in (("precision", precision), ("overlap", overlap)):
        if not 0.0 < value <= 1.0:
            raise UsageError(f"--{name} {value}: expected above 0, at most 1")
    if every < 1:
        raise UsageError(f"--test-every {every}: expected 1 or more")
    if threshold is not None and not LOWEST <= threshold <= 1.0:
        raise UsageError(f"--threshold {threshold}: expected {LOWEST} to 1")
    for kind in kinds:
        if kind not in KINDS:
            raise UsageError(f"--kinds {kind}: no such drawing; there are: {', '.join(KINDS)}")


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
    interval = f"95 % interval {part.low:.2f} to {part.high:.2f}"
    by_drive = f"{part.clusters_low:.2f} to {part.clusters_high:.2f}"
    interval += f", by drive {TOO_FEW if math.isnan(part.clusters_low) else by_drive}"
    return f"{name:9} {part.value:.2f} ({part.right} of {part.of}; {interval})"


def _tree(rates: SignRates) -> dict[str, object]:
    found: dict[str, object] = {
        "found": rates.precision.of,
        "right": rates.recall.right,
        "signs": rates.recall.of,
    }
    for name, part in (("precision", rates.precision), ("recall", rates.recall)):
        found[name] = part.value
        found[f"{name}_interval"] = (part.low, part.high)
        found[f"{name}_interval_by_drive"] = (part.clusters_low, part.clusters_high)
    return found
