"""Table of Foxglove's message types, independent of their encoding."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final


class Picture(Enum):
    """Kind of picture message, which determines how the coding is found."""

    COMPRESSED = "compressed"
    VIDEO = "video"
    RAW = "raw"


PICTURES: Final[Mapping[str, Picture]] = {
    "foxglove.CompressedImage": Picture.COMPRESSED,
    "foxglove.CompressedVideo": Picture.VIDEO,
    "foxglove.RawImage": Picture.RAW,
}


@dataclass(frozen=True, slots=True)
class Source:
    """Source field of a standard column.

    Attributes:
        path: Dotted path of the field.
        count: Length of the array; 0 for a number; -1 for a list padded with NaN.
    """

    path: str
    count: int = 0


def _pose(prefix: str) -> dict[str, Source]:
    return {f"{axis}_m": Source(f"{prefix}position.{axis}") for axis in "xyz"} | {
        f"quat_{axis}": Source(f"{prefix}orientation.{axis}") for axis in "xyzw"
    }


TABLES: Final[Mapping[str, Mapping[str, Source]]] = {
    "foxglove.LocationFix": {
        "latitude_deg": Source("latitude"),
        "longitude_deg": Source("longitude"),
        "altitude_m": Source("altitude"),
        "covariance_m2": Source("position_covariance", 9),
        "covariance_type": Source("position_covariance_type"),
    },
    "foxglove.CameraCalibration": {
        "width_px": Source("width"),
        "height_px": Source("height"),
        "k": Source("K", 9),
        "p": Source("P", 12),
        "d": Source("D", -1),
    },
    "foxglove.PoseInFrame": _pose("pose."),
}
