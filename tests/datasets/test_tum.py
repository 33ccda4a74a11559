"""Trajectory files, the mounting of a body by its travel, and the geodesy of positions."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.datasets.geodesy import (
    SEMI_MAJOR_M,
    SEMI_MINOR_M,
    ecef_to_enu_matrix,
    ecef_to_geodetic,
    geodetic_to_ecef,
)
from crosscue.datasets.truth.tum import (
    Trajectory,
    heading_rad,
    nanoseconds,
    planar,
    read_tum,
    seconds_text,
    turned_by,
    write_tum,
)
from crosscue.replay.errors import LogFormatError
from support.trees import written

POSE = "1.5 1 2 3 0 0 0 1"


def random_trajectory(seed: int, n: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(n, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    t_ns = np.cumsum(rng.integers(1, 10**10, n)) + 1_533_000_000_000_000_000
    return Trajectory(t_ns, rng.normal(0.0, 1e5, (n, 3)), quat)


@given(t_ns=st.integers(-(10**18), 9 * 10**18))
@settings(max_examples=200)
def test_nanoseconds_survive_conversion_to_text(t_ns: int) -> None:
    assert nanoseconds(seconds_text(t_ns)) == t_ns


@given(seed=st.integers(0, 10_000), n=st.integers(0, 20))
@settings(max_examples=30)
def test_trajectory_is_read_back_exactly(seed: int, n: int, tmp_path: Path) -> None:
    path = tmp_path / "poses.tum"
    trajectory = random_trajectory(seed, n)
    write_tum(path, trajectory, comment="two\nlines")
    found = read_tum(path)

    np.testing.assert_array_equal(found.t_ns, trajectory.t_ns)
    np.testing.assert_array_equal(found.xyz_m, trajectory.xyz_m)
    np.testing.assert_array_equal(found.quat_wxyz, trajectory.quat_wxyz)


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("1305031102.175304", 1_305_031_102_175_304_000),
        ("1.533323290123456789e+09", 1_533_323_290_123_456_789),
        ("0", 0),
        ("-0.000000001", -1),
        ("0.0000000015", 2),
        ("0.00000000249", 2),
    ],
)
def test_supported_notations_of_time_are_parsed(text: str, t_ns: int) -> None:
    assert nanoseconds(text) == t_ns


def test_comments_blank_lines_commas_and_byte_order_mark_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "a.tum"
    long_comment = "# " + "x" * 10_000
    text = f"\ufeff# head\n\n{long_comment}\n1.5, 1, 2, 3, 0, 0, 0, 1\r\n  2.5 1 2 3 0 0 0 -1"
    path.write_text(text, encoding="utf-8")

    assert read_tum(path).t_ns.tolist() == [1_500_000_000, 2_500_000_000]


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("1.6 1 2 3 0 0 0", "line 3: 7 numbers instead of 8; expected timestamp"),
        ("1.6 1 2 3 0 0 0 1 9", "line 3: 9 numbers"),
        ("now 1 2 3 0 0 0 1", "line 3: 'now' is not a number of seconds"),
        ("nan 1 2 3 0 0 0 1", "line 3: 'nan' is not a time"),
        ("1e30 1 2 3 0 0 0 1", "line 3: '1e30' is not a time"),
        ("1e999999999 1 2 3 0 0 0 1", "line 3: '1e999999999' is not a time"),
        ("1.6 1 two 3 0 0 0 1", "line 3: could not convert"),
        ("1.6 1 inf 3 0 0 0 1", "line 3: a number is not finite"),
        ("1.6 1 2 3 0 0 0 0", "line 3: the quaternion has the length 0"),
        ("1.6 1 2 3 0 0 0 1.5", "line 3: the quaternion has the length 1.5"),
        ("1.5 1 2 3 0 0 0 1", "line 3: time 1.5 is not after"),
        ("1.4 1 2 3 0 0 0 1", "line 3: time 1.4 is not after"),
        ("1.6 1 2 3 0 0 0 1" * 1000, "line 3: "),
    ],
)
def test_invalid_line_is_refused_with_its_number(tmp_path: Path, line: str, match: str) -> None:
    path = written(tmp_path / "bad.tum", f"# head\n{POSE}\n{line}\n3 1 2 3 0 0 0 1\n")

    with pytest.raises(LogFormatError, match=match):
        read_tum(path)


@given(heading=st.floats(-3.14, 3.14))
@settings(max_examples=30)
def test_planar_pose_keeps_heading(heading: float) -> None:
    one = planar(np.array([1]), np.array([2.0]), np.array([3.0]), np.array([heading]))

    assert heading_rad(one)[0] == pytest.approx(heading)
    np.testing.assert_array_equal(one.xyz_m, [[2.0, 3.0, 0.0]])


@pytest.mark.parametrize(
    ("t_ns", "xyz", "quat", "match"),
    [
        ([1, 2], np.zeros((1, 3)), np.eye(4)[[0, 0]], r"xyz_m: expected \(2, 3\), got \(1, 3\)"),
        ([1, 2], np.zeros((2, 3)), np.eye(4)[[0]], r"quat_wxyz: expected \(2, 4\), got \(1, 4\)"),
        ([2, 2], np.zeros((2, 3)), np.eye(4)[[0, 0]], "expected increasing times"),
        ([1, 2], np.full((2, 3), np.nan), np.eye(4)[[0, 0]], "expected finite"),
        ([1, 2], np.zeros((2, 3)), np.ones((2, 4)), "expected unit quaternions"),
    ],
)
def test_invalid_trajectory_columns_are_refused(
    t_ns: list[int], xyz: np.ndarray, quat: np.ndarray, match: str
) -> None:
    with pytest.raises(ValueError, match=match):
        Trajectory(np.array(t_ns), xyz, quat)


def _body(kappa_per_m: NDArray[np.float64], speed_mps: float, ahead_m: float) -> Trajectory:
    """Return the path of a body with a yaw of 0.02 rad, ahead of the rear axle, without slip."""
    heading = np.cumsum(kappa_per_m * speed_mps * 0.1)
    x, y = (np.cumsum(speed_mps * 0.1 * part(heading)) for part in (np.cos, np.sin))
    t_ns = np.arange(len(heading), dtype=np.int64) * 100_000_000
    x, y = x + ahead_m * np.cos(heading), y + ahead_m * np.sin(heading)
    return planar(t_ns, x, y, heading + 0.02)


@pytest.mark.parametrize("ahead_m", [-0.05, 2.1])
def test_mounting_yaw_is_estimated_from_travel(ahead_m: float) -> None:
    weave = 0.02 * np.sin(np.arange(300) * 0.05)

    found = turned_by(_body(weave, 12.0, ahead_m))

    assert found is not None
    assert abs(found.yaw_rad - 0.02) < 3 * found.sd_rad < 0.006


@pytest.mark.parametrize(
    ("kappa_per_m", "speed_mps", "rows"), [(0.0, 1.0, 300), (0.0, 12.0, 25), (0.05, 12.0, 300)]
)
def test_mounting_yaw_is_unknown_for_slow_short_or_curved_drive(
    kappa_per_m: float, speed_mps: float, rows: int
) -> None:
    assert turned_by(_body(np.full(rows, kappa_per_m), speed_mps, 1.5)) is None


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
