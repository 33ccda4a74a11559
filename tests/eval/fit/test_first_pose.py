"""The first pose of a drive, and truth from GNSS and from a map."""

import math
from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.datasets.geodesy import (
    ecef_to_enu_matrix,
    ecef_to_geodetic,
    geodetic_to_ecef,
    geodetic_to_enu,
)
from crosscue.datasets.truth.truth import read_truth
from crosscue.datasets.truth.tum import heading_rad, read_tum
from crosscue.eval.fit.first_pose import with_start, with_start_of
from crosscue.eval.fit.gnss_truth import gnss_truth, save_with_track
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.eval.scoring.pose.smoother import score_smoother
from crosscue.replay.base import EVERYTHING
from crosscue.replay.columns import Block, Floats, Table, Topic
from crosscue.replay.errors import EmptyResultError, VehicleError
from crosscue.replay.vehicle.pose import Gnss, GnssUse, Odometry, Start
from crosscue.replay.vehicle.vehicle import Vehicle
from support.commands import output_of
from support.gap_drive import Clock, replayed, write_drive
from support.kitti_drive import raw_drive, true_path
from support.memory_log import GYRO, WHEELS, MemoryLog, driven_blocks
from support.street_map import write_crossing, write_lanelets, write_map

HEADING_RAD = 2.1
PLACE = (48.137, 11.575, 520.0)
SPEED_MPS = 8.0
GNSS = Topic("/gnss", "sensor_msgs/msg/NavSatFix", "columns")


def gnss_positions(t_s: Floats, speed_mps: float) -> Table:
    """Positions of a straight drive, as a receiver reports them."""
    east, north = np.cos(HEADING_RAD) * t_s * speed_mps, np.sin(HEADING_RAD) * t_s * speed_mps
    turn = ecef_to_enu_matrix(math.radians(PLACE[0]), math.radians(PLACE[1]))
    xyz = geodetic_to_ecef(*PLACE) + np.column_stack([east, north, 0.0 * east]) @ turn
    lat, lon, alt = ecef_to_geodetic(xyz)
    return Table(
        {
            "latitude_deg": lat,
            "longitude_deg": lon,
            "altitude_m": alt,
            "position_sd_m": np.full(len(lat), 0.5),
        }
    )


def straight_drive(speed_mps: float = SPEED_MPS, seconds: int = 30) -> MemoryLog:
    t_ns = np.arange(seconds, dtype=np.int64) * 10**9
    fixes = [Block("/gnss", at, gnss_positions(at * 1e-9, speed_mps)) for at in t_ns[:, None]]
    rest = driven_blocks(seconds, speed_mps)
    blocks = [one for i, fix in enumerate(fixes) for one in (*rest[2 * i : 2 * i + 2], fix)]
    return MemoryLog((WHEELS, GYRO, GNSS), blocks, path=Path(__file__))


def replayed_with(folder: Path, vehicle: Vehicle) -> RunFolder:
    return replay_drive(Drive([straight_drive()], vehicle), create(folder, overwrite=False)).run


def test_estimate_keeps_the_first_pose_of_a_run_unless_the_vehicle_file_has_one() -> None:
    own, bare = Vehicle(version=1, start=Start(heading_rad=0.3)), Vehicle(version=1)
    run = with_start([straight_drive()], bare, EVERYTHING)

    assert with_start_of(run, bare).start == run.start
    assert with_start_of(run, own) == own
    assert with_start_of(own, bare) == bare


def truth_file(folder: Path, vehicle: Vehicle = Vehicle(version=1)) -> Path:  # noqa: B008
    return save_with_track(*gnss_truth([straight_drive()], vehicle, EVERYTHING), folder)


def test_gnss_truth_records_accuracy_antenna_and_origin(tmp_path: Path) -> None:
    vehicle = Vehicle(version=1, gnss=Gnss(x_m=1.2, y_m=-0.3))
    path = truth_file(tmp_path, vehicle)
    truth = read_truth(path)
    track = read_tum(tmp_path / str(truth.pose))

    assert truth.position_sd_m == pytest.approx(0.5)
    assert truth.pose_point == "antenna"
    assert truth.mounting is not None
    assert (truth.mounting.x_m, truth.mounting.y_m) == (1.2, -0.3)
    assert truth.origin is not None
    assert truth.origin.latitude_deg == pytest.approx(PLACE[0])
    np.testing.assert_allclose(heading_rad(track), HEADING_RAD, atol=1e-4)


def test_truth_file_determines_first_pose_in_its_map(tmp_path: Path) -> None:
    path = truth_file(tmp_path)
    start = with_start([straight_drive()], Vehicle(version=1), EVERYTHING, start=str(path)).start

    assert start.heading_rad == pytest.approx(HEADING_RAD, abs=1e-4)
    assert [start.x_m, start.y_m] == pytest.approx([0.0, 0.0], abs=0.01)
    assert start.map_origin is None


def test_three_numbers_specify_the_first_pose() -> None:
    start = with_start([straight_drive()], Vehicle(version=1), EVERYTHING, start="3,-4.5,90").start

    assert (start.x_m, start.y_m) == (3.0, -4.5)
    assert start.heading_rad == pytest.approx(math.pi / 2)


def test_truth_without_observable_heading_is_refused(tmp_path: Path) -> None:
    path = truth_file(tmp_path)

    with pytest.raises(VehicleError, match="does not show the first pose"):
        with_start([straight_drive(0.0)], Vehicle(version=1), EVERYTHING, start=str(path))


# Scale error of the wheels, five per cent: 12 m over the drive.
LONG_WHEELS = Vehicle(version=1, odometry=Odometry(wheel_scale=1.05, slip_per_sqrt_m=1.0))


