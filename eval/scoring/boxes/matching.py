"""Match detections to labelled boxes by COCO's rules, as in pycocotools.

In order of decreasing score, each detection is matched to the free label of its class with the
largest overlap (intersection over union), if that is large enough. An ignored region can be matched
any number of times, and the overlap with it is the fraction of the detection inside it. Detections
matched to an ignored label are neither right nor wrong. A part (a size, a range) ignores labels
outside it, and unmatched detections outside it.
"""

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import ColumnSet, Floats, Int64s

Bools: TypeAlias = NDArray[np.bool_]

# COCO's overlap thresholds; average precision is the mean over them.
OVERLAPS: Final = np.linspace(0.5, 0.95, 10)
# Max detections of one class in one picture, as in COCO; those of lower scores are left out.
MAX_DETECTIONS: Final = 100
NOBODY: Final = -1


@dataclass(frozen=True, slots=True, eq=False)
class LabelledBoxes(ColumnSet):
    """N boxes in labelled pictures, as columns.

    Attributes:
        picture: Shape (N,): number of the picture.
        label: Shape (N,): number of the class; ``NOBODY`` for a region of any class.
        boxes_px: Shape (N, 4): x0, y0, x1, y1.
        scores: Shape (N,); 1 for labels.
        is_ignored: Shape (N,): True for labels that are not judged.
        range_m: Shape (N,): range from the camera, NaN unknown.
    """

    picture: Int64s
    label: Int64s
    boxes_px: Floats
    scores: Floats
    is_ignored: Bools
    range_m: Floats

    def __post_init__(self) -> None:
        """Check the shapes of the columns."""
        n = len(self.picture)
        if self.boxes_px.shape != (n, 4):
            raise ValueError(f"boxes_px: expected ({n}, 4), got {self.boxes_px.shape}")
        for name in ("label", "scores", "is_ignored", "range_m"):
            if getattr(self, name).shape != (n,):
                raise ValueError(f"{name}: expected ({n},), got {getattr(self, name).shape}")

    @property
    def areas_px2(self) -> Floats:
        """Areas, shape (N,)."""
        return np.asarray(np.prod(self.boxes_px[:, 2:] - self.boxes_px[:, :2], axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class BoxSelection:
    """Selection of the boxes to judge, by area and by range.

    Attributes:
        name: Name, as printed.
        areas_px2: Interval of areas, both ends included, as in COCO.
        ranges_m: Half-open interval of ranges; None for any range, known or not.
    """

    name: str
    areas_px2: tuple[float, float] = (0.0, 1e10)
    ranges_m: tuple[float, float] | None = None

    def holds(self, boxes: LabelledBoxes) -> Bools:
        """Return True for boxes of this part, shape (N,)."""
        low, high = self.areas_px2
        areas = boxes.areas_px2
        inside = (areas >= low) & (areas <= high)
        if self.ranges_m is not None:
            # Comparisons with NaN are false, so boxes without a range are in no part.
            inside &= (boxes.range_m >= self.ranges_m[0]) & (boxes.range_m < self.ranges_m[1])
        return np.asarray(inside)


ALL: Final = BoxSelection("all")
# COCO's sizes, in pixels of the camera's picture.
SIZES: Final = (
    BoxSelection("small", (0.0, 32.0**2)),
    BoxSelection("medium", (32.0**2, 96.0**2)),
    BoxSelection("large", (96.0**2, 1e10)),
)
RANGES: Final = tuple(
    BoxSelection(
        f"{low:g} to {high:g} m" if np.isfinite(high) else f"over {low:g} m", ranges_m=(low, high)
    )
    for low, high in ((0.0, 20.0), (20.0, 40.0), (40.0, 60.0), (60.0, np.inf))
)


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Detections of one class and their matched labels, best first over all pictures.

    Attributes:
        picture: Shape (D,).
        scores: Shape (D,), decreasing.
        row: Shape (D,): row of the detection.
        took: Shape (T, D): row of the label matched at each overlap, or ``NOBODY``.
        is_out: Shape (T, D): True if neither right nor wrong.
        labels: Shape (L,): pictures of the labels to detect.
    """

    picture: Int64s
    scores: Floats
    row: Int64s
    took: Int64s
    is_out: Bools
    labels: Int64s

    @property
    def is_right(self) -> Bools:
        """Shape (T, D)."""
        return np.asarray((self.took != NOBODY) & ~self.is_out)

    @property
    def is_wrong(self) -> Bools:
        """Shape (T, D)."""
        return np.asarray((self.took == NOBODY) & ~self.is_out)


def match(
    truth: LabelledBoxes,
    found: LabelledBoxes,
    label: int,
    part: BoxSelection = ALL,
    overlaps: Floats = OVERLAPS,
) -> Matched:
    """Match one class in all pictures.

    Args:
        truth: Labels; regions of any class apply to every class.
        found: Detections.
        label: Number of the class.
        part: Boxes to judge.
        overlaps: Shape (T,): min overlaps of a correct detection.
    """
    mine = np.flatnonzero((truth.label == label) | (truth.label == NOBODY))
    their = np.flatnonzero(found.label == label)
    in_part, found_in_part = part.holds(truth), part.holds(found)
    is_out_of_part = truth.is_ignored | ~in_part
    by_picture = _by_picture(truth.picture[mine], mine)
    rows: list[Int64s] = []
    took: list[Int64s] = []
    out: list[Bools] = []
    for picture, some in sorted(_by_picture(found.picture[their], their).items()):
        best = some[np.argsort(-found.scores[some], kind="mergesort")][:MAX_DETECTIONS]
        labels = by_picture.get(picture, np.empty(0, np.int64))
        # COCO's order: judged labels before ignored ones.
        labels = labels[np.argsort(is_out_of_part[labels], kind="mergesort")]
        taken, is_out = _match_one(
            found.boxes_px[best],
            truth.boxes_px[labels],
            is_out_of_part[labels],
            truth.is_ignored[labels],
            overlaps,
        )
        is_out |= (taken == NOBODY) & ~found_in_part[best]
        rows.append(best)
        took.append(np.where(taken == NOBODY, NOBODY, labels[taken] if len(labels) else NOBODY))
        out.append(is_out)
    row = np.concatenate([np.empty(0, np.int64), *rows])
    order = np.argsort(-found.scores[row], kind="mergesort")
    steps = len(overlaps)
    return Matched(
        found.picture[row][order],
        found.scores[row][order],
        row[order],
        np.concatenate([np.empty((steps, 0), np.int64), *took], axis=1)[:, order],
        np.concatenate([np.empty((steps, 0), np.bool_), *out], axis=1)[:, order],
        truth.picture[mine[~is_out_of_part[mine]]],
    )


def _by_picture(pictures: Int64s, rows: Int64s) -> dict[int, Int64s]:
    order = np.argsort(pictures, kind="stable")
    names, starts = np.unique(pictures[order], return_index=True)
    parts = np.split(rows[order], starts[1:]) if len(names) else []
    return dict(zip(names.tolist(), parts, strict=True))


def _match_one(
    boxes: Floats, truth: Floats, is_ignored: Bools, is_region: Bools, overlaps: Floats
) -> tuple[Int64s, Bools]:
    """Match the detections of one picture; return their labels, and which are not judged."""
    took = np.full((len(overlaps), len(boxes)), NOBODY, np.int64)
    is_out = np.zeros(took.shape, np.bool_)
    if not len(truth):
        return took, is_out
    fractions = overlap_table(boxes, truth, is_region)
    for step, wanted in enumerate(np.minimum(overlaps, 1.0 - 1e-10).tolist()):
        is_free = np.ones(len(truth), np.bool_)
        for i in range(len(boxes)):
            can = (is_free | is_region) & (fractions[i] >= wanted)
            # Judged labels have precedence over ignored ones, whatever the overlap.
            for group in (can & ~is_ignored, can & is_ignored):
                some = np.flatnonzero(group)
                if len(some):
                    # The last of equal overlaps, as in pycocotools.
                    k = int(some[len(some) - 1 - int(np.argmax(fractions[i, some][::-1]))])
                    took[step, i], is_out[step, i], is_free[k] = k, is_ignored[k], False
                    break
    return took, is_out


def overlap_table(boxes: Floats, truth: Floats, is_region: Bools) -> Floats:
    """Return intersections over union, shape (D, L); for regions, over the detection's area."""
    low = np.maximum(boxes[:, None, :2], truth[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], truth[None, :, 2:])
    both = np.prod(np.maximum(high - low, 0.0), axis=2)
    mine = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)[:, None]
    other = np.prod(truth[:, 2:] - truth[:, :2], axis=1)[None]
    whole = np.where(is_region[None], mine, mine + other - both)
    return np.asarray(both / np.maximum(whole, 1e-12), np.float64)
