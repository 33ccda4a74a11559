"""Unwrap the 8-bit millisecond counter of 0x738 with the log's clock.

The counter holds the low 8 bits of the device's image-grab time in milliseconds. It determines the
time between images exactly, modulo 256 ms. The log records approximately when each frame arrived:

    log time = image time + latency,    image time = counter + 256 ms * k + (device - log offset).

**Limits.** The device's clock has no known relation to the log's, so the latency is known only up
to a constant. The fastest frame is taken to have none, and the others have their additional delay.
The latency is also known only modulo 256 ms: a frame that the host delayed by at least 240 ms more
than the fastest frame has an image time that is 256 ms late. A notice reports this where it is
visible (the next image would be earlier), or if a counter restarts.

The offset follows the fastest frames: downwards as fast as the order of images allows, and upwards
by at most the drift of a crystal.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

MS: Final = 1_000_000
WRAP_NS: Final = 256 * MS

# Max drift between two clocks; a crystal is off by at most 100 parts per million.
DRIFT: Final = 200e-6
FIRST_EARLY_NS: Final = 128 * MS
LAST_EARLY_NS: Final = 16 * MS
# Number of frames after which the offset is settled. The first frame may be slow, so earlier frames
# may be faster by up to half a wrap.
SETTLED_AFTER: Final = 15
# Time without a frame after which the offset restarts, because of possible drift.
GAP_NS: Final = 60_000 * MS
WATCHED: Final = 32
# If none of ``WATCHED`` frames is this close to the fastest, the counter or a clock was set.
STEP_NS: Final = 12 * MS

WENT_BACK: Final = "the log's clock was set back, image times restart"
LONG_GAP: Final = "a gap is too long to follow the clocks' drift, image times restart"
SET_ANEW: Final = "the millisecond counter was reset, or every frame takes longer than before"
OUT_OF_ORDER: Final = (
    "an image would precede its predecessor: a frame is 240 ms late, or the counter was reset"
)


class CounterClock:
    """Times at which images were grabbed, however the frames are divided into pieces."""

    def __init__(self) -> None:
        self._offset_ns = 0
        self._frames = 0
        self._log_ns = 0
        self._image_ns = 0
        self._fastest_ns = WRAP_NS
        self._watched = 0
        self._noticed: dict[str, tuple[int, int]] = {}

    def feed(self, counter_ms: NDArray[np.integer], log_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the image times of the next frames on the log's clock, shape (N,).

        They are never after the frame's log time, and never decrease unless the log times do.
        """
        pairs = zip(counter_ms.tolist(), log_ns.tolist(), strict=True)
        return np.array([self._next(c * MS, t) for c, t in pairs], dtype=np.int64)

    @property
    def notices(self) -> tuple[str, ...]:
        """Return the notices so far, with their count and first time."""
        return tuple(
            f"{what} ({count} times, first at {first_ns} ns)"
            for what, (first_ns, count) in self._noticed.items()
        )

    def _next(self, counter_ns: int, log_ns: int) -> int:
        elapsed_ns = log_ns - self._log_ns
        if not self._frames:
            return self._start(counter_ns, log_ns)
        if elapsed_ns < 0:
            self._notice(WENT_BACK, log_ns)
            return self._start(counter_ns, log_ns)
        if elapsed_ns > GAP_NS:
            self._notice(LONG_GAP, log_ns)
            return self._start(counter_ns, log_ns)
        self._log_ns = log_ns
        early_ns = self._early()
        over_ns = (log_ns - counter_ns - self._offset_ns + early_ns) % WRAP_NS - early_ns
        over_ns = self._watch(self._follow(over_ns, elapsed_ns), log_ns)
        self._frames += 1
        return self._in_order(log_ns - max(over_ns, 0), log_ns)

    def _start(self, counter_ns: int, log_ns: int) -> int:
        self._offset_ns = (log_ns - counter_ns) % WRAP_NS
        self._frames = 1
        self._fastest_ns, self._watched = WRAP_NS, 0
        self._image_ns = self._log_ns = log_ns
        return log_ns

    def _early(self) -> int:
        if self._frames >= SETTLED_AFTER:
            return LAST_EARLY_NS
        fraction = self._frames / SETTLED_AFTER
        return int(FIRST_EARLY_NS + fraction * (LAST_EARLY_NS - FIRST_EARLY_NS))

    def _follow(self, over_ns: int, elapsed_ns: int) -> int:
        """Move the offset towards the fastest frames, and return the remainder."""
        if over_ns < 0:
            change_ns = max(over_ns, -(elapsed_ns // 2))
        else:
            change_ns = min(over_ns, int(DRIFT * elapsed_ns))
        self._offset_ns += change_ns
        return over_ns - change_ns

    def _watch(self, over_ns: int, log_ns: int) -> int:
        """Restart the offset if frames are no longer close to it."""
        self._fastest_ns = min(self._fastest_ns, over_ns)
        self._watched += 1
        if self._watched < WATCHED:
            return over_ns
        fastest_ns, self._fastest_ns, self._watched = self._fastest_ns, WRAP_NS, 0
        if fastest_ns <= STEP_NS:
            return over_ns
        self._notice(SET_ANEW, log_ns)
        self._offset_ns += fastest_ns
        return over_ns - fastest_ns

    def _in_order(self, image_ns: int, log_ns: int) -> int:
        if image_ns < self._image_ns:
            self._notice(OUT_OF_ORDER, log_ns)
        self._image_ns = max(image_ns, self._image_ns)
        return self._image_ns

    def _notice(self, what: str, log_ns: int) -> None:
        first_ns, count = self._noticed.get(what, (log_ns, 0))
        self._noticed[what] = (first_ns, count + 1)
