"""Match a run's detections with labelled boxes of its pictures.

Labelled pictures are matched to frames by file name if the log is a folder of images; else by log
time (``t_ns`` of a COCO file, or a file name that is a time in nanoseconds), to the nearest frame;
else by the frame number, from 0, at the end of the file name. Pictures without a frame are counted
and left out, and frames without labels are not judged.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.datasets.truth.annotations import Picture, nearest_times, time_in_name
from crosscue.datasets.truth.box_labels import NO_SIZE, BoxLabels, boxes_inside
from crosscue.detectors.base import MIN_SCORE
from crosscue.detectors.boxes import is_best_label
from crosscue.detectors.catalog.class_names import cue_label
from crosscue.detectors.cues.observed import DetectorRole
from crosscue.detectors.decoders.base import DEFAULT_OVERLAP
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.logs import reopened
from crosscue.eval.runs.manifest import DetectManifest, DetectorRow
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import EmptyResultError, SchemaError, UsageError
from crosscue.replay.readers.images.folder import picture_names

from .matching import NOBODY, LabelledBoxes

OTHER_LOG: Final = "images that are not in the run"
OTHER_CLASS: Final = "boxes of classes that the detector does not report"
OTHER_LABEL: Final = "on a better one with another label"
# Max time between a picture and its frame, as a fraction of the time between frames.
FAR: Final = 0.4
_FOUND: Final = ("log_t_ns", "detector", "label", "score", "x0", "y0", "x1", "y1", "range_m")


@dataclass(frozen=True, slots=True, eq=False)
class LabelledRun:
    """Boxes of one detector and labelled boxes, over the labelled frames of a run.

    Attributes:
        run: Folder of the run.
        detector: The detector, as it ran.
        classes: Classes in common.
        members: Labels of the detector, by class that they count as.
        truth: Labelled boxes.
        found: Detections.
        t_ns: Shape (P,): times of the labelled frames in the run's tables, increasing.
        names: Name of each frame in the labels.
        rule: Rule by which pictures were matched to frames, as text.
        frames: Number of frames of the run.
        left_out: Number of labels left out or repaired, and of detections on one object with other
            labels of their class, by reason.
        not_judged: Number of detections of classes that the labels lack, by label.
        is_by_picture: True if the labels say what a picture shows, and not where.
    """

    run: RunFolder
    detector: DetectorRow
    classes: tuple[str, ...]
    members: Mapping[str, tuple[str, ...]]
    truth: LabelledBoxes
    found: LabelledBoxes
    t_ns: Int64s
    names: tuple[str, ...]
    rule: str
    frames: int
    left_out: Mapping[str, int]
    not_judged: Mapping[str, int]
    is_by_picture: bool = False

    @property
    def is_whole(self) -> bool:
        """True if nothing was dropped when the run was made."""
        return all(one.is_whole for one in self.run.drive_manifest().account.reading)

    def blocks(self, block_s: float) -> Int64s:
        """Return block numbers, shape (P,): equal for pictures within ``block_s`` seconds."""
        if block_s <= 0.0:
            return np.arange(len(self.t_ns))
        return np.asarray((self.t_ns - self.t_ns[0]) // int(block_s * 1e9), np.int64)

    def threshold(self, name: str) -> float:
        """Return the detector's threshold of a class, the highest of its labels."""
        thresholds = self.detector.min_scores
        return max(thresholds.get(label, MIN_SCORE) for label in self.members[name])

    def part(self, is_chosen: np.typing.NDArray[np.bool_]) -> tuple[LabelledBoxes, LabelledBoxes]:
        """Return labels and detections of the chosen pictures, shape (P,), renumbered."""
        return (
            self.truth.take(is_chosen[self.truth.picture]),
            self.found.take(is_chosen[self.found.picture]),
        )


def labelled_run(
    run: RunFolder,
    labels: BoxLabels,
    detector: str | None = None,
    meanings: Mapping[str, str] | None = None,
) -> LabelledRun:
    """Match labels to a run's detections.

    Args:
        run: Run with the tables of the detect stage.
        labels: Labels of its pictures.
        detector: Name of the detector; None if only one detects objects.
        meanings: Class that a class of the labels or of the detector counts as; empty for a class
            to ignore.

    Raises:
        UsageError: The detector does not exist, there are several and none is named, or neither
            labels nor detections have a class.
        SchemaError: No picture is in the run, there is no common class, or pictures have another
            size.
        RunError: A table is missing or damaged.
    """
    detected = run.drive_manifest().detected
    if detected is None:
        raise UsageError(f"{run.path}: no detector ran; replay with one")
    chosen = _detector(run, detected, detector)
    table = run.table("frames", ["log_t_ns", "t_ns", "width_px", "height_px"])
    columns = (one.to_pylist() for one in table.columns)
    frames = {
        log_t_ns: (t_ns, (width, height))
        for log_t_ns, t_ns, width, height in zip(*columns, strict=True)
    }
    left_out: Counter[str] = Counter(labels.ignored)
    placed, rule = _placed(run, detected, labels, np.array(sorted(frames), np.int64), left_out)
    reported = chosen.labels if chosen.labels is not None else _labels_met(run, chosen.name)
    classes, of_labels, of_found = _classes(labels, chosen.name, reported, dict(meanings or {}))
    order = sorted(placed, key=lambda t: frames[t][0])
    sizes = [frames[t][1] for t in order]
    truth = _truth([placed[t] for t in order], sizes, of_labels, left_out)
    # That no picture shows an object is a label, too.
    if not truth and not labels.is_by_picture:
        raise EmptyResultError(
            f"{placed[order[0]].name} and {len(order) - 1} other labelled images: no box of a "
            "class that the detector reports; use labels with some"
        )
    numbers = {name: k for k, name in enumerate(classes)}
    found, not_judged = _found(run, chosen.name, order, of_found, numbers, left_out)
    return LabelledRun(
        run,
        chosen,
        classes,
        {
            name: tuple(label for label, means in of_found.items() if means == name)
            for name in classes
        },
        _as_boxes(truth, numbers),
        found,
        np.array([frames[t][0] for t in order], np.int64),
        tuple(placed[t].name for t in order),
        rule,
        len(frames),
        dict(left_out),
        not_judged,
        labels.is_by_picture,
    )


