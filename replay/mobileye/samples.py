"""Extract samples of a Mobileye's lanes and obstacles for estimators, from CAN or ROS."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, CanFrames, Floats, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.ros.reader import RosMobileye
from crosscue.replay.signals.kinds import LANE_COLUMNS, OBSTACLE_COLUMNS, Samples, Signal
from crosscue.replay.vehicle.vehicle import Mobileye

from .settings import MobileyeSettings


class MobileyeStream:
    """Reader of one device, from frames of its bus or from messages, a block at a time."""

    def __init__(
        self,
        bus: str,
        ledger: Ledger,
        section: Mobileye,
        types: Mapping[str, str],
        *,
        is_shared_bus: bool,
    ) -> None:
        """Prepare the decoders.

        Args:
            bus: Topic of the bus; any name for messages.
            ledger: Ledger that records unusable rows.
            section: The Mobileye's section of the vehicle file.
            types: Message types by topic name.
            is_shared_bus: True if the vehicle's signals are read from the same bus.
        """
        settings = mobileye_settings(section, is_shared_bus=is_shared_bus)
        self._of_frames = MobileyeDecoder(bus, ledger, settings) if not types else None
        self._of_messages = RosMobileye(bus, types, ledger, settings) if types else None

    def __call__(self, block: Block) -> Iterator[Samples]:
        """Yield the samples of a block of frames, or of decoded messages."""
        if self._of_frames is not None and isinstance(block.rows, CanFrames):
            yield from samples_of(self._of_frames(block))
        elif self._of_messages is not None:
            yield from samples_of(self._of_messages(block))

    def flush(self) -> Iterator[Samples]:
        """Yield the samples held back as incomplete; to be called once, at the log's end."""
        reader = self._of_frames or self._of_messages
        if reader is not None:
            yield from samples_of(reader.flush())


def mobileye_settings(section: Mobileye, *, is_shared_bus: bool) -> MobileyeSettings:
    """Return the decoder's settings from the vehicle file; without ``x_m`` there is no mounting."""
    mounting = (
        None if section.x_m is None else DevicePosition(section.x_m, section.y_m, section.yaw_rad)
    )
    return MobileyeSettings(
        section.revision, section.family, section.slots, mounting, is_shared_bus=is_shared_bus
    )


def samples_of(blocks: Iterable[Block]) -> Iterator[Samples]:
    """Convert tables of the decoder to samples, at their log times."""
    for block in blocks:
        name = block.topic.rpartition("/")[2]
        if isinstance(block.rows, Table) and name in _TABLES:
            signal, names = _TABLES[name]
            yield Samples(signal, block.log_ns, _stacked(block.rows, names))


def _stacked(rows: Table, names: tuple[str, ...]) -> Floats:
    absent = np.full(len(rows), np.nan)
    return np.stack(
        [np.asarray(rows.columns.get(name, absent), np.float64) for name in names], axis=1
    )


_TABLES: Final = {
    "status": (Signal.MOBILEYE_OBSTACLES, OBSTACLE_COLUMNS),
    "obstacles": (Signal.MOBILEYE_OBSTACLES, OBSTACLE_COLUMNS),
    "lanes": (Signal.MOBILEYE_LANES, LANE_COLUMNS),
}
