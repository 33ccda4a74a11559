"""First screen of a report: what happened, and pictures of the moments that matter."""

import base64
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.legs import leg_texts
from crosscue.eval.runs.moments import frame_times, seconds_into, span_ns
from crosscue.eval.scoring.columns import NONE, CueRows, RangeRows, RunTables
from crosscue.eval.scoring.pose.score import PoseScore
from crosscue.eval.scoring.runs import RunScored, read_run_tables
from crosscue.eval.scoring.scene.approaches import ApproachResult, Curve
from crosscue.eval.scoring.scene.cues import CueFrames
from crosscue.replay.vehicle.cue_table import CUES

from .frame_pictures import draw_pictures

MAX_MOMENTS: Final = 8
MAX_MISTAKES: Final = 3
# Approaches that are told one by one; a page of many drives has them in its table.
MAX_TOLD: Final = 4
# Frames of one cue closer in time than this belong to one mistake.
APART_NS: Final = 2_000_000_000
NO_CUE: Final = "no cue shows it"
# Which moments are kept first when there are too many.
BELIEVED, MISTAKE, FIRST, FEATURE, LAST = range(5)


class Mistake(NamedTuple):
    """A failure of a run, as a page shows it.

    Attributes:
        run: Folder of the run.
        t_ns: Time of its picture in the run's tables.
        at_s: Seconds from the run's first frame, as ``crosscue view --at`` expects.
        kind: Kind of failure.
        what: The feature, cue or range concerned.
        text: Its cause with its numbers.
    """

    run: str
    t_ns: int
    at_s: float
    kind: str
    what: str
    text: str


@dataclass(frozen=True, slots=True)
class Moment:
    """A moment of a drive, shown with its picture.

    Attributes:
        t_ns: Time of the picture in the run's tables.
        at_s: Seconds from the run's first frame, as ``crosscue view --at`` expects.
        what: What happened.
        is_wrong: True if the run was wrong.
        distance: Where the intersection is; empty if unknown.
        belief: Probability of each feature.
        not_seen: Lines on roads that no cue shows, with the reasons.
        picture: JPEG in base64; empty if it cannot be read.
    """

    t_ns: int
    at_s: float
    what: str
    is_wrong: bool
    distance: str
    belief: tuple[tuple[str, float], ...]
    not_seen: tuple[str, ...] = ()
    picture: str = ""


@dataclass(frozen=True, slots=True)
class Opening:
    """First screen of a report.

    Attributes:
        sentences: What was found, and whether that is right.
        moments: Moments in the order of time.
        missing: Why pictures are missing; empty if none is.
    """

    sentences: tuple[str, ...]
    moments: tuple[Moment, ...] = ()
    missing: str = ""


@dataclass(frozen=True, slots=True)
class _Event:
    t_ns: int
    rank: int
    what: str


