"""Time segments of a drive, found once and used by all of its stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.tables.parquet import numbers_of
from crosscue.replay.base import Log, Selection
from crosscue.replay.columns import Block, Topic
from crosscue.replay.errors import UsageError, VehicleError
from crosscue.replay.signals.extractor import probe_clocks, wheels_only
from crosscue.replay.signals.kinds import Samples, Signal, SignalPlan
from crosscue.replay.signals.plan import pictures_only, plan, with_pictures
from crosscue.replay.time.scan import WheelReader, scan
from crosscue.replay.time.segments import Timeline, gaps_text
from crosscue.replay.vehicle.roles import Role, role_of

if TYPE_CHECKING:
    from crosscue.eval.runs.folder import RunFolder
    from crosscue.eval.runs.manifest import TimeSegments


def with_segments(
    drive: Drive, camera: tuple[int, Topic] | None = None, known: Timeline | None = None
) -> Drive:
    """Read a drive's stamps once, and return it with its time segments.

    Args:
        drive: The drive, without segments.
        camera: Camera whose stamps are examined as well.
        known: Segments found by an earlier stage; their shifts are kept.

    Raises:
        VehicleError: The vehicle file does not fit the logs.
    """
    logs, vehicle = drive.logs, drive.vehicle
    planned = plan(drive.topics, vehicle)
    if camera is not None:
        planned = with_pictures(planned, camera)
    selections = selections_of(drive, planned)
    wheels = [
        wheels_only(planned, vehicle, i, probe_clocks(log, planned, vehicle, i, selections[i]))
        for i, log in enumerate(logs)
    ]
    limits = vehicle.time.split
    return replace(drive, segments=scan(logs, planned, limits, selections, wheels, known))


def with_camera_segments(drive: Drive) -> Drive:
    """Return a drive with segments as ``with_segments``, for a stage that needs only the camera.

    If the vehicle file does not fit the odometry, only the camera's own clock is examined. The
    stage that needs the odometry reports the error.
    """
    camera = drive.only_camera()
    try:
        return with_segments(drive, camera)
    except VehicleError:
        planned, logs, limits = pictures_only(camera), drive.logs, drive.vehicle.time.split
        wheels = [_no_wheels] * len(logs)
        return replace(
            drive, segments=scan(logs, planned, limits, selections_of(drive, planned), wheels)
        )


def refuse_other_segments(run: RunFolder, timeline: Timeline) -> None:
    """Refuse a run whose frames have other segments than its odometry.

    The vehicle file used for detection may not have fitted the odometry, or may have named other
    wheel speeds.

    Raises:
        UsageError: The segment of a frame differs.
    """
    for batch in run.batches("frames", ["t_ns", "segment"]):
        t_ns, there = (numbers_of(batch[name]) for name in ("t_ns", "segment"))
        wanted = timeline.numbers(t_ns)
        if (other := np.flatnonzero(wanted != there)).size:
            at = int(other[0])
            raise UsageError(
                f"{run.path}: its frame at {t_ns[at]} ns is in segment {there[at]}, the odometry "
                f"then in {wanted[at]}: its frames were detected with a vehicle file of other "
                "odometry, and estimate keeps their segments; run crosscue replay again"
            )


def whole_timeline(drive: Drive) -> Timeline:
    """Return the segments as ``with_segments`` does, from the stamps of all topics."""
    planned, wheels = plan_for_time(drive)
    limits = drive.vehicle.time.split
    return scan(drive.logs, planned, limits, [drive.selection] * len(drive.logs), wheels)


def plan_for_time(drive: Drive) -> tuple[SignalPlan, list[WheelReader]]:
    """Return the plan for the wheel speeds, and an extractor for each log.

    Without wheel speeds nothing is planned; clock set-backs are still found.
    """
    logs, vehicle = drive.logs, drive.vehicle
    try:
        planned = plan(drive.topics, vehicle)
    except VehicleError:
        return without_wheels(logs)
    wheels = planned.source_of(Signal.WHEEL_SPEEDS)
    planned = SignalPlan(() if wheels is None else (wheels,), {})
    selections = selections_of(drive, planned)
    clocks = [
        probe_clocks(log, planned, vehicle, i, selections[i]) if selections[i].topics else {}
        for i, log in enumerate(logs)
    ]
    return planned, [wheels_only(planned, vehicle, i, used) for i, used in enumerate(clocks)]


def may_have_wheels(logs: Sequence[Log]) -> bool:
    """Return whether a topic has wheel speeds without a vehicle file that names them."""
    roles = {role_of(topic) for log in logs for topic in log.topics}
    return not roles.isdisjoint((Role.WHEELS, Role.ODOMETRY))


def without_wheels(logs: Sequence[Log]) -> tuple[SignalPlan, list[WheelReader]]:
    """Return a plan without wheel speeds, as ``plan_for_time`` returns one with them."""
    return SignalPlan((), {}), [_no_wheels] * len(logs)


def _no_wheels(block: Block) -> tuple[Samples, ...]:
    return ()


def selections_of(drive: Drive, planned: SignalPlan) -> list[Selection]:
    """Return the selection of each log, narrowed to the topics that are used."""
    return [_narrowed(drive.selection, planned.topics_of(i)) for i in range(len(drive.logs))]


def _narrowed(selection: Selection, planned: frozenset[str]) -> Selection:
    topics = planned if selection.topics is None else planned & selection.topics
    return Selection(topics, selection.start_ns, selection.end_ns)


def time_segments(timeline: Timeline) -> TimeSegments:
    """Return a timeline in the form of the manifest."""
    from crosscue.eval.runs.manifest import TimeSegments

    return TimeSegments(
        segments=timeline.segments,
        clocks=timeline.clocks,
        notices=tuple(gaps_text(timeline.segments)),
    )
