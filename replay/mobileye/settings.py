"""How one Mobileye is read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from crosscue.replay.base import Ledger

from .geometry import AT_REAR_AXLE, Mounting

Revision: TypeAlias = Literal["auto", "classic", "2.32"]
Family: TypeAlias = Literal["auto", "extended", "tsr"]
LaneSign: TypeAlias = Literal["auto", "right", "left"]


@dataclass(frozen=True, slots=True)
class MobileyeSettings:
    """How frames become columns.

    Attributes:
        revision: Protocol revision; ``auto`` takes it from the length of the status frame (0x738),
            6 bytes for ``classic`` and 7 for ``2.32``.
        family: Which of two families of devices sends 0x700; ``auto`` decides when a bit is set
            that only one of them has.
        slots: Obstacle slots, 10 or 13; with 10 the identifiers above 0x756 are foreign. 0x760 is
            always the vehicle signals.
        mounting: None counts as at the rear axle, with a notice.
        within_ns: How long after its 0x738 a frame of the same image may come, and how long after
            its first half the second half of a lane. Below the shortest time between two images.
        repeat_within_ns: A status frame equal to the one before and this close after it is a
            repetition, not a new image.
        min_latency_ns: What the fastest frame took from image to log; the log alone cannot tell.
        is_shared_bus: Another decoder reads the same bus and accounts for what is not the device's.
        ros_lane_sign: Which way lanes in ROS messages are positive; ``auto`` examines which side
            the left and right lane lie.
    """

    revision: Revision = "auto"
    family: Family = "auto"
    slots: Literal[10, 13] = 13
    mounting: Mounting | None = None
    within_ns: int = 50_000_000
    repeat_within_ns: int = 20_000_000
    min_latency_ns: int = 0
    is_shared_bus: bool = False
    ros_lane_sign: LaneSign = "auto"

    def __post_init__(self) -> None:
        """Refuse times that cannot be.

        Raises:
            ValueError: Naming the field and what was wanted.
        """
        for name in ("within_ns", "repeat_within_ns"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: expected > 0, got {getattr(self, name)}")
        if self.slots not in (10, 13):
            raise ValueError(f"slots: expected 10 or 13, got {self.slots}")


DEFAULTS: Final = MobileyeSettings()


def mounting_of(settings: MobileyeSettings, bus: str, ledger: Ledger) -> Mounting:
    """Where the reference point lies; if not stated, at the rear axle, which is reported."""
    if settings.mounting is None:
        ledger.notice(
            f"{bus}: where the Mobileye's reference point lies is not given; distances count "
            "from it as if it were the rear axle; calibrate x_m and y_m in the vehicle file"
        )
    return settings.mounting or AT_REAR_AXLE
