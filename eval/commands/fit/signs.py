"""Choose the sign detector's threshold for a wanted precision, and measure it elsewhere.

LABELS is a CSV file: picture,label,x0,y0,x1,y1 with one row for each sign (or an empty label for a
picture without any), a COCO file as crosscue train frames writes it, or the folder of a drive with
annotated objects. Every second picture chooses the threshold, the others measure it, unless --test
names other files or drives. --threshold measures a threshold instead of choosing one.

examples:
  crosscue fit signs labels.csv --label "do not enter" --kinds "no entry" --precision 0.95
  crosscue fit signs fit/coco.json --test drives/* --label "one way left" "one way right"
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from crosscue.detectors.signs.detector import build
from crosscue.detectors.signs.templates import AMERICAN, KINDS
from crosscue.detectors.training.operating_point import Judged, rates_at, threshold_for, together
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.eval.fit.sign_scores import Rules, judged_pictures
from crosscue.eval.scoring.intervals import Proportion, share
from crosscue.replay.errors import UsageError

LOWEST = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "labels",
        type=Path,
        nargs="+",
        metavar="LABELS",
        help="CSV or COCO file of boxes, or a drive's folder",
    )
    parser.add_argument(
        "--test",
        type=Path,
        nargs="+",
        metavar="LABELS",
        default=[],
        help="other frames to measure on",
    )
    parser.add_argument(
        "--test-every", type=int, default=1, metavar="N", help="measure on every Nth image"
    )
    parser.add_argument(
        "--label", required=True, nargs="+", metavar="LABEL", help="labels that share the threshold"
    )
    parser.add_argument(
        "--kinds",
        nargs="+",
        default=list(AMERICAN),
        choices=KINDS,
        metavar="KIND",
        help=f"templates to search for, from: {', '.join(KINDS)}",
    )
    parser.add_argument(
        "--crop-top",
        type=float,
        default=0.0,
        metavar="FRACTION",
        help="top fraction of the image to skip",
    )
    parser.add_argument(
        "--crop-bottom",
        type=float,
        default=0.25,
        metavar="FRACTION",
        help="bottom fraction of the image to skip",
    )
    parser.add_argument(
        "--enlarge",
        type=float,
        default=2.5,
        metavar="X",
        help="magnification of the first pyramid level (default: 2.5)",
    )
    parser.add_argument(
        "--levels",
        type=int,
        default=9,
        metavar="N",
        help="pyramid levels, each smaller by 1.25 (default: 9)",
    )
    parser.add_argument(
        "--points", type=int, default=4000, metavar="N", help="keypoints per level (default: 4000)"
    )
    parser.add_argument(
        "--precision",
        type=float,
        default=0.95,
        metavar="P",
        help="required precision (default: 0.95)",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        metavar="P",
        help="measure this threshold instead of choosing one",
    )
    parser.add_argument(
        "--overlap",
        type=float,
        default=0.4,
        metavar="IOU",
        help="min IoU with the true box of a true positive (default: 0.4)",
    )
    parser.add_argument(
        "--min-height",
        type=float,
        default=0.0,
        metavar="PX",
        help="ignore true signs lower than this, in pixels",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Choose and report; 1 when no threshold is precise enough."""
    for name in ("precision", "overlap"):
        if not 0.0 < getattr(args, name) <= 1.0:
            raise UsageError(f"--{name} {getattr(args, name)}: want above 0, at most 1")
    if args.test_every < 1:
        raise UsageError(f"--test-every {args.test_every}: want 1 or more")
    if args.threshold is not None and not LOWEST <= args.threshold <= 1.0:
        raise UsageError(f"--threshold {args.threshold}: want {LOWEST} to 1")
    fitted, tested = _judged(args)
    if not sum(part.signs for part in fitted):
        raise UsageError(
            f"{args.labels[0]}: no {' or '.join(args.label)} in the pictures that choose; add some"
        )
    score = args.threshold
    if score is None:
        score = _shown(threshold_for(together(fitted), args.precision))
    if args.json:
        print_json(_as_json(score, fitted, tested))
    elif not args.quiet:
        print(_report_text(score, fitted, tested, args.precision))
    return 0 if score is not None else 1


def _shown(score: float | None) -> float | None:
    """With as many digits as are printed, rounded down: what is printed belongs to that number."""
    return None if score is None else math.floor(score * 1e6) / 1e6


def _judged(args: argparse.Namespace) -> tuple[list[Judged], list[Judged]]:
    """What choosing and measuring pictures say, a part for each file or drive."""
    detector = build(
        kinds=tuple(args.kinds),
        least_score=LOWEST,
        crop_top=args.crop_top,
        crop_bottom=args.crop_bottom,
        enlarge=args.enlarge,
        levels=args.levels,
        points=args.points,
    )
    rules = Rules(args.label, args.overlap, args.min_height)
    fit = slice(0, None, 1 if args.test else 2)
    rest = slice(0 if args.test else 1, None, args.test_every * fit.step)
    work = [(path, fit) for path in args.labels]
    work += [(path, rest) for path in args.test or args.labels]
    parts: list[Judged] = []
    made = (judged_pictures(path, detector, rules, which) for path, which in work)
    for part in with_progress(made, lambda: Done(len(parts), len(work), "sets"), args, "looking"):
        parts.append(part)
    return parts[: len(args.labels)], parts[len(args.labels) :]


@dataclass(frozen=True, slots=True)
class _Rates:
    """Precision and recall, with intervals over rows and over files or drives."""

    precision: Proportion
    recall: Proportion


def _rates(parts: Sequence[Judged], score: float) -> _Rates:
    counts = [rates_at(part, score) for part in parts]
    return _Rates(
        _share([(one.right, one.found) for one in counts]),
        _share([(one.right, one.signs) for one in counts]),
    )


def _share(counts: Sequence[tuple[int, int]]) -> Proportion:
    is_right = [np.arange(of) < right for right, of in counts]
    which = np.repeat(np.arange(len(counts)), [of for _, of in counts])
    return share(np.concatenate(is_right), which)


def _report_text(
    score: float | None, fitted: Sequence[Judged], tested: Sequence[Judged], precision: float
) -> str:
    if score is None:
        signs = sum(part.signs for part in fitted)
        return f"no threshold reaches precision {precision} on {signs} signs"
    lines = [f"least_score = {score:g}"]
    for name, parts in (("chosen on", fitted), ("other frames", tested)):
        rates = _rates(parts, score)
        lines.append(f"{name:13} {_proportion_text('precision', rates.precision)}")
        lines.append(f"{'':13} {_proportion_text('recall', rates.recall)}")
    return "\n".join(lines)


def _proportion_text(name: str, part: Proportion) -> str:
    if not part.of:
        return f"{name:9} none (0 of 0)"
    interval = f"95 % interval {part.low:.2f} to {part.high:.2f}"
    if not math.isnan(part.clusters_low):
        interval += f", by drive {part.clusters_low:.2f} to {part.clusters_high:.2f}"
    return f"{name:9} {part.value:.2f} ({part.right} of {part.of}; {interval})"


def _as_json(
    score: float | None, fitted: Sequence[Judged], tested: Sequence[Judged]
) -> dict[str, object]:
    out: dict[str, object] = {"least_score": score}
    for name, parts in (("chosen_on", fitted), ("other_frames", tested)):
        out[name] = None if score is None else _tree(_rates(parts, score))
    return out


def _tree(rates: _Rates) -> dict[str, object]:
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