def _detector(run: RunFolder, detected: DetectManifest, asked: str | None) -> DetectorRow:
    some = [
        one for one in detected.detectors if one.role in (DetectorRole.OBJECTS, DetectorRole.SIGNS)
    ]
    named = [one for one in some if one.name == asked] if asked is not None else some
    if len(named) == 1:
        return named[0]
    there = ", ".join(one.name for one in some) or "none that finds objects"
    if asked is not None:
        raise UsageError(f"detector: {asked}, not in {run.path}; there are: {there}")
    raise UsageError(f"{run.path}: name one detector with --detector; there are: {there}")


def _placed(
    run: RunFolder,
    detected: DetectManifest,
    labels: BoxLabels,
    t_ns: Int64s,
    left_out: Counter[str],
) -> tuple[dict[int, Picture], str]:
    """Return labels by log time of the frame, and the rule by which they were matched."""
    found, rule = _times(run, detected, labels, t_ns)
    inside = set(t_ns.tolist())
    placed: dict[int, Picture] = {}
    for picture, t in zip(labels.pictures, found, strict=True):
        if t is None or t not in inside:
            left_out[OTHER_LOG] += 1
        elif t in placed:
            raise SchemaError(
                f"{labels.where}: {placed[t].name} and {picture.name} belong to one frame, {t} ns "
                f"({rule}); use different names or times"
            )
        else:
            placed[t] = picture
    if not placed:
        raise SchemaError(
            f"{labels.where}: none of its {len(labels.pictures)} images is in {run.path} ({rule}); "
            "use labels of the replayed log"
        )
    return placed, rule


def _times(
    run: RunFolder, detected: DetectManifest, labels: BoxLabels, t_ns: Int64s
) -> tuple[list[int | None], str]:
    """Return the log time of each labelled picture, None without a frame, and the rule."""
    log = detected.logs[detected.camera_log]
    if log.format == "images" and not run.without_images:
        with reopened(run, log) as opened:
            names = {re.sub(r"\.[^.]*$", "", name): t for name, t in picture_names(opened).items()}
        found = [names.get(_stem(one.name)) for one in labels.pictures]
        if any(t is not None for t in found):
            return found, "by file name"
    asked = [_time_of(one) for one in labels.pictures]
    if all(t is not None for t in asked):
        wanted = np.array(asked, np.int64)
        there = nearest_times(t_ns, wanted)
        period = float(np.median(np.diff(t_ns))) if len(t_ns) > 1 else 1e9
        near = np.abs(there - wanted) <= FAR * period
        times = [int(t) if ok else None for t, ok in zip(there, near, strict=True)]
        return times, "by time"
    part = detected.selection
    if part.start_ns is not None or part.end_ns is not None:
        raise UsageError(
            f"{labels.where}: has numbered images, but {run.path} is part of a log; "
            "replay the complete log, or label by time"
        )
    numbers = [re.search(r"([0-9]{1,9})$", _stem(one.name)) for one in labels.pictures]
    return [
        int(t_ns[int(one[1])]) if one is not None and int(one[1]) < len(t_ns) else None
        for one in numbers
    ], "by number, the first frame being 0"


def _stem(name: str) -> str:
    """Return a file name without folders and suffix."""
    return re.sub(r"\.[^.]*$", "", re.split(r"[/\\]", name)[-1])


def _time_of(picture: Picture) -> int | None:
    if picture.t_ns is not None:
        return picture.t_ns
    return time_in_name(_stem(picture.name))


