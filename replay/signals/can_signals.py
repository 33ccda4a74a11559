"""Read a vehicle's signals from the frames of one bus, as named in the vehicle file."""

import difflib
from collections.abc import Collection, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Final

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import BusDecoder
from crosscue.replay.columns import Block
from crosscue.replay.errors import VehicleError
from crosscue.replay.ledger import Ledger
from crosscue.replay.vehicle.vehicle import Vehicle

from .converters import SPEED_UNITS, angle_samples, column_of, wheel_samples
from .kinds import MOBILEYE_SIGNALS, Samples, Signal


class CanSignals:
    """Reader of wheel speeds, yaw rate and steering of one bus, a block at a time."""

    def __init__(
        self, bus: str, ledger: Ledger, vehicle: Vehicle, signals: Collection[Signal]
    ) -> None:
        """Prepare the decoder.

        Args:
            bus: Topic of the bus.
            ledger: Ledger that records unusable frames.
            vehicle: Vehicle file, which names the signals.
            signals: Signals of this bus, including those of a Mobileye on the same bus.

        Raises:
            VehicleError: The database lacks a named signal.
        """
        self._can: Final = vehicle.can
        self._signals: Final = frozenset(signals)
        database = database_of(vehicle.can.dbc)
        for sentence in database.notices:
            ledger.notice(sentence)
        wanted = check_signals(database, vehicle, signals)
        elsewhere: Collection[int] = ()
        if not self._signals.isdisjoint(MOBILEYE_SIGNALS):
            from crosscue.replay.mobileye.can.admit import all_ids
            from crosscue.replay.mobileye.samples import mobileye_settings

            elsewhere = all_ids(mobileye_settings(vehicle.mobileye, is_shared_bus=True))
        self._decode: Final = BusDecoder(database, bus, ledger, wanted, elsewhere=elsewhere)

    def __call__(self, block: Block) -> Iterator[Samples]:
        """Yield the samples of a block of frames."""
        tables = {part.topic.rsplit("/", 1)[1]: part for part in self._decode(block)}
        can = self._can
        if can.wheel_speeds is not None and Signal.WHEEL_SPEEDS in self._signals:
            wheels = can.wheel_speeds
            names = (wheels.front_left, wheels.front_right, wheels.rear_left, wheels.rear_right)
            scales = dict(SPEED_UNITS)
            if wheels.wheel_radius_m is not None:
                scales["rad/s"] = wheels.wheel_radius_m
            columns = [
                column_of(tables, name, wheels.unit, scales, "can.wheel_speeds") for name in names
            ]
            yield from wheel_samples(columns)
        for section, signal, key in (
            (can.yaw_rate, Signal.YAW_RATE, "can.yaw_rate"),
            (can.steering, Signal.STEERING, "can.steering"),
        ):
            if section is not None and signal in self._signals:
                yield from angle_samples(tables, section, signal, key)


@lru_cache(maxsize=8)
def database_of(files: tuple[str, ...]) -> CanDatabase:
    """Read the database, once for both the probe of the clocks and the run."""
    return CanDatabase.load([Path(name) for name in files])


def check_signals(
    database: CanDatabase, vehicle: Vehicle, signals: Collection[Signal]
) -> frozenset[tuple[str, str]]:
    """Return the (message, signal) pairs that the vehicle file names, checked with the database.

    Args:
        database: Database of all buses.
        vehicle: The vehicle file.
        signals: Signals of one bus; pairs of other signals are omitted.

    Raises:
        VehicleError: The database lacks a name; the message suggests the nearest one.
    """
    known = {f"{m.topic_name}.{s.name}" for m in database.messages for s in m.signals}
    pairs: set[tuple[str, str]] = set()
    for of, key, name in _named_signals(vehicle):
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
            hint = f"did you mean {close[0]}?" if close else "look it up in the DBC file"
            # A damaged file is the likelier reason than a misspelt name.
            doubts = "".join(f"; {notice}" for notice in database.notices[:1])
            files = ", ".join(vehicle.can.dbc)
            raise VehicleError(f"{key} = {name!r}: no such signal in {files}; {hint}{doubts}")
        if of in signals:
            message, _, signal = name.partition(".")
            pairs.add((message, signal))
    return frozenset(pairs)


def _named_signals(vehicle: Vehicle) -> Iterator[tuple[Signal, str, str]]:
    can = vehicle.can
    if can.wheel_speeds is not None:
        for wheel in ("front_left", "front_right", "rear_left", "rear_right"):
            name = getattr(can.wheel_speeds, wheel)
            if name is not None:
                yield Signal.WHEEL_SPEEDS, f"can.wheel_speeds.{wheel}", name
    if can.yaw_rate is not None:
        yield Signal.YAW_RATE, "can.yaw_rate.signal", can.yaw_rate.signal
    if can.steering is not None:
        yield Signal.STEERING, "can.steering.signal", can.steering.signal