def test_fused_gnss_positions_bound_the_drift_of_odometry(tmp_path: Path) -> None:
    errors_m: dict[str, float] = {}
    at_end = gnss_positions(np.array([29.9]), SPEED_MPS).columns
    uses: tuple[GnssUse, ...] = ("start", "fuse")
    for use in uses:
        vehicle = with_start([straight_drive()], LONG_WHEELS, EVERYTHING, gnss=use)
        run = replayed_with(tmp_path / use, vehicle)
        table = run.table("pose")
        origin = vehicle.start.map_origin
        assert origin is not None
        x_m, y_m, _ = geodetic_to_enu(
            at_end["latitude_deg"], at_end["longitude_deg"], at_end["altitude_m"], origin
        )[0]
        errors_m[use] = math.hypot(table["x_m"][-1].as_py() - x_m, table["y_m"][-1].as_py() - y_m)

    assert errors_m["start"] > 5.0
    assert errors_m["fuse"] < 1.0


def test_smoother_uses_gnss_positions_of_the_filter(tmp_path: Path) -> None:
    vehicle = with_start([straight_drive()], LONG_WHEELS, EVERYTHING, gnss="fuse")
    run = replayed_with(tmp_path / "run", vehicle)
    truth = truth_file(tmp_path / "truth")

    assert score_smoother(run, truth, {}).smoother_rmse_m < 1.0


def test_approach_of_a_map_is_a_scored_approach_with_ranges(tmp_path: Path) -> None:
    streets = write_crossing(tmp_path / "streets.osm")

    written = crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), streets, tmp_path / "truth")

    truth = read_truth(written.path)
    (one,) = truth.approaches
    assert one.features.model_dump() == {"left": True, "right": False, "straight": True}
    assert (one.control, one.conditions) == ("none", ("control_not_stated",))
    assert one.length_m == pytest.approx(6.5)
    assert truth.ranges == "ranges.csv"
    head, *rows = (tmp_path / "truth" / truth.ranges).read_text().splitlines()
    assert head == "t_ns,approach,start_m,end_m"
    first = [float(value) for value in rows[0].split(",")]
    last = [float(value) for value in rows[-1].split(",")]
    # The crossing is 60 m east of the first position, and its road is two lanes wide.
    assert first[2] == pytest.approx(60.0 - 3.25, abs=0.5)
    east_m = true_path(len(rows))[0][:, 0]
    assert first[2] - last[2] == pytest.approx(east_m[-1], abs=0.1)
    assert "control not stated for 1 of 1" in truth.source


def test_a_sign_that_the_car_has_passed_still_controls_the_approach(tmp_path: Path) -> None:
    points = {"a": (-80.0, 0.0), "s": (20.0, 0.0), "b": (45.0, 0.0), "c": (160.0, 0.0)}
    roads = [("asbc", ""), ("bd", "")]
    signs = {"s": "highway=stop direction=forward"}
    streets = write_map(tmp_path / "a.osm", points | {"d": (45.0, 70.0)}, roads, signs)

    written = crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), streets, tmp_path / "truth")

    (one,) = read_truth(written.path).approaches
    assert (one.control, one.conditions) == ("stop_sign", ())


def test_approaches_of_a_lanelet2_map_are_read_as_those_of_an_extract(tmp_path: Path) -> None:
    lanes = {
        name: ([(x0, 4.0), (x1, 4.0)], [(x0, -4.0), (x1, -4.0)], "one_way=no")
        for name, x0, x1 in (("w", -80.0, 56.0), ("w-e", 56.0, 64.0), ("e", 64.0, 160.0))
    }
    lanes["n"] = ([(56.0, 6.0), (56.0, 70.0)], [(64.0, 6.0), (64.0, 70.0)], "one_way=no")
    turn = [(56.0, 4.0), (56.0, 5.0), (56.0, 6.0)], [(56.0, -4.0), (63.0, -2.0), (64.0, 6.0)]
    lanes["w-n"] = (*turn, "one_way=no")
    path = write_lanelets(tmp_path / "a.osm", lanes, {"light": ("traffic_light", "w")})

    written = crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), path, tmp_path / "truth")

    (one,) = read_truth(written.path).approaches
    assert one.features.model_dump() == {"left": True, "right": False, "straight": True}
    assert one.control == "traffic_light"
    assert one.length_m == pytest.approx(8.0, abs=0.2)
    row = (tmp_path / "truth" / "ranges.csv").read_text().splitlines()[1].split(",")
    assert float(row[2]) == pytest.approx(56.0, abs=0.5)


def test_map_of_another_place_is_refused(tmp_path: Path) -> None:
    points = {"a": (0.0, 0.0), "b": (100.0, 0.0)}
    streets = write_map(tmp_path / "far.osm", points, [("ab", "")], origin=(50.0, 8.4))

    with pytest.raises(EmptyResultError, match=r"no intersection of the map .* on the roads"):
        crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), streets, tmp_path / "truth")

    assert not (tmp_path / "truth").exists()


@pytest.mark.slow
@pytest.mark.parametrize("by_s", [-7.0, -3600.0])
def test_truth_of_log_with_clock_set_back_is_accepted(tmp_path: Path, by_s: float) -> None:
    log, truth = write_drive(tmp_path, Clock(set_at_s=6.0, by_s=by_s)), tmp_path / "truth.json"

    # The approach and its stop sign end at 11.6 s, the log's own clock at 6 or 7.
    assert "outside    2 of them reach beyond the log" in output_of("check", truth, log)
    output_of("score", replayed(tmp_path, log).path, "--truth", truth)
