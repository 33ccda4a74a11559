"""Extract samples of the planned signals from the blocks of a log."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeAlias, cast

import numpy as np

from crosscue.replay.base import Log, Selection
from crosscue.replay.clocks.clock import Clock, times_of
from crosscue.replay.clocks.reports import MAX_OFFSET_NS, ClockWatch
from crosscue.replay.columns import Block, Images, Int64s, Topic
from crosscue.replay.decode import Decoder, decoder_for
from crosscue.replay.ledger import Ledger
from crosscue.replay.vehicle.roles import Role, role_of

from .converters import FROM_TABLE
from .kinds import MOBILEYE_SIGNALS, Samples, Signal, SignalPlan, SignalSource

if TYPE_CHECKING:
    from crosscue.replay.decode.packets import PacketDecoder
    from crosscue.replay.vehicle.vehicle import Vehicle


# Duration at a log's start that is examined to choose a clock for each topic.
PROBE_NS: Final = 10_000_000_000


# Readers of buses and devices as ``module:class``, imported for a drive that has one.
READERS: Final = {
    Role.CAN: "crosscue.replay.signals.can_signals:CanSignals",
    Role.MOBILEYE: "crosscue.replay.mobileye.samples:MobileyeStream",
}

CanReader: TypeAlias = Callable[[Block], Iterator[Samples]]


class MobileyeReader(Protocol):
    """Reader of one device, a block at a time."""

    def __call__(self, block: Block, /) -> Iterator[Samples]:
        """Yield the samples of a block."""

    def flush(self) -> Iterator[Samples]:
        """Yield the samples held back as incomplete; to be called once, at the log's end."""


def _no_pictures(block: Block) -> None:
    """Ignore pictures."""


@dataclass(slots=True)
class SampleExtractor:
    """Extractor of samples from one log's blocks, with the state of buses between blocks.

    Attributes:
        planned: Plan of topics and signals.
        vehicle: The vehicle file.
        log: Index of the log.
        ledger: Ledger that records skipped rows.
        clocks: Clock of a topic's samples; the log clock for topics that are not listed.
        watch: Called with every decoded block.
        on_pictures: Called with every block of ``Images``, whose ``log_ns`` is on the chosen clock.
        shift_at: Difference between drive time and the log's own clock at a drive time, if blocks
            are in drive time; sensors' stamps are shifted likewise.
    """

    planned: SignalPlan
    vehicle: Vehicle
    log: int
    ledger: Ledger
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    watch: ClockWatch = field(default_factory=ClockWatch)
    on_pictures: Callable[[Block], None] = _no_pictures
    shift_at: Callable[[Int64s], Int64s] | None = None
    _decoders: dict[str, Decoder | None] = field(default_factory=dict)
    _buses: dict[str, CanReader] = field(default_factory=dict)
    _mobileye: MobileyeReader | None = None
    _packets: dict[str, PacketDecoder] = field(default_factory=dict)

    def __call__(self, block: Block) -> Iterator[Samples]:
        """Yield the samples of one block; unusable rows are skipped in the ledger."""
        source = next(
            (s for s in self.planned.sources if s.log == self.log and s.topic.name == block.topic),
            None,
        )
        if source is None:
            return
        if source.topic.encoding != "columns":
            if block.topic not in self._decoders:
                self._decoders[block.topic] = decoder_for(source.topic)
            decode = self._decoders[block.topic]
            if decode is None:
                self.ledger.skip(block.topic, "type not understood", len(block))
                return
            block = decode(block, self.ledger)
        if not len(block):
            return
        if self.shift_at is not None and block.header_ns is not None:
            block = replace(block, header_ns=self._shifted(block.header_ns, block.log_ns))
        self.watch.see(block)
        clock = self.clocks.get(block.topic, Clock.LOG)
        block = replace(block, log_ns=times_of(block, clock))
        if not {*source.signals}.isdisjoint(MOBILEYE_SIGNALS):
            yield from self._mobileye_stream(source)(block)
        if role_of(source.topic) is Role.CAN:
            if not {*source.signals} <= {*MOBILEYE_SIGNALS}:
                yield from self._can_signals(source)(block)
            return
        if isinstance(block.rows, Images):
            delay_ns = round(self.vehicle.camera.delay_s * 1e9)
            self._show(replace(block, log_ns=block.log_ns - delay_ns), block.rows)
        for signal in source.signals:
            if signal not in MOBILEYE_SIGNALS:
                yield from FROM_TABLE[signal](block, self.ledger)

    def _shifted(self, header_ns: Int64s, log_ns: Int64s) -> Int64s:
        """Return sensors' stamps in drive time; 0 (unset) if they differ from the log's clock."""
        assert self.shift_at is not None
        shifted = header_ns + self.shift_at(log_ns)
        follows = (header_ns > 0) & (np.abs(shifted - log_ns) <= MAX_OFFSET_NS)
        return np.where(follows, shifted, 0)

    def finish(self) -> Iterator[tuple[str, Samples]]:
        """Yield the samples held back as incomplete, with their topics, at the log's end.

        The last pictures of a video stream are passed to ``on_pictures``.
        """
        for packets in self._packets.values():
            for block in packets.flush():
                self.on_pictures(block)
        if self._mobileye is not None:
            source = self._mobileye_sources()[0]
            for samples in self._mobileye.flush():
                yield source.topic.name, samples

    def _show(self, block: Block, images: Images) -> None:
        """Pass pictures to ``on_pictures``, after decoding the packets of a video."""
        from crosscue.replay.decode.packets import PacketDecoder, is_stream

        if self.on_pictures is _no_pictures:
            return
        if not is_stream(images):
            self.on_pictures(block)
            return
        if block.topic not in self._packets:
            self._packets[block.topic] = PacketDecoder(block.topic, self.ledger)
        for shown in self._packets[block.topic](block):
            self.on_pictures(shown)

    def _mobileye_sources(self) -> list[SignalSource]:
        return [
            source
            for source in self.planned.sources
            if source.log == self.log and not {*source.signals}.isdisjoint(MOBILEYE_SIGNALS)
        ]

    def _mobileye_stream(self, source: SignalSource) -> MobileyeReader:
        if self._mobileye is None:
            types = {
                one.topic.name: one.topic.type_name
                for one in self._mobileye_sources()
                if role_of(one.topic) is Role.MOBILEYE
            }
            self._mobileye = _reader(Role.MOBILEYE)(
                source.topic.name,
                self.ledger,
                self.vehicle.mobileye,
                types,
                is_shared_bus=not {*source.signals} <= {*MOBILEYE_SIGNALS},
            )
        return self._mobileye

    def _can_signals(self, source: SignalSource) -> CanReader:
        bus = source.topic.name
        if bus not in self._buses:
            self._buses[bus] = _reader(Role.CAN)(bus, self.ledger, self.vehicle, source.signals)
        return self._buses[bus]


