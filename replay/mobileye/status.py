"""Status frames (0x738): which open a burst, when their images were grabbed, their table."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, Int64s
from crosscue.replay.ledger import Ledger

from .admit import Admitted
from .bits import Words, extract
from .bursts import Status, no_status
from .clock import CounterClock
from .layout import UNKNOWN, VARIANTS, Field, Message, layout
from .settings import MobileyeSettings
from .tables import table_block
from .wire import Columns, Variant, columns_of, values_of, variant_number

REPEATED_STATUS: Final = "repeated status frame"
KNOWN_PROTOCOLS: Final = (1, 3)
"""Protocol versions met with status frames of 6 bytes."""


class Statuses:
    """Reads the status frames of one bus, in the order of the log.

    Attributes:
        last: The last one that opened a burst, if any.
    """

    def __init__(
        self, bus: str, ledger: Ledger, settings: MobileyeSettings, clock: CounterClock
    ) -> None:
        self.last = no_status()
        self._bus = bus
        self._ledger = ledger
        self._settings = settings
        self._clock = clock
        self._message = layout()["status"]
        self._number = layout().messages.index(self._message)
        self._fields: dict[str, Field] = {f.name: f for f in self._message.fields}
        self._opened = 0
        self._word = np.zeros(0, dtype=np.uint64)
        self._log_ns = np.zeros(0, dtype=np.int64)

    def __call__(self, frames: Admitted) -> tuple[Status, Block | None, Int64s]:
        """The bursts opened, their rows, and the burst that each frame is in."""
        at = np.flatnonzero(frames.message == self._number)
        opens = self._opens(frames.words[at], frames.log_ns[at])
        self._report_repeated(frames.log_ns[at[~opens]])
        at = at[opens]
        burst_at = np.zeros(len(frames), dtype=np.int64)
        burst_at[at] = 1
        burst_at = np.cumsum(burst_at) + self._opened - 1
        if not len(at):
            return no_status(), None, burst_at
        opened, block = self._rows(frames.take(at))
        self._opened += len(at)
        self.last = opened.take(np.s_[-1:])
        return opened, block, burst_at

    def _opens(self, words: Words, log_ns: Int64s) -> NDArray[np.bool_]:
        word = np.concatenate([self._word, words])
        log = np.concatenate([self._log_ns, log_ns])
        is_repeated = word[1:] == word[:-1]
        is_repeated &= np.abs(log[1:] - log[:-1]) < self._settings.repeat_within_ns
        opens = np.ones(len(words), dtype=np.bool_)
        opens[len(words) - len(is_repeated) :] = ~is_repeated
        self._word, self._log_ns = word[-1:], log[-1:]
        return opens

    def _report_repeated(self, log_ns: Int64s) -> None:
        if len(log_ns):
            self._ledger.skip(self._bus, REPEATED_STATUS, len(log_ns), "0x738", int(log_ns[0]))

    def _rows(self, frames: Admitted) -> tuple[Status, Block]:
        variant = by_length(self._message, frames.length, self._settings)
        columns = columns_of(self._message, values_of(self._message, frames.words, variant))
        counter_ms = self._raw("counter_ms", frames.words)
        image_ns = self._clock.feed(counter_ms, frames.log_ns)
        number = self._opened + np.arange(len(frames), dtype=np.int64)
        self._check(variant, self._raw("protocol_version", frames.words))
        count = self._raw("count", frames.words)
        slots = self._settings.slots
        if (count > slots).any():
            self._ledger.notice(
                f"{self._bus}: a status frame announces {int(count.max())} obstacles; "
                f"there are {slots} slots"
            )
        leading: Columns = {
            "t_ns": image_ns,
            "burst": number,
            "latency_ns": frames.log_ns - image_ns,
            "layout": variant,
        }
        block = table_block(self._bus, "status", frames.log_ns, leading | columns, image_ns)
        return Status(number, frames.log_ns, image_ns, count, variant), block

    def _raw(self, name: str, words: Words) -> Int64s:
        f = self._fields[name]
        return extract(words, f.start, f.bits, f.signed, False)

    def _check(self, variant: Variant, protocol: Int64s) -> None:
        earlier = self.last.variant
        both = np.concatenate([earlier, variant])
        if len(np.unique(both)) > 1:
            self._ledger.notice(
                f"{self._bus}: status frames of both revisions (6 and 7 bytes) on one bus; each "
                "frame is read by its own; are there two devices?"
            )
        is_classic = variant == variant_number("classic")
        strange = np.setdiff1d(protocol[is_classic], KNOWN_PROTOCOLS)
        if len(strange):
            self._ledger.notice(
                f"{self._bus}: protocol version {int(strange[0])} with status frames of 6 bytes is "
                "new to us; read as the classic layout by length; check a known drive, or set the "
                "revision"
            )


def by_length(message: Message, length: NDArray[np.uint8], settings: MobileyeSettings) -> Variant:
    """The variant of frames by length; where the log keeps none, by a revision that is set."""
    stand_in = variant_number(settings.revision) if message.name == "status" else UNKNOWN
    of_length = np.full(256, stand_in, dtype=np.int8)
    for n, name in message.variants.items():
        of_length[n] = VARIANTS.index(name)
    variant: Variant = of_length[length]
    return variant