def _classes(
    labels: BoxLabels, detector: str, reported: Sequence[str], meanings: dict[str, str]
) -> tuple[tuple[str, ...], dict[str, str | None], dict[str, str | None]]:
    """Return the common classes, and the class by name in the labels and in the detections.

    Names that are missing in these are not judged; those of class None are ignored.
    """
    for name, means in meanings.items():
        if name not in (*labels.labels, *reported):
            raise UsageError(
                f"meanings: {name}={means}, no such class; the labels have "
                f"{_listed(labels.labels)}; {detector} reports {_listed(reported)}"
            )
    of_found = {name: meanings.get(name, name) or None for name in reported}
    plain = {_plain(name): name for name in reported}
    of_labels: dict[str, str | None] = {}
    for name in labels.labels:
        if name in meanings:
            of_labels[name] = meanings[name] or None
            continue
        same = plain.get(_plain(name)) or cue_label(name)
        if same in of_found and of_found[same] is not None:
            of_labels[name] = of_found[same]
    both = {one for one in of_labels.values() if one} & {one for one in of_found.values() if one}
    if not both:
        raise SchemaError(
            f"{labels.where}: no class that {detector} reports; the labels have "
            f"{_listed(labels.labels)}; map them with --map LABEL=NAME"
        )
    return tuple(sorted(both)), of_labels, of_found


def _labels_met(run: RunFolder, detector: str) -> tuple[str, ...]:
    """Return the reported labels of a detector that does not declare its labels."""
    table = run.table("detections", ["detector", "label"])
    rows = zip(table["detector"].to_pylist(), table["label"].to_pylist(), strict=True)
    return tuple(sorted({label for name, label in rows if name == detector}))


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(names[:12]) or "none"
    return f"{shown}, ..." if len(names) > 12 else shown


def _truth(
    pictures: Sequence[Picture],
    sizes: Sequence[tuple[int, int]],
    of_labels: Mapping[str, str | None],
    left_out: Counter[str],
) -> list[tuple[int, str | None, tuple[float, float, float, float], bool, float]]:
    """Return picture, class (None for any class), box, whether it is ignored, and range."""
    rows = []
    for number, (picture, size) in enumerate(zip(pictures, sizes, strict=True)):
        if picture.size_px not in (NO_SIZE, size):
            raise SchemaError(
                f"{picture.name}: labelled at {picture.size_px} pixels, the run's image has "
                f"{size}; label images as recorded"
            )
        for one in boxes_inside(picture, size, left_out):
            if one.label and one.label not in of_labels:
                left_out[f"{OTHER_CLASS} ({one.label})"] += 1
                continue
            means = of_labels[one.label] if one.label else None
            assert one.box_px is not None
            range_m = math.nan if one.range_m is None else one.range_m
            rows.append((number, means, one.box_px, one.is_crowd or means is None, range_m))
    return rows


def _as_boxes(
    rows: Sequence[tuple[int, str | None, tuple[float, float, float, float], bool, float]],
    numbers: Mapping[str, int],
) -> LabelledBoxes:
    picture, means, boxes, is_ignored, range_m = zip(*rows, strict=True) if rows else ((),) * 5
    label = [NOBODY if one is None else numbers.get(one, NOBODY - 1) for one in means]
    found = LabelledBoxes(
        np.array(picture, np.int64),
        np.array(label, np.int64),
        np.array(boxes, np.float64).reshape(-1, 4),
        np.ones(len(rows)),
        np.array(is_ignored, np.bool_),
        np.array(range_m, np.float64),
    )
    return found.take(found.label >= NOBODY)


def _found(
    run: RunFolder,
    detector: str,
    times: Sequence[int],
    of_found: Mapping[str, str | None],
    numbers: Mapping[str, int],
    left_out: Counter[str],
) -> tuple[LabelledBoxes, dict[str, int]]:
    """Return the detector's boxes in labelled frames, and counts of unjudged ones by label.

    Boxes of objects for which another detector had priority are included. Of labels that count as
    one class, the best on each object is kept, as if the network had only that class.
    """
    order = {label: i for i, label in enumerate(of_found)}
    place = {t: i for i, t in enumerate(times)}
    rows = []
    not_judged: Counter[str] = Counter()
    for batch in run.batches("detections", list(_FOUND)):
        for t, name, label, *rest in zip(*(batch[c].to_pylist() for c in _FOUND), strict=True):
            if name != detector or t not in place:
                continue
            means = of_found.get(label, label)
            if means is None:
                continue
            if means not in numbers:
                not_judged[label] += 1
                continue
            rows.append((place[t], numbers[means], *rest, order.get(label, -1)))
    columns = np.array([[np.nan if v is None else v for v in row] for row in rows], np.float64)
    columns = columns.reshape(-1, 9)
    picture_and_class = columns[:, 0] * len(numbers) + columns[:, 1]
    is_kept = is_best_label(
        columns[:, 3:7],
        columns[:, 2],
        picture_and_class.astype(np.int64),
        columns[:, 8].astype(np.int64),
        DEFAULT_OVERLAP,
    )
    for name, number in numbers.items():
        count = int((columns[~is_kept, 1] == number).sum())
        if count:
            left_out[f"detections of {name} {OTHER_LABEL}"] += count
    columns = columns[is_kept]
    boxes = LabelledBoxes(
        columns[:, 0].astype(np.int64),
        columns[:, 1].astype(np.int64),
        columns[:, 3:7],
        columns[:, 2],
        np.zeros(len(columns), np.bool_),
        columns[:, 7],
    )
    return boxes, dict(not_judged.most_common())