def opening_of(
    run: RunFolder,
    threshold: float,
    scored: RunScored | None = None,
    mistakes: Sequence[Mistake] = (),
) -> Opening:
    """Return the first screen of the report of one run.

    Args:
        run: The run.
        threshold: Probability above which a feature is believed.
        scored: The run, compared with its truth; None without a truth.
        mistakes: Failures of the run in the order in which they are shown.

    Raises:
        RunError: A table is damaged.
    """
    tables = read_run_tables(run)
    sentences = _told(run, tables, threshold) if scored is None else judged_sentences(scored)
    events = [*_events(tables, threshold)]
    moved = frame_times(run)
    if scored is not None:
        logged = {t_ns: log_ns for log_ns, t_ns in moved.items()}
        for one in mistakes[:MAX_MISTAKES]:
            text = f"{one.kind}: {_words([one.what])}"
            events.append(_Event(logged.get(one.t_ns, one.t_ns), MISTAKE, text))
    kept = sorted(events, key=lambda one: (one.rank, one.t_ns))[:MAX_MOMENTS]
    kept.sort(key=lambda one: (one.t_ns, one.rank))
    frames = tables.frames_ns
    if frames is None or not len(frames):
        return Opening(sentences)
    start_ns = span_ns(run)[0]
    by_frame: dict[int, list[_Event]] = {}
    for event in kept:
        by_frame.setdefault(_frame(frames, event), []).append(event)
    shown_ns = {at: moved.get(at, at) for at in by_frame}
    pictures: dict[int, str] = {}
    legs = leg_texts(run)

    def keep(t_ns: int, picture: bytes, _: bytes) -> None:
        pictures[t_ns] = base64.b64encode(picture).decode()

    truth, missing = None if scored is None else scored.truth_path, ""
    if by_frame:
        times = [*shown_ns.values()]
        missing = draw_pictures(run, times, keep, has_candidates=False, truth=truth)
    moments = tuple(
        Moment(
            t_ns=(t_ns := shown_ns[at]),
            at_s=seconds_into(start_ns, t_ns),
            what=_what(some),
            is_wrong=any(one.rank == MISTAKE for one in some),
            distance=_distance(tables, scored, at),
            belief=_belief_at(tables, at),
            not_seen=legs.get(t_ns, ())[1:],
            picture=pictures.get(t_ns, ""),
        )
        for at, some in by_frame.items()
    )
    return Opening(sentences, moments, missing)


def curves_of(run: RunFolder) -> tuple[list[Curve], list[CueFrames]]:
    """Return the belief over each approach of a run, and its cues, without a truth.

    Raises:
        RunError: A table is damaged.
    """
    tables = read_run_tables(run)
    curves = []
    for number in _approaches(tables):
        assert tables.belief is not None
        mine = tables.belief.take(tables.belief.approach == number)
        unknown_m = np.full(len(mine.t_ns), np.nan)
        name = f"approach {number}"
        curves.append(Curve("", number, name, mine.t_ns, unknown_m, mine.features))
    found = tables.cues
    cues = [] if found is None else [_unjudged(found, name) for name in CUES]
    return curves, [one for one in cues if len(one.t_ns)]


def _unjudged(found: CueRows, name: str) -> CueFrames:
    """Return the frames of a cue of which nothing is known to be true."""
    mine = found.cue == name
    unknown = np.full(int(mine.sum()), NONE, np.int8)
    no_number = np.full(len(unknown), np.nan)
    return CueFrames(
        drive="",
        cue=name,
        t_ns=found.t_ns[mine],
        count=found.count[mine],
        approach=found.approach[mine],
        distance_m=no_number,
        is_object=unknown,
        is_feature=unknown,
        true_count=unknown.astype(np.int64),
        visible=no_number,
        frames=len(unknown),
        moments_unmatched=0,
        left_out={},
        conditions={},
    )


def _frame(frames: np.typing.NDArray[np.int64], event: _Event) -> int:
    """Return the time of the last frame up to an event, or of the first one."""
    return int(frames[max(int(np.searchsorted(frames, event.t_ns, side="right")) - 1, 0)])


def judged_sentences(scored: RunScored) -> tuple[str, ...]:
    """Return a sentence for each true approach, and for the pose."""
    judged = scored.judged.approaches
    results = () if judged is None else judged.results
    told = [_verdict(one, scored.judged.cues, len(results) > 1) for one in results[:MAX_TOLD]]
    if len(results) > MAX_TOLD:
        told.append(f"More in the table: {len(results) - MAX_TOLD}.")
    if judged is not None and judged.extra_detected:
        told.append(f"Intersections believed where none is: {judged.extra_detected}.")
    if scored.pose is not None:
        told.append(_pose_sentence(scored.pose))
    return tuple(told)


def _pose_sentence(pose: PoseScore) -> str:
    """Return the position error; of a track in its own frame, what is left once it is turned."""
    over = f"from the truth (rms) over {pose.distance_m:.0f} m"
    if pose.why_no_nees:
        rms_m = pose.ape["yaw"].translation_m.rmse
        return (
            f"The start heading is unknown; shifted and turned, the pose is {rms_m:.2f} m {over}."
        )
    return f"The pose is {pose.ape['none'].translation_m.rmse:.2f} m {over}."


