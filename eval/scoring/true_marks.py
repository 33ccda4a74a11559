"""What is true in the pictures of a run: labelled boxes, and the cues that are present."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from crosscue.datasets.truth.coco import read_coco
from crosscue.datasets.truth.truth import read_truth
from crosscue.detectors.overlay import TrueMarks
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import frame_times

from .truth import cue_at


def true_marks(truth: Path, run: RunFolder, wanted: Collection[int]) -> Mapping[int, TrueMarks]:
    """Return the labelled boxes and present cues by time in the run's tables.

    Raises:
        SchemaError: The truth or its boxes cannot be read.
    """
    found = read_truth(truth)
    moved = frame_times(run)
    logged = {t_ns: log_ns for log_ns, t_ns in moved.items() if t_ns in wanted}
    times = {logged.get(t_ns, t_ns): t_ns for t_ns in sorted(wanted)}
    boxes: dict[int, list[tuple[str, tuple[float, float, float, float]]]] = {}
    pictures = () if found.objects is None else read_coco(truth.parent / found.objects).pictures
    for one in pictures:
        if one.t_ns in times:
            boxes[times[one.t_ns]] = [
                (thing.label, thing.box_px) for thing in one.things if thing.box_px is not None
            ]
    log_ns = np.array([*times], np.int64)
    counts: dict[int, dict[str, int]] = {}
    for cue in dict.fromkeys(one.cue for one in found.cues):
        at = cue_at([one for one in found.cues if one.cue == cue], log_ns)
        for row in np.flatnonzero(at.present == 1).tolist():
            number = max(int(at.count[row]), 1)
            counts.setdefault(times[int(log_ns[row])], {})[cue] = number
    return {t: TrueMarks(boxes.get(t, ()), counts.get(t, {})) for t in times.values()}
