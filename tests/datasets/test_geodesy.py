"""WGS 84 conversions against known values, and against their inverses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.datasets.geodesy import (
    SEMI_MAJOR_M,
    SEMI_MINOR_M,
    ecef_to_enu_matrix,
    ecef_to_geodetic,
    geodetic_to_ecef,
)

places = st.tuples(
    st.floats(-90.0, 90.0), st.floats(-179.999_999, 180.0), st.floats(-5_000.0, 20_200_000.0)
)


def test_points_on_earth_axes_have_ellipsoid_radii() -> None:
    xyz_m = geodetic_to_ecef([0.0, 0.0, 90.0, -90.0], [0.0, 90.0, 0.0, 0.0], np.zeros(4))

    expected = [
        [SEMI_MAJOR_M, 0.0, 0.0],
        [0.0, SEMI_MAJOR_M, 0.0],
        [0.0, 0.0, SEMI_MINOR_M],
        [0.0, 0.0, -SEMI_MINOR_M],
    ]
    np.testing.assert_allclose(xyz_m, expected, atol=1e-8)
    assert pytest.approx(6_356_752.314_245, abs=1e-6) == SEMI_MINOR_M


def test_geodetic_to_ecef_matches_epsg_guidance_note_7_2() -> None:
    lat_deg = 53 + 48 / 60 + 33.820 / 3600
    lon_deg = 2 + 7 / 60 + 46.380 / 3600

    xyz_m = geodetic_to_ecef(lat_deg, lon_deg, 73.0)

    np.testing.assert_allclose(xyz_m, [[3_771_793.968, 140_253.342, 5_124_304.349]], atol=2e-2)


@settings(max_examples=200)
@given(places)
def test_geodetic_and_ecef_conversions_are_inverse(place: tuple[float, float, float]) -> None:
    xyz_m = geodetic_to_ecef(*place)

    again_m = geodetic_to_ecef(*ecef_to_geodetic(xyz_m))

    np.testing.assert_allclose(again_m, xyz_m, atol=1e-7)


@given(st.floats(-1.57, 1.57), st.floats(-3.14, 3.14))
def test_enu_matrix_is_rotation_with_up_along_ellipsoid_normal(
    lat_rad: float, lon_rad: float
) -> None:
    matrix = ecef_to_enu_matrix(lat_rad, lon_rad)
    lat_deg, lon_deg = np.degrees(lat_rad), np.degrees(lon_rad)
    up_m = geodetic_to_ecef(lat_deg, lon_deg, 100.0) - geodetic_to_ecef(lat_deg, lon_deg, 0.0)

    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    np.testing.assert_allclose(matrix @ up_m[0], [0.0, 0.0, 100.0], atol=1e-7)
