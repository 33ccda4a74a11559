"""Columns of ``pose.parquet``, and their summary for a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from crosscue.localization.pose_track import PoseColumns

COVARIANCES: Final = ("xx_m2", "xy_m2", "xh_mrad", "yy_m2", "yh_mrad", "hh_rad2")


@dataclass(slots=True)
class PoseTally:
    """Running summary of all poses of a run."""

    rows: int = 0
    travelled_m: float = 0.0
    major_axis_m: float = float("nan")
    first_ns: int | None = None
    last_ns: int = 0

    @property
    def seconds(self) -> float:
        """Time from the first row to the last."""
        return 0.0 if self.first_ns is None else (self.last_ns - self.first_ns) * 1e-9

    def add(self, poses: PoseColumns) -> None:
        """Add a non-empty batch of poses."""
        self.rows += len(poses)
        self.travelled_m = float(poses.travelled_m[-1])
        self.major_axis_m = float(poses.major_axis_m[-1])
        self.last_ns = int(poses.t_ns[-1])
        if self.first_ns is None:
            self.first_ns = int(poses.t_ns[0])


def pose_rows(poses: PoseColumns, landmarks: Sequence[str | None]) -> dict[str, object]:
    """Return rows of ``pose.parquet``, with the landmark that corrected each pose."""
    rows: dict[str, object] = {
        "t_ns": poses.t_ns,
        "x_m": poses.x_m,
        "y_m": poses.y_m,
        "heading_rad": poses.heading_rad,
        "speed_mps": poses.speed_mps,
    }
    rows |= {f"cov_{name}": poses.cov_xyh[:, i] for i, name in enumerate(COVARIANCES)}
    rows |= {"major_axis_m": poses.major_axis_m, "travelled_m": poses.travelled_m}
    return rows | {"landmark": list(landmarks)}
