"""Complete signals of a drive, for fits that need all samples at once."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from crosscue.localization.odometry import TurnKind, TurnSignal, WheelSamples
from crosscue.replay.base import Log, Selection, name_of
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.signals.extractor import SampleExtractor, probe_clocks
from crosscue.replay.signals.kinds import Samples, Signal, SignalPlan
from crosscue.replay.signals.plan import plan
from crosscue.replay.signals.windows import windows
from crosscue.replay.vehicle.vehicle import Vehicle


def signal_plan(logs: Sequence[Log], vehicle: Vehicle) -> SignalPlan:
    """Return the plan that assigns topics of a drive's logs to signals.

    Raises:
        VehicleError: A topic that the vehicle file names does not exist, or is ambiguous.
    """
    return plan([(i, topic) for i, log in enumerate(logs) for topic in log.topics], vehicle)


def read_signals(
    logs: Sequence[Log],
    planned: SignalPlan,
    vehicle: Vehicle,
    selection: Selection,
    wanted: Collection[Signal],
    *,
    warns: bool = True,
) -> dict[Signal, Samples]:
    """Return the requested signals of a drive in order of time, without those that have no row.

    Losses are reported as warnings if ``warns``; turn this off if another pass reports them.
    """
    sources = [source for signal in wanted if (source := planned.source_of(signal)) is not None]
    topics = frozenset(source.topic.name for source in sources)
    narrowed = Selection(topics, selection.start_ns, selection.end_ns)
    extractors = [
        SampleExtractor(
            planned,
            vehicle,
            i,
            Ledger(name_of(log)),
            probe_clocks(log, planned, vehicle, i, narrowed),
        )
        for i, log in enumerate(logs)
    ]
    found: dict[Signal, list[Samples]] = {signal: [] for signal in wanted}
    for window in windows(logs, extractors, [narrowed] * len(logs), planned):
        for signal, parts in found.items():
            if signal in window.samples:
                parts.append(window.samples[signal])
    for extractor in extractors if warns else ():
        warn_of(extractor.ledger)
    return {signal: _joined(parts) for signal, parts in found.items() if parts}


def _joined(parts: Sequence[Samples]) -> Samples:
    t_ns = np.concatenate([part.t_ns for part in parts])
    later = np.diff(t_ns, prepend=t_ns[0] - 1) > 0
    values = np.concatenate([part.values for part in parts])
    return Samples(parts[0].signal, t_ns[later], values[later])


def wheel_speeds(samples: Samples) -> WheelSamples:
    """Return the speeds of all four wheels, or of the rear two if the front ones are unknown."""
    speeds = samples.values
    has_front = not np.isnan(speeds[:, :2]).all()
    return WheelSamples(samples.t_ns, speeds if has_front else speeds[:, 2:])


def turn_samples(signal: Signal | None, found: Mapping[Signal, Samples]) -> TurnSignal | None:
    """Return the samples of a source of turns; None for the difference of the wheel speeds."""
    if signal is None:
        return None
    kind: TurnKind = "yaw rate" if signal is Signal.YAW_RATE else "steering"
    return TurnSignal(found[signal].t_ns, found[signal].values, kind)
