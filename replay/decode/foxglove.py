"""Table of Foxglove's message types, independent of their encoding."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

MAX_SECONDS: Final = 9_000_000_000


def stamp_ns(seconds: int, rest: int) -> int:
    """Return a timestamp in nanoseconds; ``ValueError`` if it is not a time."""
    if abs(seconds) > MAX_SECONDS or not 0 <= rest < 1_000_000_000:
        raise ValueError(f"timestamp {seconds} s + {rest} ns is not a time")
    return seconds * 1_000_000_000 + rest


class PictureKind(Enum):
    """Kind of picture message, which determines how the coding is found."""

    COMPRESSED = "compressed"
    VIDEO = "video"
    RAW = "raw"


PICTURES: Final[Mapping[str, PictureKind]] = {
    "foxglove.CompressedImage": PictureKind.COMPRESSED,
    "foxglove.CompressedVideo": PictureKind.VIDEO,
    "foxglove.RawImage": PictureKind.RAW,
}


@dataclass(frozen=True, slots=True)
class SourceField:
    """Source field of a standard column.

    Attributes:
        path: Dotted path of the field.
        count: Length of the array; 0 for a number; -1 for a list padded with NaN.
    """

    path: str
    count: int = 0


def _pose(prefix: str) -> dict[str, SourceField]:
    return {f"{axis}_m": SourceField(f"{prefix}position.{axis}") for axis in "xyz"} | {
        f"quat_{axis}": SourceField(f"{prefix}orientation.{axis}") for axis in "xyzw"
    }


TABLES: Final[Mapping[str, Mapping[str, SourceField]]] = {
    "foxglove.LocationFix": {
        "latitude_deg": SourceField("latitude"),
        "longitude_deg": SourceField("longitude"),
        "altitude_m": SourceField("altitude"),
        "covariance_m2": SourceField("position_covariance", 9),
        "covariance_type": SourceField("position_covariance_type"),
    },
    "foxglove.CameraCalibration": {
        "width_px": SourceField("width"),
        "height_px": SourceField("height"),
        "k": SourceField("K", 9),
        "p": SourceField("P", 12),
        "d": SourceField("D", -1),
    },
    "foxglove.PoseInFrame": _pose("pose."),
}
