"""All failures of one run: compared with its truth, or, without truth, flipped beliefs only."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import frame_times, seconds_into, span_ns
from crosscue.eval.scoring.runs import SceneJudged, read_run_tables
from crosscue.eval.scoring.scene.approaches import NEAR_M
from crosscue.eval.scoring.scene.cues import SEEN, CueFrames, is_wrong
from crosscue.eval.scoring.scene.ranges import RangeJudged, sds_off
from crosscue.replay.vehicle.vehicle import CUES

from .approach_level import flips_without_truth, of_approaches
from .record import APART_NS, About, Failure, Kind
from .unlabelled import suspects

# A smaller error, as a fraction of the range, is blamed on the interval, a larger on the range.
NARROW: Final = 0.1
MOSTLY: Final = 0.5
SDS_95: Final = 1.959964
# Rows of ``detections.parquet`` by the time of their frame.
Detected = Mapping[int, Sequence[Mapping[str, Any]]]


def failures_beside_truth(
    run: RunFolder, scene: SceneJudged, threshold: float
) -> tuple[Failure, ...]:
    """Return all failures of a judged run, unordered.

    Raises:
        RunError: A table is missing or damaged.
    """
    abouts = {
        one.id: About(
            str(run.path), one.id, one.intersection, one.conditions, one.start_ns, one.enter_ns
        )
        for one in scene.truth.truth.approaches
    }
    judged, found = scene.judged, list[Failure]()
    if judged.approaches is not None:
        found += of_approaches(judged.approaches, judged.cues, abouts, threshold)
    found += _of_frames(run, scene, abouts)
    return _placed(run, found)


def failures_without_truth(run: RunFolder, threshold: float) -> tuple[Failure, ...]:
    """Return the failures that show without truth: flipped beliefs.

    Raises:
        RunError: A table is missing or damaged.
    """
    return _placed(run, _flips(run, threshold))


def _flips(run: RunFolder, threshold: float) -> list[Failure]:
    tables = read_run_tables(run)
    if tables.belief is None:
        return []
    positives = {}
    if tables.cues is not None:
        is_found = tables.cues.count > 0
        for cue in np.unique(tables.cues.cue).tolist():
            positives[cue] = tables.cues.t_ns[is_found & (tables.cues.cue == cue)]
    return flips_without_truth(tables.belief, positives, str(run.path), threshold)


def failures_unlabelled(run: RunFolder, threshold: float) -> tuple[Failure, ...]:
    """Return the moments that look wrong without truth: flipped beliefs, and contradictions.

    Raises:
        RunError: A table is missing or damaged.
    """
    # A flip is looked at in the last frame of the answer that was given up.
    flips = [replace(one, t_ns=one.start_ns) for one in _flips(run, threshold)]
    return _placed(run, [*flips, *suspects(run)])


def _of_frames(run: RunFolder, scene: SceneJudged, abouts: Mapping[int, About]) -> list[Failure]:
    judged, name = scene.judged, str(run.path)
    vehicle, detected = run.drive_manifest().settings, _detected(run, scene)
    found = list(wrong_ranges(judged.ranges, abouts, name))
    for cue in judged.cues:
        spec = CUES.get(cue.cue)
        labels = () if spec is None else vehicle.labels_of(spec)
        min_score = None if spec is None else vehicle.threshold_of(spec)[1]
        found += missed_and_false(cue, judged.cues, labels, min_score, detected, abouts, name)
    return found


def _detected(run: RunFolder, scene: SceneJudged) -> Detected:
    """Return the detections in the failing frames, by log time."""
    import pyarrow.compute as pc

    wanted = failing_times(scene.judged.cues)
    if not len(wanted) or not run.file("detections.parquet").exists():
        return {}
    times, found = pa.array(wanted), dict[int, list[dict[str, Any]]]()
    for batch in run.batches("detections", ["log_t_ns", "label", "score"]):
        for row in batch.filter(pc.is_in(batch["log_t_ns"], times)).to_pylist():
            found.setdefault(row["log_t_ns"], []).append(row)
    return found


def _placed(run: RunFolder, found: list[Failure]) -> tuple[Failure, ...]:
    """Convert failures from log time, as in the truth, to the time of the run's tables."""
    if not found:
        return ()
    first_ns, last_ns = span_ns(run)
    moved = frame_times(run)

    def of_run(log_ns: int) -> int:
        return min(max(moved.get(log_ns, log_ns), first_ns), last_ns)

    return tuple(
        replace(
            one,
            t_ns=of_run(one.t_ns),
            start_ns=of_run(one.start_ns),
            end_ns=of_run(one.end_ns),
            at_s=seconds_into(first_ns, of_run(one.t_ns)),
        )
        for one in found
    )


def missed_and_false(
    cue: CueFrames,
    others: Sequence[CueFrames],
    labels: Sequence[str],
    min_score: float | None,
    detected: Detected,
    about: Mapping[int, About],
    run: str,
) -> Iterator[Failure]:
    """Yield a cue's misses of visible objects, and its false positives.

    Args:
        cue: The cue in all frames of a drive.
        others: All cues of the drive.
        labels: Labels of the detections that the cue uses; empty for road and Mobileye.
        min_score: Min score of these detections; None for any.
        detected: Detections at the times of failures.
        about: Approaches by id.
        run: Folder of the run.
    """
    for rows in _episodes(cue, _is_missed(cue)):
        why = _why_missed(cue, rows, labels, min_score, detected)
        # The nearest frame before the intersection, where detection should be easiest.
        ahead = rows[~(cue.distance_m[rows] < NEAR_M)]
        row = int(ahead[-1] if len(ahead) else rows[-1])
        yield _failure("missed", why, cue, rows, row, about, run)
    for rows in _episodes(cue, is_wrong(cue)):
        sure = [_highest(detected.get(int(cue.t_ns[i]), ()), labels) for i in rows]
        row = int(rows[int(np.argmax(sure))])
        why = _why_false(cue, rows, others, max(sure))
        yield _failure("false", why, cue, rows, row, about, run)


