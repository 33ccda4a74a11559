"""Time series of signals, and the common time grid on which they are compared.

Speeds are compared at common times. Yaw rates are compared by their integral over a few seconds,
because a GNSS course is too noisy to be differentiated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats, Int64s

STEP_S: Final = 0.1
WINDOW_S: Final = 2.0
# Number of steps in a window.
STEPS: Final = round(WINDOW_S / STEP_S)
# Maximum gap that is interpolated; GNSS fixes may be one second apart.
MAX_GAP_S: Final = 1.5
EARTH_RADIUS_M: Final = 6_371_000.0


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """N readings of one signal in SI units.

    Attributes:
        name: Name in the vehicle file's comments.
        t_ns: Shape (N,), int64: times, ascending.
        values: Shape (N,): readings.
    """

    name: str
    t_ns: Int64s
    values: Floats

    @classmethod
    def of(cls, name: str, t_ns: Int64s, values: Floats) -> Series:
        """Sort readings by time and omit those that are not finite."""
        keep = np.isfinite(values)
        order = np.argsort(t_ns[keep], kind="stable")
        return cls(name, t_ns[keep][order], np.asarray(values, np.float64)[keep][order])

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def rate_hz(self) -> float:
        """Readings per second, from the median interval; 0 for fewer than two readings."""
        steps_s = np.diff(self.t_ns) * 1e-9
        steps_s = steps_s[steps_s > 0.0]
        return float(1.0 / np.median(steps_s)) if len(steps_s) else 0.0

    def at(self, grid: Grid) -> Floats:
        """Interpolate the values at the grid's times; NaN inside longer gaps."""
        if len(self) < 2:
            return np.full(len(grid.t_ns), np.nan)
        values = np.interp(grid.t_ns, self.t_ns, self.values)
        after = np.clip(np.searchsorted(self.t_ns, grid.t_ns), 1, len(self) - 1)
        is_near = (self.t_ns[after] - self.t_ns[after - 1]) * 1e-9 <= MAX_GAP_S
        is_inside = (grid.t_ns >= self.t_ns[0]) & (grid.t_ns <= self.t_ns[-1])
        return np.where(is_near & is_inside, values, np.nan)

    def integral(self, t_ns: Int64s) -> Floats:
        """Return the integral up to each time; every reading counts, so that noise averages out."""
        steps = 0.5 * (self.values[1:] + self.values[:-1]) * np.diff(self.t_ns) * 1e-9
        area = np.concatenate([[0.0], np.cumsum(steps)])
        return np.asarray(np.interp(t_ns, self.t_ns, area), np.float64)

    def turned(self, grid: Grid) -> Floats:
        """Integrate an angular rate over each window, rad; NaN where readings are missing."""
        rate = self.at(grid)
        if not np.isfinite(rate).any():
            return np.full(grid.windows, np.nan)
        turned = np.diff(self.integral(grid.t_ns[::STEPS]))
        return np.where(grid.windows_where(np.isfinite(rate)), turned, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Common times, ``STEP_S`` apart, divided into windows of ``WINDOW_S``.

    Attributes:
        t_ns: Shape (N,), int64: the times.
    """

    t_ns: Int64s

    @classmethod
    def over(cls, start_ns: int, end_ns: int) -> Grid:
        """Create a grid of as many complete windows as fit between two times."""
        step_ns = round(STEP_S * 1e9)
        windows = max((end_ns - start_ns) // (step_ns * STEPS), 0)
        return cls(start_ns + np.arange(windows * STEPS + 1, dtype=np.int64) * step_ns)

    @property
    def windows(self) -> int:
        """Number of windows."""
        return (len(self.t_ns) - 1) // STEPS

    def windows_where(self, is_so: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask of the windows in which ``is_so`` is true throughout, edges included."""
        whole = np.asarray(is_so[:-1].reshape(self.windows, STEPS).all(axis=1), np.bool_)
        return whole & is_so[STEPS::STEPS]

    def mean(self, values: Floats) -> Floats:
        """Return the mean of each window."""
        return np.asarray(values[:-1].reshape(self.windows, STEPS).mean(axis=1), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class GroundTrack:
    """Speed and course over ground from GNSS.

    Attributes:
        speed: Speed, m/s.
        course: Course, rad from east, counter-clockwise and unwrapped.
    """

    speed: Series
    course: Series | None

    @classmethod
    def of_positions(
        cls, name: str, t_ns: Int64s, latitude_deg: Floats, longitude_deg: Floats
    ) -> GroundTrack | None:
        """Derive a track from fixes about one second apart; None for too few fixes."""
        keep = np.isfinite(latitude_deg) & np.isfinite(longitude_deg)
        t_ns, lat, lon = t_ns[keep], latitude_deg[keep], longitude_deg[keep]
        later = np.searchsorted(t_ns, t_ns + 900_000_000)
        first = np.flatnonzero(later < len(t_ns))
        if len(first) < 2:
            return None
        last = later[first]
        dt_s = (t_ns[last] - t_ns[first]) * 1e-9
        north = np.deg2rad(lat[last] - lat[first]) * EARTH_RADIUS_M
        east = np.deg2rad(lon[last] - lon[first]) * EARTH_RADIUS_M * np.cos(np.deg2rad(lat[first]))
        middle_ns = t_ns[first] + (t_ns[last] - t_ns[first]) // 2
        return cls.of_velocity(name, middle_ns, east / dt_s, north / dt_s)

    @classmethod
    def of_velocity(
        cls, name: str, t_ns: Int64s, east_mps: Floats, north_mps: Floats
    ) -> GroundTrack:
        """Derive a track from velocities over ground."""
        course = np.arctan2(north_mps, east_mps)
        return cls.of_course(name, t_ns, np.hypot(east_mps, north_mps), course)

    @classmethod
    def of_course(
        cls, name: str, t_ns: Int64s, speed_mps: Floats, course_rad: Floats
    ) -> GroundTrack:
        """Create a track from reported values, with courses only where the car clearly moves."""
        moves = np.isfinite(course_rad) & (speed_mps > 3.0)
        course = Series.of(name, t_ns[moves], np.unwrap(course_rad[moves]))
        speed = Series.of(name, t_ns, np.asarray(speed_mps, np.float64))
        return cls(speed, course if len(course) > 1 else None)
