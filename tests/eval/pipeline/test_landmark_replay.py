"""Landmarks correct the pose of a simulated drive, through the command line.

The simulated car drives past textured walls. A survey with other image noise fills the database.
The replay starts with a wrong pose and passes the same walls.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.datasets.truth.tum import read_tum
from crosscue.detectors.images import Encoded
from crosscue.eval import cli
from crosscue.eval.pipeline.landmarks import LandmarkStage, landmark_stage
from crosscue.eval.runs.folder import RunFolder
from crosscue.localization.landmarks.database import LandmarkDatabase
from crosscue.localization.landmarks.images import grey_of
from crosscue.localization.landmarks.update import best_candidate
from crosscue.replay.columns import Block, Bytes, Floats, Images, Messages
from crosscue.replay.ledger import Ledger
from crosscue.replay.vehicle.vehicle import Vehicle
from support.commands import json_of, output_of
from support.data import shared
from support.landmark_files import database_of, encoded, seen_from, wall
from support.manifests import estimate_manifest
from support.refusals import refusal

pytestmark = pytest.mark.slow

WALL_M = 40.0


def view(way_m: float, noise: float, seed: int) -> Bytes:
    """Render the next wall after a distance; a nearer wall appears larger."""
    number, into_m = divmod(way_m, WALL_M)
    scale = 0.6 * (WALL_M + 15.0) / (WALL_M + 15.0 - into_m)
    return seen_from(_wall(int(number) + 100), 0.0, scale, noise, seed)


@lru_cache(maxsize=2)
def _wall(seed: int) -> Bytes:
    return wall(seed, 320, 240)


def frames(folder: Path, drive: DriveFiles, every_ns: int, noise: float, seed: int) -> Path:
    """Write a folder of camera pictures along the true path of a drive."""
    track = read_tum(drive.truth.parent / "pose.tum")
    way_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(track.xyz_m[:, :2], axis=0).T))])
    folder.mkdir()
    times = np.arange(track.t_ns[0] + seed * 1_000_000, track.t_ns[-1], every_ns)
    at_m = np.interp(times - track.t_ns[0], track.t_ns - track.t_ns[0], way_m)
    for i, metres in enumerate(at_m):
        (folder / f"frame_{i:05d}.png").write_bytes(encoded(view(metres, noise, seed + i)))
    (folder / "timestamps.txt").write_text("\n".join(map(str, times)) + "\n")
    return folder


@dataclass(frozen=True, slots=True)
class Town:
    """Data shared by all tests of this module."""

    drive: DriveFiles
    vehicle: Path
    survey: Path
    camera: Path
    database: Path


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Town:
    folder = tmp_path_factory.mktemp("town")
    drive = write_drive(folder / "drive", DriveSettings(seed=3, blocks=3, block_m=100.0))
    survey = frames(folder / "survey", drive, 300_000_000, 2.0, seed=1)
    camera = frames(folder / "camera", drive, 150_000_000, 6.0, seed=50)
    database = folder / "town.sqlite"
    add = ["landmarks", "add", str(database), str(survey), "--poses", str(drive.truth)]
    assert cli.run([*add, "--every", "15", "--sd", "2"]) == 0
    vehicle = drive.vehicle.parent / "off.toml"
    text = drive.vehicle.read_text()
    assert "[start]" in text
    head, _, tail = text.partition("[start]")
    _, bracket, rest = tail.partition("\n[")
    vehicle.write_text(
        f"{head}[start]\nx_m = 6.0\ny_m = -5.0\nposition_sd_m = 6.0\nheading_rad = 0.35\n"
        f"heading_sd_rad = 0.1\n{bracket}{rest}"
    )
    return Town(drive, vehicle, survey, camera, database)


def replay(town: Town, run: Path, *more: str) -> RunFolder:
    command = ["replay", str(town.drive.log), str(town.camera), "--vehicle", str(town.vehicle)]
    assert cli.run([*command, "-o", str(run), *more]) == 0
    return RunFolder(run)


@pytest.fixture(scope="module")
def found(town: Town, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    run = tmp_path_factory.mktemp("found") / "run"
    return replay(town, run, "--landmarks", str(town.database))


@pytest.fixture(scope="module")
def without(town: Town, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    return replay(town, tmp_path_factory.mktemp("without") / "run")


def errors_m(town: Town, run: RunFolder) -> Floats:
    track = read_tum(town.drive.truth.parent / "pose.tum")
    table = run.table("pose")
    t_ns = table["t_ns"].to_numpy()
    offsets_m = [
        table[name].to_numpy() - np.interp(t_ns, track.t_ns, track.xyz_m[:, i])
        for i, name in enumerate(("x_m", "y_m"))
    ]
    return np.asarray(np.hypot(*offsets_m), np.float64)


def test_landmarks_correct_a_drifting_pose(
    town: Town, found: RunFolder, without: RunFolder
) -> None:
    counts = estimate_manifest(found).counts.landmarks
    assert counts["accepted"] >= 10
    assert counts["gated"] <= 2
    late = slice(-500, None)
    assert np.median(errors_m(town, without)[late]) > 4.0
    assert np.median(errors_m(town, found)[late]) < 2.0
    axis = found.table("pose")["major_axis_m"].to_numpy()
    assert axis[-1] < 0.7 * without.table("pose")["major_axis_m"].to_numpy()[-1]


def test_landmarks_list_and_match_report_stored_landmarks(town: Town) -> None:
    listed = json_of("landmarks", "list", town.database)
    first = listed["listed"][0]
    x, y = first["xy_m"]
    assert listed["landmarks"] == len(listed["listed"]) > 10
    assert np.array(first["cov_m2"]) == pytest.approx(4.0 * np.eye(2))

    near = f"--near={x},{y},1"
    assert first["name"] in output_of("landmarks", "list", town.database, near)

    picture = sorted(town.survey.glob("*.png"))[0]
    found = json_of("landmarks", "match", town.database, picture)
    assert found["compared"] == listed["landmarks"]
    assert (found["best"][0]["name"], found["best"][0]["is_match"]) == (first["name"], True)
    assert not found["best"][3]["is_match"]
    assert "1 landmark compared" in output_of("landmarks", "match", town.database, picture, near)


def photos(folder: Path, table: str) -> tuple[Path, Path]:
    folder.mkdir()
    for i in range(2):
        (folder / f"{i}.png").write_bytes(encoded(wall(i)))
    (folder / "bad.png").write_text("no picture")
    (folder / "blank.png").write_bytes(encoded(np.zeros((50, 50), np.uint8)))
    (folder / "at.csv").write_text(table)
    return folder, folder / "at.csv"


@pytest.mark.parametrize(
    ("table", "status", "why"),
    [
        ("image,x_m,y_m\n0.png,1,2\n", 4, "at.csv:1: expected columns image,x_m,y_m,sd_m"),
        ("image,x_m,y_m,sd_m\n0.png,nan,2,1\n", 4, "at.csv:2: x_m: expected a finite number"),
        ("image,x_m,y_m,sd_m\n0.png,1,2,1\n1.png,1,inf,1\n", 4, "at.csv:3: y_m"),
        ("image,x_m,y_m,sd_m\n0.png,1,2,-1\n", 4, "at.csv:2: sd_m: expected > 0, got -1"),
        ("image,x_m,y_m,sd_m\n0.png,1\n", 4, "at.csv:2: y_m: expected a finite number, got None"),
        ("image,x_m,y_m,var_x_m2,cov_xy_m2,var_y_m2\n0.png,1,2,1,2,1\n", 4, "positive definite"),
        ("image,x_m,y_m,sd_m\nbad.png,1,2,1\n", 4, "bad.png: not a JPEG, PNG or WebP picture"),
        ("image,x_m,y_m,sd_m\nmissing.png,1,2,1\n", 4, "missing.png: No such file"),
        ("image,x_m,y_m,sd_m\n0.png,1,2,1\n0.png,1,2,1\n", 2, "'photos/0.png' already exists"),
    ],
)
def test_bad_coordinates_are_refused_and_nothing_is_written(
    tmp_path: Path, table: str, status: int, why: str
) -> None:
    folder, csv = photos(tmp_path / "photos", table)
    add = ["landmarks", "add", str(tmp_path / "lm.sqlite"), "--images", str(folder)]
    assert why in refusal(status, *add, "--coordinates", csv)
    assert not (tmp_path / "lm.sqlite").exists()


def block(payloads: list[bytes], first_ns: int = 0, step_ns: int = 500_000_000) -> Block:
    joined = np.frombuffer(b"".join(payloads), np.uint8)
    stop = np.cumsum([len(p) for p in payloads]).astype(np.int64)
    start = np.concatenate([[0], stop[:-1]]).astype(np.int64)
    t_ns = first_ns + step_ns * np.arange(len(payloads), dtype=np.int64)
    return Block("cam", t_ns, Images(Messages(joined, start, stop), ("png",) * len(payloads)))


def stage_at(path: Path, ledger: Ledger, **section: float) -> LandmarkStage:
    vehicle = Vehicle.model_validate({"version": 1, "landmarks": section})
    return landmark_stage(LandmarkDatabase(path), vehicle, ledger)


def test_thinned_and_late_frames_are_counted(tmp_path: Path) -> None:
    stage = stage_at(database_of(tmp_path / "lm.sqlite", np.zeros((1, 2))), Ledger("cam"))
    stage.see(block([b"x"] * 10, step_ns=50_000_000))
    assert len(stage.times_ns()) == 5
    stage.let_go(200_000_000)
    assert len(stage.times_ns()) == 3
    stage.let_go(1 << 62)

    assert len(stage.times_ns()) == 0
    assert (stage.counts()["frames"], stage.counts()["thinned"]) == (10, 5)
    assert stage.counts()["late"] == 5


def test_real_frames_match_nearest_landmarks_of_kitti_turn(tmp_path: Path) -> None:
    """Every fourth frame of a turn is a landmark; frames between match one within 4.5 m."""
    folder = shared("sequences", "kitti_seq2_right_turn_98deg")
    pose = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    east_north = np.column_stack([pose[:, 2, 3], -pose[:, 0, 3]])
    rows = [f"{i:06d}.png,{x},{y},2" for i, (x, y) in enumerate(east_north)][::4]
    csv = tmp_path / "at.csv"
    csv.write_text("image,x_m,y_m,sd_m\n" + "\n".join(rows) + "\n")
    database = tmp_path / "turn.sqlite"
    add = ["landmarks", "add", str(database), "--images", str(folder / "image_l")]
    assert cli.run([*add, "--coordinates", str(csv)]) == 0

    stage = stage_at(database, Ledger("kitti"))
    offsets_m = []
    for i in range(2, 51, 4):
        picture = (folder / "image_l" / f"{i:06d}.png").read_bytes()
        seen = stage.search.matcher.describe(grey_of(Encoded("png", memoryview(picture))))
        everything = tuple(stage.search.database)
        best = best_candidate(seen, everything, stage.search.database, stage.search.matcher)
        assert best is not None
        assert best.match.score > 50
        offsets_m.append(float(np.hypot(*(best.place.xy_m - east_north[i]))))
    assert max(offsets_m) < 4.5


def test_score_compares_filter_with_batch_smoother(town: Town, found: RunFolder) -> None:
    command = ["score", str(found.path), "--truth", str(town.drive.truth), "--smoother"]
    smoother = json_of(*command)["metrics"]["smoother"]
    assert smoother["poses"] > 20
    assert smoother["smoother_rmse_m"] < smoother["filter_rmse_m"]
    assert abs(smoother["smoother_end_m"] - smoother["filter_end_m"]) < 0.5
    assert json.loads((found.path / "score" / "smoother.json").read_text()) == smoother
    assert "filter against batch smoother" in output_of(*command)
