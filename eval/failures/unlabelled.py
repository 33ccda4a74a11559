"""Moments of a run that look wrong without any truth.

What the run claims is compared with what else it knows: how the car drove, what the belief ended
at, what other cues and other detectors say of the same place. Each rule compares two of these, so
that it needs no label. A moment is worth looking at; it need not be an error.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Final, TypeAlias

import numpy as np
import pyarrow as pa

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.scoring.columns import NONE, BeliefRows, RangeRows
from crosscue.eval.scoring.runs import read_run_tables
from crosscue.eval.scoring.scene.approaches import NEAR_M
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.vehicle.cue_spec import CueSpec
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Vehicle

from .approach_level import EVEN, bits
from .order import ranked
from .record import APART_NS, Failure

# Cues at which a car slows down, unless a light is green.
SLOWING: Final = ("stop_sign", "traffic_light")
# Min speed at the first sight, and the fraction of it that is not slowing.
DRIVING_MPS: Final = 3.0
SLOWED: Final = 0.75
STANDING_MPS: Final = 0.3
STANDING_NS: Final = 2_000_000_000
# Time before a stop in which its reason may have been seen.
REASON_NS: Final = 15_000_000_000
# Max distance of a vehicle ahead for which a car stops, and its max distance to the side.
QUEUE_M: Final = 15.0
LANE_M: Final = 2.0
# Objects do not appear for two frames only.
BRIEF: Final = 2
# Severity of a brief moving or parked car, as a fraction of that of a brief sign or light.
MOTION: Final = 0.25
# Min overlap (IoU) of boxes of one object.
SAME_BOX: Final = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class _Claim:
    """A cue that was found in an approach; times of its frames, in the log's time."""

    cue: str
    approach: int
    t_ns: Int64s


# Times of the log, and the speed of the car, shape (N,) each.
_Speed: TypeAlias = tuple[Int64s, Floats]


def suspects(run: RunFolder) -> list[Failure]:
    """Return moments at which the run contradicts itself or the way the car was driven.

    A moment that several rules point to is listed once, by the strongest.

    Raises:
        RunError: A table is missing or damaged.
    """
    kept: list[Failure] = []
    for one in ranked([*_all(run)]):
        if not any(one.t_ns == other.t_ns or _same(one, other) for other in kept):
            kept.append(one)
    return kept


def _same(one: Failure, other: Failure) -> bool:
    """Return whether two moments are of the same subject and time."""
    apart = one.end_ns < other.start_ns or other.end_ns < one.start_ns
    return one.what == other.what and not apart


def _all(run: RunFolder) -> Iterator[Failure]:
    tables, name = read_run_tables(run), str(run.path)
    speed = _speed(run)
    claims: list[_Claim] = []
    if tables.cues is not None:
        of, found = tables.cues, tables.cues.count > 0
        for cue, number in sorted(
            {*zip(of.cue[found].tolist(), of.approach[found].tolist(), strict=True)}
        ):
            mine = found & (of.cue == cue) & (of.approach == number)
            claims.append(_Claim(cue, number, np.sort(of.t_ns[mine])))
    if tables.belief is not None:
        yield from _contradicted(name, claims, tables.belief)
    yield from _opposed(name, claims)
    if tables.frames_ns is not None:
        yield from _brief(name, claims, np.unique(tables.frames_ns))
    if speed is not None:
        yield from _unheeded(name, claims, speed, tables.ranges)
        yield from _unexplained(name, claims, speed, _vehicles_ahead(run))
    yield from _disputed(run, run.drive_manifest().settings)