def _verdict(result: ApproachResult, cues: Sequence[CueFrames], is_named: bool) -> str:
    name = f"Intersection {result.intersection}" if is_named else "Intersection"
    found = result.detected_m
    if found is None:
        parts = [f"{name} not found: {result.why_not_detected}."]
    else:
        ahead = "" if math.isnan(found) else f" {found:.1f} m ahead"
        parts = [f"{name} found{ahead}."]
    if result.spurious_m is not None:
        at = "" if math.isnan(result.spurious_m) else f" {result.spurious_m:.1f} m ahead"
        parts.append(f"A first detection{at} does not count: {result.why_spurious}.")
    sides = [name for name in result.present if name != "intersection"]
    believed = [name for name in sides if result.features_m.get(name) is not None]
    if believed:
        parts.append(f"{_listed(believed)} believed and there.")
    missed = {name: _why(result, name, cues) for name in sides if name not in believed}
    if missed:
        is_one, whys = len(missed) == 1, {*missed.values()}
        each = "; ".join(f"{name}, {why}" for name, why in missed.items())
        why = each if len(whys) > 1 else whys.pop()
        why = why if is_one or why != NO_CUE else "no cue shows them"
        seen = "is there and was not seen" if is_one else "are there and were not seen"
        parts.append(f"{_listed([*missed])} {seen}: {why}.")
    if result.false_features:
        parts.append(f"{_listed(result.false_features)} believed and not there.")
    return " ".join(parts)


def _why(result: ApproachResult, feature: str, cues: Sequence[CueFrames]) -> str:
    """Return the reason why a feature was not established."""
    shows = [
        one.cue
        for one in cues
        if one.cue in CUES
        and feature in CUES[one.cue].supports
        and ((one.approach == result.approach) & (one.count > 0)).any()
    ]
    if not shows:
        return NO_CUE
    last = result.at_entering.get(feature, math.nan)
    return "never probable enough" + ("" if math.isnan(last) else f", {last:.2f} at the end")


def _listed(names: Sequence[str]) -> str:
    text = " and ".join(", ".join(names).rsplit(", ", 1))
    return text.capitalize()


def _told(run: RunFolder, tables: RunTables, threshold: float) -> tuple[str, ...]:
    """Return a sentence for each approach of the run, without a truth."""
    numbers = _approaches(tables)
    told = [] if numbers or tables.belief is None else ["No approach to an intersection."]
    for number in numbers[:MAX_TOLD]:
        name = f"Approach {number}: intersection" if len(numbers) > 1 else "Intersection"
        first = {one: at for one, at in _established(tables, number, threshold).items() if at}
        if "intersection" not in first:
            told.append(f"{name} not believed.")
            continue
        ahead = _first_range(tables, number, first["intersection"])
        sides = [one for one in first if one != "intersection"]
        more = f" {_listed(sides)} believed." if sides else " No road of it believed."
        told.append(f"{name} believed{f' {ahead}' if ahead else ''}.{more}")
    if len(numbers) > MAX_TOLD:
        told.append(f"More in belief.parquet: {len(numbers) - MAX_TOLD}.")
    return (*told, *_pose_told(run))


def _pose_told(run: RunFolder) -> Iterator[str]:
    """Yield a sentence about the pose of a run without a truth."""
    table = run.filled("pose", ["travelled_m", "major_axis_m"])
    if table is not None:
        path_m, ellipse_m = (column[-1].as_py() for column in table.columns)
        yield (
            f"The estimated path is {path_m:.0f} m long; the 2-sigma ellipse at its end is "
            f"{ellipse_m:.1f} m long."
        )


def _approaches(tables: RunTables) -> list[int]:
    if tables.belief is None:
        return []
    return [one for one in np.unique(tables.belief.approach).tolist() if one != NONE]


