"""Updates by landmarks, and their matches."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.ekf import PoseBelief, update_point
from crosscue.localization.landmarks.database import (
    LandmarkDatabase,
    LandmarkPosition,
    LandmarkWriter,
)
from crosscue.localization.landmarks.features import CameraGeometry, make_matcher
from crosscue.localization.landmarks.images import grey_of, read_encoded
from crosscue.localization.landmarks.matcher import OrbMatcher
from crosscue.localization.landmarks.update import LandmarkSettings
from crosscue.localization.odometry import OdometrySettings, integrate
from crosscue.localization.pose_track import (
    Advance,
    TrackSettings,
    TrackState,
    advance_pose,
    start_belief,
)
from crosscue.replay.columns import Floats
from crosscue.replay.errors import UsageError
from support.beliefs import joseph
from support.data import shared
from support.landmark_files import (
    PlaceMeasurements,
    features_at,
    landmarks_along,
    search_in,
    seen_from,
    some_features,
    wall,
)
from support.simulated_drive import TRACK_M, Truth, compass, drive, gyro, nees_of, wheels

ODOMETRY = OdometrySettings(
    track_width_m=TRACK_M, wheel_step_mps=0.01, slip_per_sqrt_m=0.2, gyro_noise_rad_per_sqrt_s=0.02
)
EVERY_READING = TrackSettings(heading_interval_m=0.0, heading_gate_nis=None)
COV = np.array([[4.0, 1.5], [1.5, 3.0]])
SETTINGS = LandmarkSettings(min_score=70.0, interval_m=0.2, gate_nis=None, sigmas=4.0)


def some_belief(seed: int, heading: float = 0.3) -> PoseBelief:
    rng = np.random.default_rng(seed)
    root = rng.normal(0.0, 1.0, (4, 4)) * [[3.0], [3.0], [0.1], [1.0]]
    return PoseBelief(0, np.array([5.0, -2.0, heading, 3.0]), root @ root.T + 1e-3 * np.eye(4))


@given(st.integers(0, 1000), st.floats(-20.0, 20.0), st.floats(-20.0, 20.0))
def test_update_of_the_axle_is_the_joseph_form(seed: int, x: float, y: float) -> None:
    belief, measured = some_belief(seed), np.array([x, y])

    ours = update_point(belief, measured, COV)
    assert (ours.belief.t_ns, ours.is_accepted) == (belief.t_ns, True)
    wanted = joseph(belief, measured, COV, (0.0, 0.0))
    np.testing.assert_allclose(ours.belief.mean, wanted.mean, atol=1e-9)
    np.testing.assert_allclose(ours.belief.cov, wanted.cov, atol=1e-9)
    apart = measured - belief.mean[:2]
    spread = belief.cov[:2, :2] + COV
    assert ours.nis == pytest.approx(apart @ np.linalg.solve(spread, apart))
    np.testing.assert_array_equal(ours.belief.cov, ours.belief.cov.T)
    assert (np.linalg.eigvalsh(belief.cov - ours.belief.cov) > -1e-7).all()


@given(
    seed=st.integers(0, 1000),
    ahead=st.floats(-3.0, 3.0),
    left=st.floats(-2.0, 2.0),
    heading=st.floats(-3.14, 3.14),
)
def test_update_with_a_lever_keeps_covariance_symmetric_and_positive(
    seed: int, ahead: float, left: float, heading: float
) -> None:
    done = update_point(some_belief(seed, heading), np.array([6.0, 1.0]), COV, (ahead, left))

    np.testing.assert_array_equal(done.belief.cov, done.belief.cov.T)
    assert (np.linalg.eigvalsh(done.belief.cov) > -1e-9).all()
    assert -math.pi < done.belief.mean[2] <= math.pi


def test_gate_rejects_outlier_and_keeps_the_belief() -> None:
    belief = some_belief(2)
    far = update_point(belief, np.array([500.0, 0.0]), COV, gate_nis=13.8)

    assert far.is_accepted is False
    assert far.belief is belief
    assert far.nis > 13.8


def run(
    folder: Path, seed: int, lever_m: tuple[float, float] = (0.0, 0.0)
) -> tuple[Advance, Truth, PlaceMeasurements]:
    rng = np.random.default_rng(seed)
    truth = drive(rng, seconds=40.0)
    made = integrate(wheels(truth, ODOMETRY, rng), ODOMETRY, gyro(truth, ODOMETRY, rng))
    headings = compass(truth, 0.2, rng)
    sd = np.array([3.0, 3.0, 0.1, 1.0])
    off = rng.normal(0.0, sd)
    x, y, heading = truth.xyh[0] + off[:3]
    speed = truth.speed_mps[0] + off[3]
    first = start_belief(int(truth.t_ns[0]), x, y, heading, speed, 3.0, 0.1, 1.0)
    path = landmarks_along(folder / f"{seed}.sqlite", truth, rng, 60.0, COV, lever_m)
    with LandmarkDatabase(path) as database:
        options = LandmarkSettings(
            min_score=99.0,
            interval_m=0.2,
            gate_nis=None,
            sigmas=4.0,
            revisit_m=1e6,
            lever_m=lever_m,
        )
        measurements = PlaceMeasurements(search_in(database, options), truth, lever_m=lever_m)
        done = advance_pose(
            TrackState(first), made.increments, EVERY_READING, headings, measurements=measurements
        )
    return done, truth, measurements


SEEDS = 24


@pytest.mark.slow
def test_simulated_nees_and_nis_are_in_their_bands(tmp_path: Path) -> None:
    """NEES of the last pose and NIS of all landmarks, seeds 0 to 23."""
    runs = [run(tmp_path, seed) for seed in range(SEEDS)]

    low, high = mean_band(3, SEEDS)
    assert low < np.mean([nees_of(done.poses, truth, -1) for done, truth, _ in runs]) < high
    nis = np.array([s.nis for _, _, measurements in runs for s in measurements.search.sightings])
    low, high = mean_band(2, len(nis))
    assert len(nis) > 3 * SEEDS
    assert low < nis.mean() < high


@pytest.mark.slow
def test_nis_with_a_camera_lever_is_in_its_band(tmp_path: Path) -> None:
    """Heading errors rotate the camera's position, and its covariance includes this."""
    runs = [run(tmp_path, seed, (5.0, 1.0)) for seed in range(SEEDS)]

    nis = np.array([s.nis for _, _, measurements in runs for s in measurements.search.sightings])
    assert mean_band(2, len(nis))[0] < nis.mean() < mean_band(2, len(nis))[1]