def _suspect(
    run: str, what: str, why: tuple[str, str], times: Int64s, severity: float, approach: int = NONE
) -> Failure:
    """Return the record of a suspect span, which is looked at in its middle frame."""
    return Failure(
        run=run,
        kind="suspect",
        level="frames",
        what=what,
        cause=why[0],
        reported=why[1],
        t_ns=int(times[len(times) // 2]),
        start_ns=int(times[0]),
        end_ns=int(times[-1]),
        frames=len(times),
        approach=None if approach == NONE else approach,
        severity=severity,
    )


def _contradicted(run: str, claims: Sequence[_Claim], belief: BeliefRows) -> Iterator[Failure]:
    """Yield cues against which the belief of their approach ended."""
    closed = {
        (other.approach, CUES[other.cue].claim[0])
        for other in claims
        if other.cue in CUES and not CUES[other.cue].claim[1]
    }
    for one in claims:
        if one.cue not in CUES or CUES[one.cue].claim[0] not in belief.features:
            continue
        feature, is_there = CUES[one.cue].claim
        rows = np.flatnonzero(belief.approach == one.approach)
        values = belief.features[feature][rows[np.argsort(belief.t_ns[rows], kind="stable")]]
        if one.approach == NONE or not len(values) or not math.isfinite(values[-1]):
            continue
        if _is_road(one) and (one.approach, feature) in closed:
            continue
        agreeing = float(values[-1] if is_there else 1.0 - values[-1])
        if agreeing < EVEN:
            text = f"found in {len(one.t_ns)} frames; {feature} ends at {values[-1]:.2f}"
            why = "the belief ends against it", text
            yield _suspect(run, one.cue, why, one.t_ns, bits(agreeing), one.approach)


def _opposed(run: str, claims: Sequence[_Claim]) -> Iterator[Failure]:
    """Yield the rarer of two cues of one approach that exclude each other."""
    for pair in combinations(claims, 2):
        if pair[0].approach != pair[1].approach or not _exclude(pair[0].cue, pair[1].cue):
            continue
        rare, often = sorted(pair, key=lambda one: len(one.t_ns))
        if _is_road(rare):
            continue
        text = f"in {len(rare.t_ns)} frames, {_words(often.cue)} in {len(often.t_ns)}"
        severity = math.log2(1 + len(often.t_ns) / len(rare.t_ns))
        why = f"{_words(often.cue)} excludes it", text
        yield _suspect(run, rare.cue, why, rare.t_ns, severity, rare.approach)


def _is_road(claim: _Claim) -> bool:
    """Return whether a road was seen, which may well be there and closed by a sign."""
    return claim.cue in CUES and CUES[claim.cue].observed_by == "road"


def _exclude(cue: str, other: str) -> bool:
    """Return whether two cues cannot both be right: opposite claims, or two kinds of control."""
    if {cue, other} == {*SLOWING}:
        return True
    if cue not in CUES or other not in CUES:
        return False
    (feature, is_there), (others, is_other) = CUES[cue].claim, CUES[other].claim
    return feature == others and is_there != is_other


def _brief(run: str, claims: Sequence[_Claim], frames_ns: Int64s) -> Iterator[Failure]:
    """Yield objects that appear for a frame or two, with none of the kind around."""
    for one in claims:
        # The edge of a segmented road comes and goes; an object does not.
        if one.cue not in CUES or CUES[one.cue].observed_by == "road":
            continue
        for times in _episodes(one.t_ns):
            around = np.searchsorted(frames_ns, times[[0, -1]])
            if len(times) <= BRIEF and around[0] > 0 and around[1] < len(frames_ns) - 1:
                why = "for a frame or two only", f"found in {len(times)} frames"
                # A car's motion is judged over frames, so that of one in doubt comes and goes.
                is_motion = CUES[one.cue].observed_by == "car pairs"
                severity = (MOTION if is_motion else 1.0) / len(times)
                yield _suspect(run, one.cue, why, times, severity, one.approach)


def _unheeded(
    run: str, claims: Sequence[_Claim], speed: _Speed, ranges: RangeRows | None
) -> Iterator[Failure]:
    """Yield stop signs and lights that the car passed without slowing."""
    t_ns, mps = speed
    for one in claims:
        if one.cue not in SLOWING or ranges is None:
            continue
        mine = (ranges.approach == one.approach) & (ranges.range_m < NEAR_M)
        if not mine.any():
            continue
        passed_ns = int(ranges.t_ns[mine].max())
        is_on_way = (t_ns >= one.t_ns[0]) & (t_ns <= max(passed_ns, int(one.t_ns[-1])))
        driven = mps[is_on_way]
        if len(driven) and driven[0] > DRIVING_MPS and driven.min() > SLOWED * driven[0]:
            text = f"found in {len(one.t_ns)} frames; {driven[0]:.1f} to {driven.min():.1f} m/s"
            severity = math.log2(1 + len(one.t_ns))
            yield _suspect(
                run, one.cue, ("the car did not slow down", text), one.t_ns, severity, one.approach
            )


def _unexplained(
    run: str, claims: Sequence[_Claim], speed: _Speed, ahead_ns: Int64s
) -> Iterator[Failure]:
    """Yield stops for which the run shows no reason: no sign, light, crossing car or queue."""
    reasons = [one.t_ns for one in claims if one.cue in SLOWING or "cross_traffic" in one.cue]
    seen_ns = np.concatenate([ahead_ns, *reasons]) if reasons else ahead_ns
    t_ns, mps = speed
    standing = t_ns[np.abs(mps) < STANDING_MPS]
    for times in _episodes(standing):
        if times[-1] - times[0] < STANDING_NS:
            continue
        near = (seen_ns >= times[0] - REASON_NS) & (seen_ns <= times[-1])
        if not near.any():
            seconds = float(times[-1] - times[0]) * 1e-9
            why = "stopped, and nothing explains it", f"stood for {seconds:.1f} s"
            yield _suspect(run, "stop", why, times, math.log2(1.0 + seconds))


def _disputed(run: RunFolder, vehicle: Vehicle) -> Iterator[Failure]:
    """Yield spans in which one detector is sure of an object and another one has no such box."""
    names = ["detector", "label", "score", "x0", "y0", "x1", "y1"]
    by_label: dict[str, dict[str, dict[int, list[dict[str, Any]]]]] = {}
    t_ns, table = _in_log_time(run, "detections")
    if table is None:
        return
    for when, row in zip(t_ns.tolist(), table.select(names).to_pylist(), strict=True):
        kinds = by_label.setdefault(row["label"], {})
        kinds.setdefault(row["detector"], {}).setdefault(when, []).append(row)
    needed = {label: least for spec in CUES.values() for label, least in _scores(vehicle, spec)}
    for label, found in sorted(by_label.items()):
        if len(found) < 2 or label not in needed:
            continue
        lone: set[int] = set()
        for one, other in combinations(sorted(found), 2):
            for mine, theirs in ((found[one], found[other]), (found[other], found[one])):
                for when, rows in mine.items():
                    sure = [row for row in rows if row["score"] > needed[label]]
                    if any(not _met(row, theirs.get(when, ())) for row in sure):
                        lone.add(when)
        for times in _episodes(np.array(sorted(lone), np.int64)):
            why = "detectors disagree", f"{', '.join(sorted(found))} in {len(times)} frames"
            yield _suspect(str(run.path), label, why, times, math.log2(1 + len(times)))


def _scores(vehicle: Vehicle, spec: CueSpec) -> Iterator[tuple[str, float]]:
    """Yield the labels of a cue with the min score that it needs."""
    least = vehicle.threshold_of(spec)[1]
    for label in vehicle.labels_of(spec):
        yield label, 0.0 if least is None else least


def _met(row: Mapping[str, float], others: Sequence[Mapping[str, float]]) -> bool:
    """Return whether another detector has a box at the same place."""
    for other in others:
        width = min(row["x1"], other["x1"]) - max(row["x0"], other["x0"])
        height = min(row["y1"], other["y1"]) - max(row["y0"], other["y0"])
        areas = [(one["x1"] - one["x0"]) * (one["y1"] - one["y0"]) for one in (row, other)]
        common = max(width, 0.0) * max(height, 0.0)
        if common > SAME_BOX * (sum(areas) - common):
            return True
    return False


def _episodes(t_ns: Int64s) -> list[Int64s]:
    """Group sorted times that are close to each other."""
    parts = np.split(t_ns, np.flatnonzero(np.diff(t_ns) > APART_NS) + 1)
    return [part for part in parts if len(part)]


def _in_log_time(run: RunFolder, name: str) -> tuple[Int64s, pa.Table | None]:
    """Return the log times of a table's rows, and the table; None without a row."""
    table = run.filled(name)
    if table is None:
        return np.empty(0, np.int64), None
    clock = "log_t_ns" if "log_t_ns" in table.column_names else "t_ns"
    return np.asarray(table[clock].to_numpy(), np.int64), table


def _speed(run: RunFolder) -> _Speed | None:
    t_ns, table = _in_log_time(run, "pose")
    return None if table is None else (t_ns, table["speed_mps"].to_numpy())


def _vehicles_ahead(run: RunFolder) -> Int64s:
    """Return the times at which the Mobileye reports a vehicle close ahead."""
    t_ns, rows = _in_log_time(run, "mobileye_obstacles")
    if rows is None:
        return t_ns
    is_near = (rows["x_m"].to_numpy() < QUEUE_M) & (np.abs(rows["y_m"].to_numpy()) < LANE_M)
    return np.asarray(t_ns[is_near], np.int64)


def _words(cue: str) -> str:
    return cue.replace("_", " ")
