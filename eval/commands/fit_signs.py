"""Choose the sign detector's threshold for a wanted precision, and tell how good it is elsewhere.

LABELS is a CSV file: picture,label,x0,y0,x1,y1 with one row for each sign (or an empty label for a
picture without any), or a COCO file as crosscue train frames writes it. Every second picture
chooses the threshold, the others measure it, unless --test names another file.

examples:
  crosscue fit signs labels.csv --label "do not enter" --kinds "no entry" --precision 0.95
  crosscue fit signs fit/coco.json --test other/coco.json --label "one way left" "one way right"
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.detectors.sign_detector import build
from crosscue.detectors.sign_drawings import AMERICAN, KINDS
from crosscue.detectors.sign_threshold import Judged, Rates, rates_at, threshold_for, wilson
from crosscue.eval.sign_labels import judged_pictures, read_labels
from crosscue.replay.errors import UsageError

from .common import print_json

LOWEST = 0.05


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("labels", type=Path, metavar="LABELS", help="CSV or COCO file of boxes")
    parser.add_argument("--test", type=Path, metavar="LABELS", help="other frames to measure on")
    parser.add_argument("--label", required=True, nargs="+",
                        help="the labels to choose one threshold for")  # fmt: skip
    parser.add_argument(
        "--kinds", nargs="+", default=list(AMERICAN), choices=KINDS, help="drawings to look for"
    )
    parser.add_argument("--crop-top", type=float, default=0.0, help="share not searched")
    parser.add_argument("--crop-bottom", type=float, default=0.25, help="share not searched")
    parser.add_argument(
        "--enlarge", type=float, default=2.5, help="the first level, for small signs"
    )
    parser.add_argument("--levels", type=int, default=9, help="of the pyramid, each 1.25 smaller")
    parser.add_argument("--points", type=int, default=4000, help="kept at a level")
    parser.add_argument("--precision", type=float, default=0.95, help="wanted, 0 to 1")
    parser.add_argument(
        "--overlap", type=float, default=0.4, help="with the true box, to be right (0 to 1)"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Choose and tell; 1 when no threshold is precise enough."""
    for name in ("precision", "overlap"):
        if not 0.0 < getattr(args, name) <= 1.0:
            raise UsageError(f"--{name} {getattr(args, name)}: want above 0, at most 1")
    pictures = read_labels(args.labels)
    rest = read_labels(args.test) if args.test else pictures[1::2]
    chosen_on = pictures if args.test else pictures[0::2]
    detector = build(
        kinds=tuple(args.kinds), least_score=LOWEST,
        crop_top=args.crop_top, crop_bottom=args.crop_bottom,
        enlarge=args.enlarge, levels=args.levels, points=args.points,
    )  # fmt: skip
    fitted = judged_pictures(chosen_on, detector, args.label, args.overlap)
    if not fitted.signs:
        raise UsageError(
            f"{args.labels}: no {' or '.join(args.label)} in the pictures that choose; add some"
        )
    tested = judged_pictures(rest, detector, args.label, args.overlap)
    score = threshold_for(fitted, args.precision)
    if args.json:
        print_json(_as_json(score, fitted, tested))
    elif not args.quiet:
        print(_told(score, fitted, tested, args.precision))
    return 0 if score is not None else 1


def _told(score: float | None, fitted: Judged, tested: Judged, precision: float) -> str:
    if score is None:
        return f"no threshold reaches precision {precision} on {fitted.signs} signs"
    lines = [f"least_score = {score:.3f}"]
    for name, judged in (("chosen on", fitted), ("other frames", tested)):
        rates = rates_at(judged, score)
        lines.append(f"{name:13} {_share('precision', rates.right, rates.found)}")
        lines.append(f"{'':13} {_share('recall', rates.right, rates.signs)}")
    return "\n".join(lines)


def _share(name: str, right: int, of: int) -> str:
    low, high = wilson(right, of)
    share = f"{right / of:.2f}" if of else "none"
    return f"{name:9} {share} ({right} of {of}; 95 % interval {low:.2f} to {high:.2f})"


def _as_json(score: float | None, fitted: Judged, tested: Judged) -> dict[str, object]:
    out: dict[str, object] = {"least_score": score}
    for name, judged in (("chosen_on", fitted), ("other_frames", tested)):
        out[name] = None if score is None else _rates(rates_at(judged, score))
    return out


def _rates(rates: Rates) -> dict[str, object]:
    return {
        "found": rates.found,
        "right": rates.right,
        "signs": rates.signs,
        "precision": rates.precision,
        "precision_interval": wilson(rates.right, rates.found),
        "recall": rates.recall,
        "recall_interval": wilson(rates.right, rates.signs),
    }
