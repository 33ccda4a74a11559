"""Contract tests for plug-ins; crosscue's own readers, detectors, cues and data sets pass them.

Call them from a test of your own package::

    from crosscue.testing import check_detector

    def test_it_keeps_the_contract():
        check_detector(my_package.build)

Each raises ``AssertionError`` with the expected and the actual result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.formats import known_formats
from crosscue.replay.logs.opening import open_log

from .replay.columns import CanFrames, Images, Messages, Table
from .replay.errors import CrosscueError
from .replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger

if TYPE_CHECKING:
    from crosscue.detectors.base import Detector, Found, Frame
    from crosscue.replay.vehicle.vehicle import CueSpec

    from .replay.columns import Block

__all__ = ["check_cue", "check_dataset", "check_detector", "check_reader"]

# Log time and content of each row in stored order, by topic.
Rows: TypeAlias = dict[str, list[tuple[int, object]]]
T = TypeVar("T")


def check_reader(
    log: Path,
    damage_one_row: Callable[[Path], object] | None = None,
    *,
    is_in_order: bool = True,
) -> None:
    """Check that a reader keeps the contract on a small, undamaged log of several rows.

    Every row is accounted for, reading twice returns the same rows, the times of a topic are in
    order, a time span is half open, and a topic can be read alone. With ``damage_one_row``, the log
    is damaged afterwards, and exactly that row must be lost, with a reason.

    Args:
        log: A log of the reader's format, opened with ``crosscue.open``.
        damage_one_row: Function that damages exactly one row of the log at the given path.
        is_in_order: True if the rows of a topic are stored in order of time; packets of a video
            may not be.

    Raises:
        AssertionError: The contract is broken; the message states where.
    """
    whole, ledger = _read(log)
    _expect(sum(map(len, whole.values())) > 2, f"{log}: expected three rows or more, for a test")
    _expect(ledger.is_whole, f"{log}: an undamaged log has drops: {[*ledger.drops()]}")
    _expect(_read(log)[0] == whole, f"{log}: read again, its rows differ")
    _check_topics(log, whole, ledger)
    for name, rows in whole.items():
        times = [t_ns for t_ns, _ in rows]
        _expect(times == sorted(times) or not is_in_order, f"{name}: times are not in order")
    _check_spans(log, whole)
    for name, rows in whole.items():
        alone, of_topic = _read(log, Selection(frozenset({name})))
        _expect(alone == {name: rows}, f"{name}: read alone, its rows differ")
        _check_skips(of_topic, NOT_ASKED_TOPIC)
    if damage_one_row is not None:
        damage_one_row(log)
        _check_one_lost(log, whole, _left_out(ledger))


def check_detector(build: Callable[[], Detector], *, tolerance: float = 1e-3) -> None:
    """Check that a detector keeps the contract on black, white and noisy frames.

    It returns one result for each frame, in order, with the frame's time and size. Boxes are inside
    the picture, scores are from 0 to 1, and every label is one of its ``labels`` if it has any.
    Frames stay unchanged. The same frames yield the same result, one by one or in a batch. Its
    identity is the same when it is built again.

    Args:
        build: Function that builds the detector with its default settings.
        tolerance: Max difference of boxes in pixels and of scores between one frame and a batch.

    Raises:
        AssertionError: The contract is broken; the message states where.
    """
    from crosscue.detectors.base import fault_of, reportable

    detect = _asked(build)
    lacking = [name for name in ("view", "identity", "__call__") if not hasattr(detect, name)]
    _expect(not lacking, f"no {', '.join(lacking)}; derive from crosscue.BoxDetector")
    _expect(isinstance(detect.identity, str) and bool(detect.identity), "identity: expected a text")
    _expect(build().identity == detect.identity, "identity: differs when it is built again")
    labels = reportable(detect)
    frames = _frames(detect.view.is_grey)
    before = [frame.pixels.copy() for frame in frames]
    together = _asked(lambda: detect(frames))
    for frame, pixels in zip(frames, before, strict=True):
        _expect(np.array_equal(frame.pixels, pixels), "it changed a frame's pixels")
    _expect(len(together) == len(frames), f"{len(frames)} frames, {len(together)} results")
    for frame, found in zip(frames, together, strict=True):
        fault = fault_of(found, frame, labels)
        _expect(fault is None, f"frame {frame.t_ns}: {fault}")
        _check_masks(found)
        (alone,) = detect([frame])
        _expect(_is_same(alone, found, tolerance), f"frame {frame.t_ns}: its result differs alone")
    _expect(len(detect([])) == 0, "no frames: expected no results")


def check_cue(cue: CueSpec) -> None:
    """Check that a cue keeps the contract: its claim, its rule, and its result for empty input.

    Args:
        cue: The cue's row of the table.

    Raises:
        AssertionError: The contract is broken; the message states where.
    """
    from crosscue.detectors.cues.candidates import Count
    from crosscue.detectors.cues.rules import rule_of
    from crosscue.replay.vehicle.vehicle import Vehicle

    _expect(cue.name.isidentifier() and cue.name.islower(), f"{cue.name!r}: expected a_lower_name")
    _expect(0.5 < cue.precision < 1.0, f"{cue.name}: precision {cue.precision}: expected 0.5 to 1")
    _expect(bool(cue.supports or cue.excludes), f"{cue.name}: supports and excludes nothing")
    both = {*cue.supports} & {*cue.excludes}
    _expect(not both, f"{cue.name}: supports and excludes {sorted(both)}")
    try:
        rule = rule_of(cue.rule)
    except (ImportError, AttributeError) as error:
        raise AssertionError(f"{cue.name}: rule {cue.rule}: {error}") from None
    vehicle = Vehicle(version=1)
    settings = vehicle.past if cue.observed_by == "mobileye" else vehicle
    for what, observed in _observations(cue.observed_by).items():
        found = rule(observed, settings, cue)
        count = found.number if isinstance(found, Count) else found
        _expect(
            count is None or (isinstance(count, int) and count >= 0),
            f"{cue.name}: {what}: got {count!r}, expected a count or None",
        )
        _expect(
            rule(observed, settings, cue) == found,
            f"{cue.name}: {what}: called again, its result differs",
        )
        _expect(not (what == "nothing" and count), f"{cue.name}: counts {count} where nothing is")


def check_dataset(
    log: Path, folder: Path, damage_one_row: Callable[[Path], object] | None = None
) -> None:
    """Check that a data set keeps the contract of a reader, and that its truth fits its log.

    A true track states the tracked body and its mounting (null if unknown), with the source.

    Args:
        log: A small, undamaged drive of the data set.
        folder: An empty folder for its truth.
        damage_one_row: As for ``check_reader``.

    Raises:
        AssertionError: The contract is broken; the message states where.
    """
    from crosscue.datasets.truth.truth import read_truth, write_carried

    with open_log(log) as opened:
        written = write_carried(opened.format, log, folder)
    truth = read_truth(written)
    rows, _ = _read(log)
    times = [t_ns for topic in rows.values() for t_ns, _ in topic]
    _expect(
        truth.start_ns < truth.end_ns
        and min(times) < truth.end_ns
        and truth.start_ns <= max(times),
        f"truth from {truth.start_ns} to {truth.end_ns} ns; the log {min(times)} to {max(times)}",
    )
    _expect(
        truth.pose is None or (truth.mounting is not None and bool(truth.mounting_source)),
        f"truth: the track of {truth.pose_point}: expected its mounting and mounting_source",
    )
    check_reader(log, damage_one_row)


def _asked(call: Callable[[], T]) -> T:
    """Return the result of a call; an error breaks the contract."""
    try:
        return call()
    except CrosscueError as error:
        raise AssertionError(str(error)) from error
    except Exception as error:
        raise AssertionError(f"it failed: {type(error).__name__}: {error}") from error


def _expect(is_kept: bool, text: str) -> None:
    """Raise unless a condition holds; ``python -O`` would skip an ``assert``."""
    if not is_kept:
        raise AssertionError(text)


def _read(log: Path, selection: Selection = EVERYTHING) -> tuple[Rows, Ledger]:
    ledger = Ledger(str(log))
    rows: Rows = {}
    with open_log(log) as opened:
        for block in ledger.handing_on(opened.read(ledger, selection)):
            rows.setdefault(block.topic, []).extend(_rows_of(block))
        names = {topic.name for topic in opened.topics}
    ledger.check({name: len(rows.get(name, ())) for name in ledger.accounts})
    _expect(rows.keys() <= names, f"{log}: rows of {sorted(rows.keys() - names)}, no topics of it")
    return {name: found for name, found in rows.items() if found}, ledger


def _rows_of(block: Block) -> list[tuple[int, object]]:
    return list(zip(block.log_ns.tolist(), map(_content, *_columns(block)), strict=True))


def _content(*cells: Any) -> object:
    return tuple(
        cell.tobytes() if isinstance(cell, np.generic | np.ndarray) else cell for cell in cells
    )


def _columns(block: Block) -> list[Sequence[Any]]:
    rows = block.rows
    if isinstance(rows, Images | Messages):
        ranges = rows.bytes_ if isinstance(rows, Images) else rows
        return [[bytes(ranges.payload(i)) for i in range(len(ranges))]]
    if isinstance(rows, Table):
        return [*rows.columns.values()] or [[()] * len(block)]  # type: ignore[list-item]
    assert isinstance(rows, CanFrames)
    return [rows.arbitration_id, rows.is_extended, rows.kind, rows.length, rows.data, rows.is_fd]  # type: ignore[list-item]


def _check_topics(log: Path, whole: Rows, ledger: Ledger) -> None:
    with open_log(log) as opened:
        known = known_formats()
        _expect(opened.format in known, f"format {opened.format!r}: expected one of {[*known]}")
        for topic in opened.topics:
            count = len(whole.get(topic.name, ()))
            refused = ledger.topic(topic.name).skipped.total()
            _expect(
                topic.declared in (None, count + refused),
                f"{topic.name}: {topic.declared} rows declared, {count} read, {refused} skipped",
            )


def _check_spans(log: Path, whole: Rows) -> None:
    times = sorted({t_ns for rows in whole.values() for t_ns, _ in rows})
    first, second = times[len(times) // 3], times[2 * len(times) // 3]
    for start, end in ((None, first), (first, second), (second, None)):
        part, ledger = _read(log, Selection(None, start, end))
        low, high = start if start is not None else times[0], end or times[-1] + 1
        want = {name: [row for row in rows if low <= row[0] < high] for name, rows in whole.items()}
        _expect(
            part == {name: rows for name, rows in want.items() if rows},
            f"{start} to {end} ns: {_counts(part)} rows, expected {_counts(want)}",
        )
        _check_skips(ledger, NOT_ASKED_TIME)


def _check_skips(ledger: Ledger, reason: str) -> None:
    _expect(ledger.is_whole, f"{ledger.log}: a part of an undamaged log has drops")
    for name, account in ledger.accounts.items():
        declared = account.declared
        _expect(
            declared is None or account.in_file == declared,
            f"{name}: {declared} rows declared, {account.used} used, {dict(account.skipped)} "
            f"skipped; expected the rest skipped as {reason!r}",
        )


def _counts(rows: Mapping[str, Sequence[object]]) -> dict[str, int]:
    return {name: len(found) for name, found in rows.items() if found}


def _check_one_lost(log: Path, whole: Rows, left_out: int) -> None:
    left, ledger = _read(log)
    before = Counter((name, row) for name, rows in whole.items() for row in rows)
    after = Counter((name, row) for name, rows in left.items() for row in rows)
    _expect(after <= before, f"one row damaged: {(after - before).total()} rows are new")
    missing = (before - after).total()
    _expect(missing == 1, f"one row damaged: {missing} rows are missing")
    lost = _left_out(ledger) - left_out
    _expect(lost == 1, f"one row damaged: {lost} rows are reported as dropped or skipped")
    unknown = [why for one in ledger.accounts.values() for why in one.dropped_unknown]
    _expect(not unknown, f"one row damaged: an unknown number is lost, too: {unknown}")


def _left_out(ledger: Ledger) -> int:
    return sum(one.dropped.total() + one.skipped.total() for one in ledger.accounts.values())


def _frames(is_grey: bool) -> list[Frame]:
    from crosscue.detectors.base import Frame

    size, noise = (160, 96), np.random.default_rng(5)
    shape = size[::-1] if is_grey else (*size[::-1], 3)
    pictures = (
        np.zeros(shape, np.uint8),
        np.full(shape, 255, np.uint8),
        noise.integers(0, 256, shape, np.uint8),
    )
    return [Frame(7 + 10 * i, "camera", pixels, size) for i, pixels in enumerate(pictures)]


def _check_masks(found: Found) -> None:
    """Decode every mask; one that is damaged or of another size raises an error."""
    from crosscue.detectors.base import Detections

    if not isinstance(found, Detections):
        found.pixels()
        return
    for i in (i for i, mask in enumerate(found.masks) if mask):
        found.mask(i)


def _is_same(one: Found, other: Found, tolerance: float) -> bool:
    from crosscue.detectors.base import Detections

    if not isinstance(one, Detections) or not isinstance(other, Detections):
        return type(one) is type(other)
    return one.labels == other.labels and all(
        np.allclose(a, b, rtol=0.0, atol=tolerance)
        for a, b in ((one.boxes_px, other.boxes_px), (one.scores, other.scores))
    )


def _observations(observed_by: str) -> dict[str, Any]:
    """Return inputs of a rule: nothing at all, and boxes of other kinds."""
    from crosscue.detectors.base import Detections

    if observed_by in ("objects", "signs"):
        nothing = Detections(0, (64, 48), np.empty((0, 4)), np.empty(0), (), ())
        box = np.array([[1.0, 2.0, 9.0, 9.0]])
        other = Detections(0, (64, 48), box, np.array([0.9]), ("surely unknown",), (b"",))
        return {"no detector": (), "nothing": (nothing,), "other labels": (other,)}
    if observed_by == "road":
        from crosscue.detectors.cues.observed import RoadFractions

        return {"nothing": RoadFractions(0.0, 0.0, 0.0), "road": RoadFractions(1.0, 1.0, 1.0)}
    if observed_by == "car pairs":
        from crosscue.detectors.cues.cars import no_pairs

        return {"nothing": no_pairs(64)}
    from crosscue.detectors.cues.far_side import Ahead, MobileyeState

    none = np.empty((0, 8))
    return {
        "no device": Ahead(MobileyeState(None, None), 20.0),
        "nothing": Ahead(MobileyeState(none, none), 20.0),
    }
