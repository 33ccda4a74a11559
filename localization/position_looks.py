"""GNSS positions weighed into a pose track, as an option: the published method never does.

A receiver's errors last for many seconds, so readings closer together than ``interval_s`` do not
count. A reading is about ``delay_s`` old when it is stamped: it is carried ahead by the distance
that the car goes in that time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from .ekf import PoseBelief, packed, unpacked
from .fixes import NO_FIXES, Fixes
from .pose_filter import at_point, update_position


@dataclass(slots=True)
class PositionCounts:
    """What became of every position.

    Attributes:
        received: Positions that came up.
        accepted: Weighed in.
        thinned: Too soon after the last one used.
        rejected: Refused by the gate.
        late: Earlier than the estimate, or without odometry.
    """

    received: int = 0
    accepted: int = 0
    thinned: int = 0
    rejected: int = 0
    late: int = 0


@dataclass(slots=True)
class PositionLooks:
    """``Looks`` of a pose track: positions of the antenna in the map frame.

    Attributes:
        lever_m: The antenna, ahead of and to the left of the rear axle.
        interval_s: Time between two positions that count.
        gate_nis: Refuse a position whose normalised innovation squared (two degrees of freedom) is
            larger.
        delay_s: How old a position is at its stamp.
        counts: What became of them.
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
        """Take a window's positions; those later than the odometry wait."""
        self.counts.received += len(fixes)
        if len(fixes):
            self._waiting = Fixes(
                np.concatenate([self._waiting.t_ns, fixes.t_ns]),
                np.concatenate([self._waiting.xy_m, fixes.xy_m]),
                np.concatenate([self._waiting.cov_m2, fixes.cov_m2]),
            )

    def times_ns(self) -> Sequence[int]:
        """Of the positions that wait."""
        times: list[int] = self._waiting.t_ns.tolist()
        return times

    def weigh(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Weigh in the position of the belief's time."""
        self.let_go(belief.t_ns)
        fix, self._waiting = self._waiting.take(slice(0, 1)), self._waiting.take(slice(1, None))
        if not self._is_due(belief.t_ns):
            self.counts.thinned += 1
            return None
        ahead_m, left_m = self.lever_m
        antenna = at_point(packed(belief), ahead_m, left_m)
        moved_m = self.delay_s * antenna.speed_mps
        x_m = float(fix.xy_m[0, 0]) + moved_m * math.cos(antenna.heading_rad)
        y_m = float(fix.xy_m[0, 1]) + moved_m * math.sin(antenna.heading_rad)
        (xx, xy), (_, yy) = fix.cov_m2[0].tolist()
        done = update_position(antenna, x_m, y_m, xx, xy, yy, self.gate_nis)
        if not done.is_accepted:
            self.counts.rejected += 1
            return None
        self.counts.accepted += 1
        self._counted_ns = belief.t_ns
        self._used.append((belief.t_ns, x_m, y_m, xx, xy, yy))
        return unpacked(belief.t_ns, at_point(done.state, -ahead_m, -left_m))

    def let_go(self, before_ns: int) -> None:
        """Drop positions that no odometry will reach any more."""
        late = int(np.searchsorted(self._waiting.t_ns, before_ns))
        self.counts.late += late
        self._waiting = self._waiting.take(slice(late, None))

    def take_used(self) -> list[tuple[int, float, float, float, float, float]]:
        """Time, x, y, xx, xy and yy of the positions weighed in since the last call."""
        taken, self._used = self._used, []
        return taken

    def as_dict(self) -> dict[str, int]:
        """The counts, for the manifest."""
        return asdict(self.counts)

    def _is_due(self, t_ns: int) -> bool:
        # A little early is on time: a row of a jittery clock.
        spacing_ns = 0.95e9 * self.interval_s
        return self._counted_ns is None or t_ns - self._counted_ns >= spacing_ns
