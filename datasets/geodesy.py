"""Convert between WGS 84 coordinates: geodetic, earth-fixed (ECEF), and local east, north, up.

ECEF to geodetic is Bowring's iteration on the parametric latitude (B. R. Bowring, "Transformation
from spatial to geographical coordinates", Survey Review 23, 1976); the constants are WGS 84's (NGA,
STND.0036).
"""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from crosscue.replay.columns import Floats

SEMI_MAJOR_M: Final = 6_378_137.0
FLATTENING: Final = 1.0 / 298.257_223_563
SEMI_MINOR_M: Final = SEMI_MAJOR_M * (1.0 - FLATTENING)
FIRST_ECCENTRICITY_2: Final = FLATTENING * (2.0 - FLATTENING)
SECOND_ECCENTRICITY_2: Final = FIRST_ECCENTRICITY_2 / (1.0 - FIRST_ECCENTRICITY_2)

# Number of iterations. One is exact to a micrometre near the ground, three up to a satellite's
# orbit.
_BOWRING_STEPS: Final = 3


def geodetic_to_ecef(lat_deg: ArrayLike, lon_deg: ArrayLike, alt_m: ArrayLike) -> Floats:
    """Convert geodetic coordinates to earth-fixed positions.

    Args:
        lat_deg: Geodetic latitude, scalar or shape (N,), degrees north.
        lon_deg: Longitude, the same shape, degrees east.
        alt_m: Height above the ellipsoid, the same shape.

    Returns:
        Shape (N, 3), metres; N is 1 for scalars.
    """
    lat, lon, alt = (
        np.atleast_1d(np.asarray(v, dtype=np.float64)) for v in (lat_deg, lon_deg, alt_m)
    )
    lat, lon = np.radians(lat), np.radians(lon)
    normal_m = SEMI_MAJOR_M / np.sqrt(1.0 - FIRST_ECCENTRICITY_2 * np.sin(lat) ** 2)
    across_m = (normal_m + alt) * np.cos(lat)
    return np.stack(
        np.broadcast_arrays(
            across_m * np.cos(lon),
            across_m * np.sin(lon),
            (normal_m * (1.0 - FIRST_ECCENTRICITY_2) + alt) * np.sin(lat),
        ),
        axis=-1,
    )


def ecef_to_geodetic(xyz_m: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Convert earth-fixed positions to latitude and longitude in degrees and height in metres.

    Args:
        xyz_m: Shape (N, 3) or (3,), metres.

    Returns:
        Three arrays of shape (N,). At the poles longitude is 0.

    Raises:
        ValueError: ``xyz_m`` has another shape.
    """
    xyz = np.atleast_2d(np.asarray(xyz_m, dtype=np.float64))
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f"xyz_m: expected (N, 3), got {np.shape(xyz_m)}")
    x, y, z = xyz.T
    across_m = np.hypot(x, y)
    # Sine and cosine are used because the tangent is infinite at the poles.
    sin_b, cos_b = _unit(z * SEMI_MAJOR_M, across_m * SEMI_MINOR_M)
    for _ in range(_BOWRING_STEPS):
        sin_lat, cos_lat = _unit(
            z + SECOND_ECCENTRICITY_2 * SEMI_MINOR_M * sin_b**3,
            across_m - FIRST_ECCENTRICITY_2 * SEMI_MAJOR_M * cos_b**3,
        )
        sin_b, cos_b = _unit(SEMI_MINOR_M * sin_lat, SEMI_MAJOR_M * cos_lat)
    alt_m = (
        across_m * cos_lat
        + z * sin_lat
        - SEMI_MAJOR_M * np.sqrt(1.0 - FIRST_ECCENTRICITY_2 * sin_lat**2)
    )
    return np.degrees(np.arctan2(sin_lat, cos_lat)), np.degrees(np.arctan2(y, x)), alt_m


def ecef_to_enu_matrix(lat_rad: float, lon_rad: float) -> Floats:
    """Return the rotation ``enu_R_ecef`` at a place: ``enu_m = matrix @ (xyz_m - origin_m)``.

    Args:
        lat_rad: Geodetic latitude of the origin.
        lon_rad: Longitude of the origin.

    Returns:
        Shape (3, 3); rows are east, north and up in earth-fixed axes.
    """
    sin_lat, cos_lat = np.sin(lat_rad), np.cos(lat_rad)
    sin_lon, cos_lon = np.sin(lon_rad), np.cos(lon_rad)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def geodetic_to_enu(
    lat_deg: ArrayLike, lon_deg: ArrayLike, alt_m: ArrayLike, origin: tuple[float, float, float]
) -> Floats:
    """Convert geodetic coordinates near ``origin`` to local east, north, up.

    Args:
        lat_deg: Shape (N,), degrees.
        lon_deg: Shape (N,), degrees.
        alt_m: Shape (N,), metres.
        origin: Latitude and longitude in degrees and height in metres of the frame's origin.

    Returns:
        Shape (N, 3), metres.
    """
    enu_from_ecef = ecef_to_enu_matrix(np.radians(origin[0]), np.radians(origin[1]))
    away_m = geodetic_to_ecef(lat_deg, lon_deg, alt_m) - geodetic_to_ecef(*origin)
    rotated: Floats = away_m @ enu_from_ecef.T
    return rotated


def _unit(opposite: Floats, adjacent: Floats) -> tuple[Floats, Floats]:
    length = np.hypot(opposite, adjacent)
    return opposite / length, adjacent / length
