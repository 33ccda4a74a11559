"""Choose thresholds of stop signs and lights for cards of the catalog, on labelled pictures.

The pictures and their Pascal VOC labels are those of Road Sign Detection (877 pictures,
https://www.kaggle.com/datasets/andrewmvd/road-sign-detection), in the folders ``images`` and
``annotations``. A picture is right or wrong as a whole: its best detection of a class against
whether the class is labelled in it, as a cue of one frame counts.

This rule is the second one: results of both halves had been seen when it was made, so the odd half
is not wholly unseen. Pictures with an even number choose the
lowest of ten thresholds at which, with 95 % confidence (Clopper and Pearson, one-sided, corrected
for ten candidates), at most 3 % of pictures without an object show one. Those with an odd number
decide whether the card gets it: if they show the same (one-sided, not corrected), and if at least
nine tenths of the pictures found at 0.5 are still found. Otherwise the card keeps the default.

    python benchmarks/card_thresholds.py DATA yolox-nano picodet-s

Other pictures are counted at 0.5 and at the card's threshold of a class, without a choice. LABELS
is a table as ``crosscue fit detector`` reads: picture, and yes or no for each class:

    python benchmarks/card_thresholds.py --count FOLDER LABELS yolox-nano picodet-s
"""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.catalog.places import card_named
from crosscue.detectors.networks.model_detector import build

NAMES: Final = {"stop sign": "stop", "traffic light": "trafficlight"}
CANDIDATES: Final = tuple(n / 100 for n in range(50, 100, 5))
FALSE_RATE: Final = 0.03
RISK: Final = 0.05
KEPT: Final = 0.9


@dataclass(frozen=True)
class Half:
    """Best scores of a class in the pictures with and without it."""

    having: NDArray[np.float64]
    lacking: NDArray[np.float64]

    def found(self, score: float) -> int:
        """Number of pictures with an object that is found above a score."""
        return int((self.having > score).sum())

    def wrong(self, score: float) -> int:
        """Number of pictures without an object with a detection above a score."""
        return int((self.lacking > score).sum())

    def is_clean(self, score: float, risk: float) -> bool:
        """Return whether few pictures without an object have a detection."""
        wrong, count = self.wrong(score), len(self.lacking)
        return bool(beta.ppf(1.0 - risk, wrong + 1, count - wrong) <= FALSE_RATE)

    def text(self, score: float) -> str:
        """Counts at a score, with two-sided intervals of 95 %."""
        parts = (self.found(score), len(self.having)), (self.wrong(score), len(self.lacking))
        return "found {}, false {}".format(*(f"{k} of {n} ({_interval(k, n)})" for k, n in parts))


def _interval(right: int, count: int) -> str:
    if not count:
        return "none labelled"
    low = 100.0 * beta.ppf(RISK / 2, right, count - right + 1) if right else 0.0
    high = 100.0 * beta.ppf(1 - RISK / 2, right + 1, count - right) if right < count else 100.0
    return f"{low:.1f} to {high:.1f} %"


def _labelled(data: Path) -> Iterator[tuple[int, Path, set[str]]]:
    for file in sorted((data / "annotations").glob("road*.xml")):
        names = set(re.findall("<name>(.*?)</name>", file.read_text()))
        number = int(file.stem.removeprefix("road"))
        yield number, data / "images" / f"{file.stem}.png", names


def _best(detector: Detector, pictures: Sequence[Path]) -> dict[str, list[float]]:
    """Best score of each class in each picture."""
    best: dict[str, list[float]] = {label: [] for label in NAMES}
    for picture in pictures:
        pixels = np.asarray(cv2.imread(str(picture)), np.uint8)
        frame = Frame(0, "", pixels, (pixels.shape[1], pixels.shape[0]))
        (found,) = detector([frame])
        assert isinstance(found, Detections)
        for label, scores in best.items():
            is_it = np.array([one == label for one in found.labels], np.bool_)
            scores.append(float(found.scores[is_it].max(initial=0.0)))
    return best


def _count(folder: Path, labels: Path, names: Sequence[str]) -> int:
    """Print what cards find in pictures that are labelled as wholes."""
    with labels.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for name in names:
        detector = build(card=str(card_named(name)))
        best = _best(detector, [folder / row["picture"] for row in rows])
        thresholds = getattr(detector, "min_scores", {})
        for label in NAMES.keys() & rows[0].keys():
            has = np.array([row[label] == "yes" for row in rows])
            score = np.array(best[label])
            for at in sorted({0.5, thresholds.get(label, 0.5)}):
                print(f"{name} {label} above {at:.2f}: {Half(score[has], score[~has]).text(at)}")
    return 0


def main() -> int:
    """Print the choice for each card and class, and what the other half shows."""
    if sys.argv[1] == "--count":
        return _count(Path(sys.argv[2]), Path(sys.argv[3]), sys.argv[4:])
    labelled = list(_labelled(Path(sys.argv[1])))
    for name in sys.argv[2:]:
        best = _best(build(card=str(card_named(name))), [picture for _, picture, _ in labelled])
        is_odd = np.array([number % 2 == 1 for number, _, _ in labelled])
        for label, known in NAMES.items():
            has, score = np.array([known in names for *_, names in labelled]), np.array(best[label])
            chosen = [Half(score[has & one], score[~has & one]) for one in (~is_odd, is_odd)]
            _report(name, label, *chosen)
    return 0


def _report(name: str, label: str, fit: Half, test: Half) -> None:
    clean = [s for s in CANDIDATES if fit.is_clean(s, RISK / len(CANDIDATES))]
    print(f"{name} {label}")
    print(f"  0.50 chosen on: {fit.text(0.5)}; kept aside: {test.text(0.5)}")
    if not clean:
        print("  no threshold is clean enough: the default stays")
        return
    is_kept = test.found(clean[0]) >= KEPT * test.found(0.5)
    verdict = "into the card" if test.is_clean(clean[0], RISK) and is_kept else "the default stays"
    texts = f"chosen on: {fit.text(clean[0])}; kept aside: {test.text(clean[0])}"
    print(f"  {clean[0]:.2f} {texts}: {verdict}")


if __name__ == "__main__":
    sys.exit(main())