def failing_times(cues: Sequence[CueFrames]) -> NDArray[np.int64]:
    """Return the times of frames with a missed or false cue, whose detections are needed."""
    wanted = [np.empty(0, np.int64)]
    for cue in cues:
        wanted.append(cue.t_ns[_is_missed(cue) | is_wrong(cue)])
    return np.unique(np.concatenate(wanted))


def _is_missed(cue: CueFrames) -> NDArray[np.bool_]:
    return np.asarray((cue.is_object == 1) & (cue.count == 0) & ~(cue.visible < SEEN), np.bool_)


def wrong_ranges(
    judged: Sequence[RangeJudged], about: Mapping[int, About], run: str
) -> Iterator[Failure]:
    """Yield spans in which the true range is outside the estimate's 95 % interval."""
    for one in judged:
        off = sds_off(one)
        for rows in _episodes(one, off > SDS_95):
            row = int(rows[int(off[rows].argmax())])
            error_m, true_m = float(one.error_m[row]), float(one.true_m[row])
            cause = "too far" if error_m > 0.0 else "too near"
            if abs(error_m) < NARROW * abs(true_m):
                cause = "interval too narrow"
            text = f"{error_m:+.1f} m at {true_m:.1f} m, s.d. {math.sqrt(one.var_m2[row]):.1f} m"
            yield Failure(
                run=run,
                kind="range",
                what=f"range to {one.reference}",
                cause=cause,
                reported=text,
                **_span(one, rows, row, about),
                distance_m=true_m,
                severity=float(off[row]) ** 2 / (2.0 * math.log(2.0)),
            )


def _episodes(
    judged: CueFrames | RangeJudged, is_failing: NDArray[np.bool_]
) -> list[NDArray[np.intp]]:
    """Group failing rows that are close in time and belong to one approach."""
    rows = np.flatnonzero(is_failing)
    breaks = (np.diff(judged.t_ns[rows]) > APART_NS) | (np.diff(judged.approach[rows]) != 0)
    return [part for part in np.split(rows, np.flatnonzero(breaks) + 1) if len(part)]


def _why_missed(
    cue: CueFrames,
    rows: NDArray[np.intp],
    labels: Sequence[str],
    min_score: float | None,
    detected: Detected,
) -> tuple[str, str]:
    if not labels:
        return "not found", f"there in {len(rows)} frames"
    scores = [_highest(detected.get(int(cue.t_ns[i]), ()), labels) for i in rows]
    found = [score for score in scores if score >= 0.0]
    names = ", ".join(labels[:3])
    if not found:
        return "not detected", f"no {names} detected in {len(rows)} frames"
    text = f"{names} detected in {len(found)} of {len(rows)} frames, at most {max(found):.2f}"
    if min_score is not None and max(found) < min_score:
        return "score too low", f"{text}; {min_score:g} is needed"
    return "detected, but ruled out", text


def _why_false(
    cue: CueFrames,
    rows: NDArray[np.intp],
    others: Sequence[CueFrames],
    surest: float,
) -> tuple[str, str]:
    sure = "" if surest < 0.0 else f", score up to {surest:.2f}"
    text = f"found in {len(rows)} frames{sure}"
    times = cue.t_ns[rows]
    best, name = 0, ""
    for other in others:
        mine = np.isin(other.t_ns, times) & (other.is_object == 1) & (other.count == 0)
        if other.cue != cue.cue and int(mine.sum()) > best:
            best, name = int(mine.sum()), other.cue
    if best >= MOSTLY * len(rows):
        words = name.replace("_", " ")
        return "another cue is there", f"{text}; {words} is there in {best} and was not found"
    return "nothing is there", text


def _highest(rows: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> float:
    """Return the highest score among these labels; -1 without any."""
    return max((float(row["score"]) for row in rows if row["label"] in labels), default=-1.0)


def _failure(
    kind: Kind,
    why: tuple[str, str],
    cue: CueFrames,
    rows: NDArray[np.intp],
    row: int,
    about: Mapping[int, About],
    run: str,
) -> Failure:
    distance_m = float(cue.distance_m[row])
    return Failure(
        run=run,
        kind=kind,
        what=cue.cue,
        cause=why[0],
        reported=why[1],
        **_span(cue, rows, row, about),
        distance_m=distance_m if math.isfinite(distance_m) else None,
        severity=math.log2(1 + len(rows)),
    )


def _span(
    judged: CueFrames | RangeJudged, rows: NDArray[np.intp], row: int, about: Mapping[int, About]
) -> dict[str, Any]:
    """Return the attributes of a failure in these rows, to be inspected in one of them."""
    where = about.get(int(judged.approach[row]))
    return {
        "level": "frames",
        "t_ns": int(judged.t_ns[row]),
        "start_ns": int(judged.t_ns[rows[0]]),
        "end_ns": int(judged.t_ns[rows[-1]]),
        "frames": len(rows),
        **({} if where is None else where.shared),
    }
