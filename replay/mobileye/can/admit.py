"""Identify the frames of a Mobileye on a bus, and their messages."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import (
    DATA,
    ERROR,
    LENGTH_UNKNOWN,
    REMOTE,
    CanFrames,
    ColumnSet,
    Int64s,
)
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.bits import Words, leading_words
from crosscue.replay.mobileye.layout import Message, layout
from crosscue.replay.mobileye.settings import MobileyeSettings

ERROR_FRAME: Final = "error frame"
REMOTE_FRAME: Final = "remote frame"
EXTENDED: Final = "extended identifier, not a Mobileye's"
FD_FRAME: Final = "CAN FD frame, not a Mobileye's"
FOREIGN: Final = "id not in the Mobileye table"
WRONG_LENGTH: Final = "length that its Mobileye message does not have"
_REASONS: Final = (ERROR_FRAME, REMOTE_FRAME, EXTENDED, FD_FRAME, FOREIGN, WRONG_LENGTH)

_STANDARD_IDS: Final = 2048
_IDS_TOLD: Final = 8
_LENGTHS: Final = 256


@dataclass(frozen=True, slots=True, eq=False)
class Admitted(ColumnSet):
    """Frames of the Mobileye, in the order of the log.

    Attributes:
        message: Index of each frame's message in ``layout()``, shape (N,), int64.
        instance: Slot, side or position of the message, shape (N,), int64.
        length: Payload lengths, shape (N,), uint8.
        log_ns: Log times, shape (N,).
        words: Payloads, shape (N,).
    """

    message: Int64s
    instance: Int64s
    length: NDArray[np.uint8]
    log_ns: Int64s
    words: Words


class Admission:
    """Filter for the Mobileye's frames of a bus, which reports all others in the ledger."""

    def __init__(self, bus: str, ledger: Ledger, settings: MobileyeSettings) -> None:
        self._bus = bus
        self._ledger = ledger
        self._is_shared_bus = settings.is_shared_bus
        messages = layout().values()
        self._message = np.full(_STANDARD_IDS + 1, -1, dtype=np.int64)
        self._instance = np.zeros(_STANDARD_IDS + 1, dtype=np.int64)
        self._fits = np.zeros((len(messages), _LENGTHS), dtype=np.bool_)
        for k, message in enumerate(messages):
            ids = list(ids_of(message, settings))
            self._message[ids] = k
            self._instance[ids] = np.arange(len(ids))
            self._fits[k, list(lengths_of(message, settings))] = True
            self._fits[k, LENGTH_UNKNOWN] = True

    def __call__(self, frames: CanFrames, log_ns: Int64s) -> Admitted:
        """Return the frames that can be decoded."""
        message = self._message.take(frames.arbitration_id, mode="clip")
        is_plain = (frames.kind == DATA) & ~frames.is_extended & ~frames.is_fd
        good = is_plain & (message >= 0) & self._fits[message, frames.length]
        if not good.all():
            self._report(frames, message, ~good, log_ns)
        return Admitted(
            message[good],
            self._instance.take(frames.arbitration_id[good], mode="clip"),
            frames.length[good],
            log_ns[good],
            leading_words(frames.data[good]),
        )

    def _report(
        self, frames: CanFrames, message: Int64s, bad: NDArray[np.bool_], log_ns: Int64s
    ) -> None:
        if self._is_shared_bus:
            # The decoder of the bus reports all other identifiers.
            bad = bad & (frames.kind == DATA) & ~frames.is_extended & (message >= 0)
        rows = np.flatnonzero(bad)
        which = np.select(
            [
                frames.kind[rows] == ERROR,
                frames.kind[rows] == REMOTE,
                frames.is_extended[rows],
                frames.is_fd[rows],
                message[rows] < 0,
            ],
            list(range(5)),
            5,
        )
        for number, reason in enumerate(_REASONS):
            of_reason = rows[which == number]
            if not len(of_reason):
                continue
            detail = _ids_text(frames.arbitration_id[of_reason])
            first_ns = int(log_ns[of_reason[0]])
            self._ledger.skip(self._bus, reason, len(of_reason), detail, first_ns)


def ids_of(message: Message, settings: MobileyeSettings) -> tuple[int, ...]:
    """Return the identifiers of ``message`` on this device."""
    return message.ids[: settings.slots] if message.table == "obstacles" else message.ids


def all_ids(settings: MobileyeSettings) -> frozenset[int]:
    """Return all identifiers of this device."""
    return frozenset(i for message in layout().values() for i in ids_of(message, settings))


def lengths_of(message: Message, settings: MobileyeSettings) -> tuple[int, ...]:
    """Return the valid lengths of ``message``; a set revision determines that of the status."""
    if message.name == "status" and settings.revision != "auto":
        return tuple(n for n, name in message.variants.items() if name == settings.revision)
    return message.lengths


def _ids_text(ids: NDArray[np.uint32]) -> str:
    values, counts = np.unique(ids, return_counts=True)
    reported = ", ".join(
        f"0x{i:03X} ({n})"
        for i, n in zip(values[:_IDS_TOLD].tolist(), counts[:_IDS_TOLD].tolist(), strict=True)
    )
    more = len(values) - _IDS_TOLD
    return f"{reported} and {more} more ids" if more > 0 else reported