def straight(length_m: float = 400.0, speed_mps: float = 10.0) -> Truth:
    n = round(length_m / speed_mps * 20.0) + 1
    t_s = np.arange(n) / 20.0
    xyh = np.column_stack([speed_mps * t_s, np.zeros(n), np.zeros(n)])
    return Truth(np.round(t_s * 1e9).astype(np.int64), xyh, np.full(n, speed_mps), np.zeros(n))


def follow(
    path: Path, truth: Truth, marks: dict[str, Floats], options: LandmarkSettings, **start: float
) -> tuple[Advance, PlaceMeasurements]:
    """Simulate a drive without noise past landmarks at their true positions."""
    if not path.exists():
        with LandmarkWriter(path, "nearness") as writer:
            for name, xy in marks.items():
                writer.add(LandmarkPosition(name, xy, np.eye(2)), features_at(xy))
    exact = OdometrySettings(track_width_m=TRACK_M)
    made = integrate(wheels(truth, exact), exact, gyro(truth, exact)).increments
    first = start_belief(
        int(truth.t_ns[0]),
        start.get("x_m", 0.0),
        0.0,
        truth.xyh[0, 2],
        truth.speed_mps[0],
        start.get("sd_m", 10.0),
        0.05,
        0.1,
    )
    with LandmarkDatabase(path) as database:
        measurements = PlaceMeasurements(search_in(database, options), truth)
        return advance_pose(
            TrackState(first), made, TrackSettings(), measurements=measurements
        ), measurements


def test_landmark_is_applied_once_at_its_peak_score(tmp_path: Path) -> None:
    """Odometry starts with an error of 8 m; the measurement is the peak position, moved ahead."""
    done, measurements = follow(
        tmp_path / "lm.sqlite", straight(), {"gate": np.array([100.0, 0.0])}, SETTINGS, x_m=8.0
    )

    (sighting,) = measurements.search.sightings
    true_x = 10.0 * sighting.t_ns * 1e-9
    assert sighting.xy_m[0] == pytest.approx(true_x, abs=0.3)
    assert sighting.score == pytest.approx(100.0, abs=0.3)
    row = int(np.searchsorted(done.poses.t_ns, sighting.t_ns))
    assert abs(done.poses.x_m[row - 1] - true_x) > 7.0
    assert abs(done.poses.x_m[row] - true_x) < 0.5
    assert measurements.search.counts.matched > 10


