"""Updates of a pose track with GNSS positions; optional, because the published method has none.

A receiver's errors persist for many seconds, so readings closer together than ``interval_s`` are
skipped. A reading is about ``delay_s`` old at its timestamp, so it is moved ahead by the distance
that the car travels in that time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from .ekf import PoseBelief, pack_belief, update_point
from .fixes import NO_FIXES, Fixes
from .pose_filter import at_point


@dataclass(slots=True)
class PositionCounts:
    """Account of the positions.

    Attributes:
        received: Number of positions processed.
        accepted: Positions used.
        thinned: Positions skipped because they are too soon after the last used one.
        rejected: Positions rejected by the gate.
        late: Positions skipped because they are earlier than the estimate or without odometry.
    """

    received: int = 0
    accepted: int = 0
    thinned: int = 0
    rejected: int = 0
    late: int = 0


@dataclass(slots=True)
class PositionUpdates:
    """``MeasurementSource`` of a pose track: positions of the antenna in the map frame.

    Attributes:
        lever_m: Position of the antenna, ahead of and to the left of the rear axle.
        interval_s: Minimum time between two positions in use.
        gate_nis: Normalised innovation squared (two degrees of freedom) above which a position is
            rejected.
        delay_s: Age of a position at its timestamp.
        counts: Account of the positions.
    """

    lever_m: tuple[float, float] = (0.0, 0.0)
    interval_s: float = 1.0
    gate_nis: float = 13.8
    delay_s: float = 0.0
    counts: PositionCounts = field(default_factory=PositionCounts)
    _waiting: Fixes = NO_FIXES
    _used: list[tuple[int, float, float, float, float, float]] = field(default_factory=list)
    _counted_ns: int | None = None

    def add(self, fixes: Fixes) -> None:
        """Add a window's positions; those later than the odometry wait."""
        self.counts.received += len(fixes)
        self._waiting += fixes

    def times_ns(self) -> Sequence[int]:
        """Times of waiting positions."""
        times: list[int] = self._waiting.t_ns.tolist()
        return times

    def update(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Update with the position of the belief's time."""
        self.let_go(belief.t_ns)
        fix, self._waiting = self._waiting.take(slice(0, 1)), self._waiting.take(slice(1, None))
        if not self._is_due(belief.t_ns):
            self.counts.thinned += 1
            return None
        antenna = at_point(pack_belief(belief), *self.lever_m)
        moved_m = self.delay_s * antenna.speed_mps
        heading = antenna.heading_rad
        xy_m = fix.xy_m[0] + moved_m * np.array([math.cos(heading), math.sin(heading)])
        cov_m2 = fix.cov_m2[0]
        done = update_point(belief, xy_m, cov_m2, self.lever_m, self.gate_nis)
        if not done.is_accepted:
            self.counts.rejected += 1
            return None
        self.counts.accepted += 1
        self._counted_ns = belief.t_ns
        (xx, xy), (_, yy) = cov_m2.tolist()
        x_m, y_m = xy_m.tolist()
        self._used.append((belief.t_ns, x_m, y_m, xx, xy, yy))
        return done.belief

    def let_go(self, before_ns: int) -> None:
        """Drop positions that are before all further odometry."""
        late = int(np.searchsorted(self._waiting.t_ns, before_ns))
        self.counts.late += late
        self._waiting = self._waiting.take(slice(late, None))

    def take_used(self) -> list[tuple[int, float, float, float, float, float]]:
        """Return time, x, y, xx, xy and yy of the positions used since the last call."""
        taken, self._used = self._used, []
        return taken

    def _is_due(self, t_ns: int) -> bool:
        # A tolerance for jitter of the clock.
        spacing_ns = 0.95e9 * self.interval_s
        return self._counted_ns is None or t_ns - self._counted_ns >= spacing_ns