def _established(tables: RunTables, approach: int, threshold: float) -> dict[str, int]:
    """Return the time at which each feature first exceeds the threshold; 0 if it never does."""
    assert tables.belief is not None
    mine = tables.belief.take(tables.belief.approach == approach)
    above = {name: mine.t_ns[p > threshold] for name, p in mine.features.items()}
    return {name: int(at[0]) if len(at) else 0 for name, at in above.items()}


def _events(tables: RunTables, threshold: float) -> Iterator[_Event]:
    """Yield the first evidence, each feature believed and the end of each approach."""
    for number in _approaches(tables):
        assert tables.belief is not None
        if tables.cues is not None:
            found = np.flatnonzero((tables.cues.approach == number) & (tables.cues.count > 0))
            if len(found):
                at = int(tables.cues.t_ns[found].min())
                names = sorted(
                    {str(tables.cues.cue[i]) for i in found if tables.cues.t_ns[i] == at}
                )
                yield _Event(at, FIRST, f"first evidence: {_words(names)}")
        for name, at in _established(tables, number, threshold).items():
            if at:
                yield _Event(
                    at, BELIEVED if name == "intersection" else FEATURE, f"{name} believed"
                )
        yield _Event(
            int(tables.belief.t_ns[tables.belief.approach == number].max()), LAST, "the end"
        )


def _words(names: Sequence[str]) -> str:
    return ", ".join(name.replace("_", " ") for name in names)


def _what(events: Sequence[_Event]) -> str:
    """Return what happened in a frame: the features believed in it, then the rest."""
    whats = dict.fromkeys(one.what for one in events)
    believed = [one.removesuffix(" believed") for one in whats if one.endswith(" believed")]
    others = [one for one in whats if not one.endswith(" believed")]
    return "; ".join([*([f"{', '.join(believed)} believed"] if believed else []), *others])


def _belief_at(tables: RunTables, t_ns: int) -> tuple[tuple[str, float], ...]:
    """Return the first belief from a log time on; empty after the last one."""
    if tables.belief is None or not len(rows := np.flatnonzero(tables.belief.t_ns >= t_ns)):
        return ()
    belief = {name: float(p[rows[0]]) for name, p in tables.belief.features.items()}
    return tuple((name, p) for name, p in belief.items() if math.isfinite(p))


def _distance(tables: RunTables, scored: RunScored | None, t_ns: int) -> str:
    """Return the range to the start at a log time: true, else estimated with its 95 %."""
    for cue in () if scored is None else scored.judged.cues:
        known_m = cue.distance_m[cue.t_ns == t_ns]
        if len(known_m):
            if math.isfinite(known_m[0]):
                return _place(float(known_m[0]))
            break
    if tables.ranges is None:
        return ""
    rows = np.flatnonzero((tables.ranges.t_ns <= t_ns) & (tables.ranges.reference == "start"))
    if not len(rows) or t_ns - tables.ranges.t_ns[rows[-1]] > APART_NS:
        return ""
    return _ahead(tables.ranges, int(rows[-1]))


def _first_range(tables: RunTables, approach: int, t_ns: int) -> str:
    """Return the first range to the start from a moment on; empty without one."""
    of = tables.ranges
    if of is None:
        return ""
    later = (of.t_ns >= t_ns) & (of.approach == approach) & (of.reference == "start")
    return _ahead(of, int(np.flatnonzero(later)[0])) if later.any() else ""


def _ahead(ranges: RangeRows, row: int) -> str:
    half_m = 1.96 * math.sqrt(max(float(ranges.var_m2[row]), 0.0))
    return _place(float(ranges.range_m[row]), f" ± {half_m:.1f}")


def _place(range_m: float, interval: str = "") -> str:
    if not math.isfinite(range_m):
        return ""
    where = "ahead" if range_m >= 0.0 else "past its start"
    return f"{abs(range_m):.1f}{interval} m {where}"