def test_only_landmarks_inside_the_ellipse_are_matched(tmp_path: Path) -> None:
    """An identical landmark at a distance of 100 m is not matched."""
    place = np.array([100.0, 0.0])
    path = tmp_path / "twins.sqlite"
    with LandmarkWriter(path, "nearness") as writer:
        writer.add(LandmarkPosition("right", place, np.eye(2)), features_at(place))
        writer.add(
            LandmarkPosition("twin", place + np.array([0.0, 100.0]), np.eye(2)),
            features_at(place + np.array([0.0, 0.01])),
        )

    narrow = LandmarkSettings(min_score=70.0, interval_m=0.2)
    _, measurements = follow(path, straight(), {}, narrow, sd_m=5.0)
    assert [s.name for s in measurements.search.sightings] == ["right"]
    assert measurements.search.counts.candidates < 100
    _, wide = follow(path, straight(), {}, narrow, sd_m=200.0)
    assert wide.search.counts.candidates > 4 * measurements.search.counts.candidates


def test_landmark_relocates_a_lost_car(tmp_path: Path) -> None:
    """The start is wrong by 30 m and its major axis is above 100 m, the limit of a lost car."""
    done, measurements = follow(
        tmp_path / "lm.sqlite",
        straight(),
        {"gate": np.array([100.0, 0.0])},
        SETTINGS,
        x_m=30.0,
        sd_m=40.0,
    )

    assert done.poses.major_axis_m[0] > 100.0
    assert len(measurements.search.sightings) == 1
    assert done.poses.major_axis_m[-1] < 100.0
    assert abs(done.poses.x_m[-1] - 400.0) < 3.0


CAMERA = CameraGeometry(500.0)
ORB = OrbMatcher()


def test_wall_matches_itself_and_no_other_wall() -> None:
    matcher = make_matcher("orb", CAMERA)
    here = matcher.describe(wall(1))
    again = matcher.describe(seen_from(wall(1), turn_deg=8.0, scale=1.15, noise=4.0, seed=3))
    others = [matcher.describe(wall(seed)) for seed in (2, 3, 4)]

    same = matcher.match(again, here)
    assert same.score > 60
    assert same.agreeing <= same.pairs
    assert all(matcher.match(other, here).score < 20 for other in others)


def test_matching_is_deterministic() -> None:
    first, second = make_matcher("orb", CAMERA), make_matcher("orb", CAMERA)
    near, far = seen_from(wall(1), 20.0, 0.7, 8.0, 3), wall(1)

    matches = [m.match(m.describe(near), m.describe(far)) for m in (first, second, first)]
    assert matches[0] == matches[1] == matches[2]


@given(st.integers(0, 1000), st.integers(0, 60), st.integers(0, 60))
@settings(max_examples=30)
def test_random_features_of_any_count_can_be_matched(seed: int, one: int, other: int) -> None:
    match = ORB.match(some_features(seed, one), some_features(seed + 1, other))

    assert 0 <= match.agreeing <= match.pairs <= min(one, other)


def test_custom_matcher_is_named_by_module_and_factory() -> None:
    made = make_matcher("crosscue.localization.landmarks.matcher:orb", CAMERA)

    assert made.kind == "orb"
    with pytest.raises(UsageError, match="expected orb, or module:factory"):
        make_matcher("sift")
    with pytest.raises(UsageError, match="No module named 'no_such_module'"):
        make_matcher("no_such_module:factory")
    with pytest.raises(UsageError, match="no attribute 'nothing'"):
        make_matcher("crosscue.localization.landmarks.matcher:nothing")
    with pytest.raises(UsageError, match="a factory accepts a CameraGeometry"):
        make_matcher("os:getcwd")
    with pytest.raises(UsageError, match="has no kind"):
        make_matcher("builtins:repr")


def test_real_street_pictures_match_only_their_neighbours() -> None:
    """KITTI, frames at intervals of about 1 m, in a turn of 98 degrees."""
    folder = shared("sequences", "kitti_seq2_right_turn_98deg", "image_l")
    seen = [ORB.describe(grey_of(read_encoded(folder / f"{i:06d}.png"))) for i in (0, 3, 47, 50)]

    assert ORB.match(seen[0], seen[1]).score > 100
    assert ORB.match(seen[2], seen[3]).score > 100
    assert max(ORB.match(seen[i], seen[j]).score for i in (0, 1) for j in (2, 3)) < 12


@pytest.mark.parametrize("size", [(31, 31), (1, 1), (3000, 40), (40, 3000)])
def test_features_of_any_picture_size_are_in_its_pixels(size: tuple[int, int]) -> None:
    width, height = size
    features = ORB.describe(wall(5, width, height))

    assert (features.width_px, features.height_px) == size
    if len(features):
        assert (features.points_px <= [width, height]).all()
        assert features.points_px.max() > 0.5 * max(size)
