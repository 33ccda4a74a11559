"""Settings of the decoder of a Mobileye."""

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from crosscue.replay.ledger import Ledger

from .geometry import AT_REAR_AXLE, DevicePosition

Revision: TypeAlias = Literal["auto", "classic", "2.32"]
Family: TypeAlias = Literal["auto", "extended", "tsr"]
LaneSign: TypeAlias = Literal["auto", "right", "left"]


@dataclass(frozen=True, slots=True)
class MobileyeSettings:
    """Settings for converting frames to columns.

    Attributes:
        revision: Protocol revision; ``auto`` determines it from the length of the status frame
            (0x738), 6 bytes for ``classic`` and 7 for ``2.32``.
        family: Family of devices that sends 0x700; ``auto`` decides as soon as a bit is set that
            only one of the two families has.
        slots: Number of obstacle slots, 10 or 13; with 10, identifiers above 0x756 are not the
            Mobileye's. 0x760 always contains the vehicle signals.
        mounting: Mounting of the device; None means at the rear axle, with a notice.
        within_ns: Max time from 0x738 to a frame of the same image, and from the first half of a
            lane to its second half. It must be below the shortest time between two images.
        repeat_within_ns: Max time between two equal status frames of which the second is a
            repetition, not a new image.
        is_shared_bus: True if another decoder reads the same bus and accounts for frames of other
            devices.
        ros_lane_sign: Positive direction of lanes in ROS messages; ``auto`` determines it from the
            positions of the left and the right lane.
    """

    revision: Revision = "auto"
    family: Family = "auto"
    slots: Literal[10, 13] = 13
    mounting: DevicePosition | None = None
    within_ns: int = 50_000_000
    repeat_within_ns: int = 20_000_000
    is_shared_bus: bool = False
    ros_lane_sign: LaneSign = "auto"


DEFAULTS: Final = MobileyeSettings()


def device_mounting(settings: MobileyeSettings, bus: str, ledger: Ledger) -> DevicePosition:
    """Return the mounting; the default is at the rear axle, with a notice."""
    if settings.mounting is None:
        ledger.notice(
            f"{bus}: the position of the Mobileye's reference point is not set; it is assumed to "
            "be at the rear axle; calibrate x_m and y_m in the vehicle file"
        )
    return settings.mounting or AT_REAR_AXLE