def _reader(role: Role) -> Callable[..., Any]:
    module, _, name = READERS[role].partition(":")
    return cast("Callable[..., Any]", getattr(import_module(module), name))


def probe_clocks(
    log: Log, planned: SignalPlan, vehicle: Vehicle, number: int, selection: Selection
) -> dict[str, Clock]:
    """Choose a clock for each planned topic from the log's first seconds.

    Args:
        log: The open log.
        planned: Plan of topics and signals.
        vehicle: The vehicle file.
        number: Index of the log in the plan.
        selection: Selection that will be read of the log.
    """
    extractor = SampleExtractor(planned, vehicle, number, Ledger(""))
    first_ns: int | None = None
    for block in log.read(extractor.ledger, selection):
        if not len(block):
            continue
        first_ns = int(block.log_ns[0]) if first_ns is None else first_ns
        for _ in extractor(block):
            pass
        if int(block.log_ns[0]) - first_ns > PROBE_NS:
            break
    return {name: report.used for name, report in extractor.watch.reports().items()}


def wheels_only(
    planned: SignalPlan, vehicle: Vehicle, number: int, clocks: Mapping[str, Clock]
) -> SampleExtractor:
    """Return an extractor that decodes only the wheel speeds of one log's blocks."""
    can = vehicle.can.model_copy(update={"yaw_rate": None, "steering": None})
    source = planned.source_of(Signal.WHEEL_SPEEDS)
    only = () if source is None else (replace(source, signals=(Signal.WHEEL_SPEEDS,)),)
    lean = vehicle.model_copy(update={"can": can})
    return SampleExtractor(SignalPlan(only, {}), lean, number, Ledger(""), clocks)


def pictures_of(
    log: Log, number: int, topic: Topic, vehicle: Vehicle, ledger: Ledger, selection: Selection
) -> Iterator[tuple[Block, Images]]:
    """Yield a camera's pictures in blocks, on the clock chosen from the log's first seconds.

    Args:
        log: The open log.
        number: Index of the log in the drive.
        topic: Topic of the camera.
        vehicle: The vehicle file.
        ledger: Ledger that records unusable rows.
        selection: Part of the log to read; its topics are ignored.
    """
    planned = SignalPlan((SignalSource(number, topic, ()),), {})
    wanted = Selection(frozenset({topic.name}), selection.start_ns, selection.end_ns)
    clocks = probe_clocks(log, planned, vehicle, number, wanted)
    found: list[Block] = []
    extractor = SampleExtractor(planned, vehicle, number, ledger, clocks, on_pictures=found.append)
    for block in log.read(ledger, wanted):
        for _ in extractor(block):
            pass
        for pictures in found:
            if isinstance(pictures.rows, Images):
                yield pictures, pictures.rows
        found.clear()
