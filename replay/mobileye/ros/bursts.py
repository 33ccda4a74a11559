"""Assign obstacle messages to status messages, across two topics of a bag."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Int64s
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.bursts import NO_BURST
from crosscue.replay.mobileye.layout import Columns
from crosscue.replay.mobileye.settings import MobileyeSettings

NOT_COME: Final = "obstacle messages announced by a status message but missing"


@dataclass(frozen=True, slots=True, eq=False)
class Obstacles:
    """Obstacle messages.

    Attributes:
        stamp_ns: Header stamps, shape (N,).
        log_ns: Log times, shape (N,).
        columns: Columns by name, each of shape (N,).
    """

    stamp_ns: Int64s
    log_ns: Int64s
    columns: Columns

    def take(self, index: NDArray[np.bool_]) -> Obstacles:
        """Return the messages selected by ``index``."""
        picked = {name: column[index] for name, column in self.columns.items()}
        return Obstacles(self.stamp_ns[index], self.log_ns[index], picked)

    def __add__(self, later: Obstacles) -> Obstacles:
        both = {n: np.concatenate([c, later.columns[n]]) for n, c in self.columns.items()}
        stamp_ns = np.concatenate([self.stamp_ns, later.stamp_ns])
        return Obstacles(stamp_ns, np.concatenate([self.log_ns, later.log_ns]), both)


class RosBursts:
    """Buffer of obstacles until the status messages up to their time are read."""

    def __init__(self, topic: str, ledger: Ledger, settings: MobileyeSettings) -> None:
        self.has_status = True
        self._topic = topic
        self._ledger = ledger
        self._slots = settings.slots
        self._within_ns = settings.within_ns
        none = np.zeros(0, dtype=np.int64)
        self._stamp_ns, self._image_ns, self._count, self._number = none, none, none, none
        self._added = 0
        self._held: Obstacles | None = None

    def add_status(self, stamp_ns: Int64s, image_ns: Int64s, count: Int64s) -> Int64s:
        """Add status messages, and return their burst numbers."""
        number = self._added + np.arange(len(stamp_ns), dtype=np.int64)
        self._added += len(stamp_ns)
        stamp_ns = np.concatenate([self._stamp_ns, stamp_ns])
        order = np.argsort(stamp_ns, kind="stable")
        self._stamp_ns = stamp_ns[order]
        self._image_ns = np.concatenate([self._image_ns, image_ns])[order]
        self._count = np.concatenate([self._count, count])[order]
        self._number = np.concatenate([self._number, number])[order]
        return number

    def hold(self, obstacles: Obstacles) -> Obstacles | None:
        """Add obstacle messages, and return those that are ready, with columns of their bursts."""
        self._held = obstacles if self._held is None else self._held + obstacles
        return self.release()

    def release(self, is_last: bool = False) -> Obstacles | None:
        """Return obstacles of complete bursts, or all of them at the end."""
        held = self._held
        if held is None or not len(held.stamp_ns):
            if is_last:
                self._settle(np.zeros(0, dtype=np.intp), len(self._stamp_ns) - 1)
            return None
        at = np.searchsorted(self._stamp_ns, held.stamp_ns, side="right") - 1
        # Obstacles of the newest burst, or the status of the newest obstacles, may still follow.
        newest = len(self._stamp_ns) - 1 if is_last else int(at.max())
        ready = np.full(len(at), is_last or not self.has_status) | (at < newest)
        if not ready.any():
            return None
        self._held = held.take(~ready)
        placed = self._placed(held.take(ready), at[ready])
        self._settle(at[ready], newest)
        return placed

    def _placed(self, obstacles: Obstacles, at: NDArray[np.intp]) -> Obstacles:
        stamp_ns = obstacles.stamp_ns
        image_ns, status_ns = stamp_ns, stamp_ns
        number = np.full(len(at), NO_BURST, dtype=np.int64)
        if len(self._stamp_ns):
            is_known = (at >= 0) & (stamp_ns - self._stamp_ns[at] <= self._within_ns)
            number = np.where(is_known, self._number[at], NO_BURST)
            image_ns = np.where(is_known, self._image_ns[at], stamp_ns)
            status_ns = np.where(is_known, self._stamp_ns[at], stamp_ns)
        if self.has_status and (number == NO_BURST).any():
            self._ledger.notice(
                f"{self._topic}: obstacle messages without a status message shortly before them "
                "keep their own time and have burst -1"
            )
        leading: Columns = {
            "t_ns": image_ns,
            "status_log_ns": status_ns,
            "burst": number,
            "slot": _rank(number).astype(np.int8),
        }
        return Obstacles(stamp_ns, obstacles.log_ns, leading | obstacles.columns)

    def _settle(self, at: NDArray[np.intp], upto: int) -> None:
        """Report announced obstacles that are missing, and discard the bursts before ``upto``."""
        upto = max(upto, 0)
        came = np.bincount(at[at >= 0], minlength=upto)[:upto]
        lacking = np.minimum(self._count[:upto], self._slots) - came
        for k in np.flatnonzero(lacking > 0).tolist() if self._topic else ():
            detail, t_ns = f"burst {int(self._number[k])}", int(self._stamp_ns[k])
            self._ledger.drop(self._topic, NOT_COME, int(lacking[k]), detail, t_ns)
        self._stamp_ns, self._image_ns = self._stamp_ns[upto:], self._image_ns[upto:]
        self._count, self._number = self._count[upto:], self._number[upto:]


def _rank(number: Int64s) -> Int64s:
    """Return the index of each row within its burst."""
    order = np.argsort(number, kind="stable")
    ordered = number[order]
    rank = np.empty(len(number), dtype=np.int64)
    rank[order] = np.arange(len(number)) - np.searchsorted(ordered, ordered)
    return np.where(number == NO_BURST, -1, rank)
