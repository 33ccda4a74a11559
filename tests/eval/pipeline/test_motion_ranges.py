"""Ranges of a run: from motion, from fitted curves, and on a recorded drive."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crosscue.datasets.truth.truth import Truth, save
from crosscue.detectors.base import Detections
from crosscue.detectors.ranging.control_tracks import ControlTracks
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.detectors.ranging.usable import CUT
from crosscue.eval.cli import run
from crosscue.eval.fit.ranges.fit import pairs_of_run, pairs_of_truth
from crosscue.eval.pipeline.scene.motion_ranges import UNCONFIRMED, MotionRanges
from crosscue.eval.pipeline.scene.sign_ranges import SignRanges
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.fusion.evidence import RangePosterior
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import Ranges, Vehicle, parse
from support.commands import json_of, output_of
from support.data import fetch_networks, shared

SIZE = (1920, 1080)
AHEAD = CarStep(1.0, 0.0, 0.0, 0.1)
CAMERA = "[camera]\nfocal_px = 1500.0\nx_m = 1.5\n"
SETBACK_M = Ranges().light_setback_m
# Label, range from the camera at the start, metres to the right, height.
Thing = tuple[str, float, float, float]
NEAR: Thing = ("traffic light", 57.0, -5.0, 1.3)
FAR: Thing = ("traffic light", 84.0, 2.0, 1.3)


def vehicle(text: str = CAMERA) -> Vehicle:
    return parse('version = 1\ncues.kind = "frames"\n' + text, "v.toml")


class Drive:
    """Tracks and ranges of one drive."""

    def __init__(self, car: Vehicle) -> None:
        self.tracks = ControlTracks(car)
        self.ranges = MotionRanges(car)

    def __call__(
        self, seen: Detections, motion: CarStep = AHEAD, without: frozenset[str] = frozenset()
    ) -> tuple[RangePosterior, ...]:
        """Process the next frame."""
        self.tracks([seen], motion)
        return self.ranges(self.tracks.tracks, motion, without)


def found(things: Sequence[Thing], gone_m: float, lenses: Sequence[str] = ()) -> Detections:
    boxes = []
    for _, start_m, right_m, height_m in things:
        scale = 1500.0 / (start_m - gone_m)
        x, y, half = 960.0 + right_m * scale, 540.0 - 3.0 * scale, 0.5 * height_m * scale
        boxes.append([x - 0.4 * half, y - half, x + 0.4 * half, y + half])
    labels = tuple(one[0] for one in things)
    return Detections(
        0,
        SIZE,
        np.array(boxes).reshape(-1, 4),
        np.full(len(boxes), 0.95),
        labels,
        (b"",) * len(boxes),
        tuple(lenses),
    )


def drive(
    one: Drive, things: Sequence[Thing], until_m: int, lenses: Sequence[str] = ()
) -> list[tuple[RangePosterior, ...]]:
    return [one(found(things, float(gone_m), lenses=lenses)) for gone_m in range(until_m)]


def test_far_lights_mark_end_and_groups_are_not_averaged() -> None:
    beside: Thing = ("traffic light", 57.0, -9.0, 1.3)
    rows = drive(Drive(vehicle()), [NEAR, beside, FAR], 45, ("red", "red", "red"))

    last, near = rows[-1]
    assert last.reference is Reference.END
    assert last.range_m == pytest.approx(84.0 - 44.0 + 1.5 - SETBACK_M, rel=0.04)
    assert last.measured_m == pytest.approx(last.range_m, rel=0.02)
    assert near.reference is Reference.START
    assert near.range_m == pytest.approx(57.0 - 44.0 + 1.5, rel=0.04)
    assert rows[0] == ()


@pytest.mark.parametrize("lens", ["unknown", "yellow", ""])
def test_light_of_unknown_facing_marks_nothing(lens: str) -> None:
    rows = drive(Drive(vehicle()), [NEAR, FAR], 45, (lens, lens))

    assert not any(rows)


def test_assumed_size_of_one_light_is_no_range_until_growth_confirms_it() -> None:
    standing = CarStep(0.0, 0.0, 0.0, 0.1)
    one = Drive(vehicle())

    still = [one(found([FAR], 0.0, lenses=["red"]), standing) for _ in range(40)]
    moving = drive(one, [FAR], 40, ("red",))

    assert not any(still)
    assert one.ranges.counts[UNCONFIRMED] >= 35
    assert moving[-1][0].range_m == pytest.approx(84.0 - 39.0 + 1.5 - SETBACK_M, rel=0.05)


def test_two_lights_in_one_place_confirm_each_other_and_a_third_widens_the_interval() -> None:
    standing = CarStep(0.0, 0.0, 0.0, 0.1)
    beside: Thing = ("traffic light", 84.0, 6.0, 1.3)
    off: Thing = ("traffic light", 78.0, -6.0, 1.3)

    def last(things: Sequence[Thing], motion: CarStep, until_m: int) -> RangePosterior:
        one, lenses = Drive(vehicle()), ["red"] * len(things)
        for gone_m in range(40):
            row = one(found(things, float(min(gone_m, until_m)), lenses=lenses), motion)
        return row[0]

    still = last([FAR, beside], standing, 0)
    two, three = (last(things, AHEAD, 39) for things in ([FAR, beside], [FAR, beside, off]))

    assert abs(still.range_m - (84.0 + 1.5 - SETBACK_M)) < 1.96 * np.sqrt(still.var_m2)
    assert np.sqrt(still.var_m2) > 0.15 * still.range_m
    assert three.range_m == pytest.approx(two.range_m, rel=0.03)
    assert three.var_m2 >= (0.45 * 6.0) ** 2
    assert two.var_m2 < three.var_m2


def test_nearest_stop_sign_marks_start() -> None:
    near: Thing = ("stop sign", 40.0, 4.0, 0.75)
    far: Thing = ("stop sign", 65.0, -4.0, 0.75)

    (last,) = drive(Drive(vehicle()), [far, near], 30)[-1]

    assert last.reference is Reference.START
    assert last.range_m == pytest.approx(40.0 - 29.0 + 1.5, rel=0.04)


def test_boxes_cut_by_image_edge_yield_no_range_and_are_counted() -> None:
    aside: Thing = ("traffic light", 20.0, -12.75, 1.3)
    car = vehicle()
    seen = found([aside], 0.0)
    counted = SignRanges(car)
    counted([seen])

    assert drive(Drive(car), [aside], 3)[0] == ()
    assert counted.by_cue["traffic_light"].skipped == {CUT: 1}


HEIGHTS = {"stop_sign": 750.0, "traffic_light": 1000.0}


def annotated_drive(folder: Path, noise_m: float = 0.0) -> Path:
    """Write the truth of an approach with a stop sign at the start and a light at the end."""
    folder.mkdir()
    rng = np.random.default_rng(2)
    images, objects, ranges = [], [], ["t_ns,approach,start_m,end_m"]
    for k in range(60):
        t_ns, start = 1_700_000_000_000_000_000 + k * 100_000_000, 70.0 - k
        ranges.append(f"{t_ns},0,{start},{start + 15.0}")
        images.append({"id": k, "t_ns": t_ns})
        for number, (cue, size) in enumerate(HEIGHTS.items()):
            true_m = start if cue == "stop_sign" else start + 15.0
            height = size / (true_m + rng.normal(0.0, noise_m))
            objects.append(
                {"image_id": k, "category_id": number, "visible": 1.0, "bbox": [5, 5, 9, height]}
            )
            objects.append(
                {"image_id": k, "category_id": number, "visible": 0.5, "bbox": [5, 5, 9, 3.0]}
            )
    names = [cue.replace("_", " ") for cue in HEIGHTS]
    tree = {
        "images": images,
        "annotations": objects,
        "categories": [{"id": i, "name": name} for i, name in enumerate(names)],
    }
    (folder / "objects.json").write_text(json.dumps(tree))
    (folder / "ranges.csv").write_text("\n".join(ranges))
    save(
        Truth(
            version=1,
            start_ns=1_700_000_000_000_000_000,
            end_ns=1_700_000_007_000_000_000,
            objects="objects.json",
            ranges="ranges.csv",
        ),
        folder,
    )
    return folder


@pytest.mark.parametrize("cue", HEIGHTS)
def test_signs_pair_with_start_and_lights_with_end(cue: str, tmp_path: Path) -> None:
    pairs = pairs_of_truth(annotated_drive(tmp_path / "a"), cue)

    assert len(pairs.range_m) == 60
    np.testing.assert_allclose(pairs.height_px * pairs.range_m, HEIGHTS[cue])


def test_fitted_curve_is_evaluated_on_other_drives(tmp_path: Path) -> None:
    fitted, other = annotated_drive(tmp_path / "a"), annotated_drive(tmp_path / "b", noise_m=1.0)
    page = tmp_path / "f.html"
    argv = (
        f"fit ranges --cue stop_sign --truth {fitted} --test {other} --page {page} --family pinhole"
    ).split()

    reported = json_of(*argv)
    assert reported["fits"][0]["residual_sd_m"] < 0.01
    assert reported["tested"]["residual_sd_m"] == pytest.approx(1.0, rel=0.3)
    assert reported["tested"]["pairs"] == 60
    assert "other drives" in page.read_text()
    assert run(argv) == 1  # the page already exists
    assert "on other drives, 60 pairs" in output_of(*argv, "--overwrite")


def test_confident_detections_of_run_are_paired_with_truth_ranges(tmp_path: Path) -> None:
    truth = annotated_drive(tmp_path / "a")
    t_ns = [1_700_000_000_000_000_000 + k * 100_000_000 for k in (3, 4, 5)] + [9]
    table = pa.table(
        {
            "t_ns": t_ns,
            "label": ["stop sign", "stop sign", "car", "stop sign"],
            "score": [0.95, 0.5, 0.99, 0.99],
            "height_px": [20.0] * 4,
        }
    )
    pq.write_table(table, tmp_path / "detections.parquet")

    pairs = pairs_of_run(tmp_path, truth, "stop_sign", 0.9)

    assert pairs.range_m.tolist() == [67.0]


CAR = """
version = 1
[camera]
x_m = 1.8
z_m = 1.8
focal_px = 1970.0
center_px = [970.0, 483.3]
"""
CAMERA_M = 1.8
# Distance from the first frame's camera to the far kerb and the crosswalk, each within 2.5 m.
TRUTH_M = {"end": 79.0, "start": 59.0}


@pytest.fixture(scope="module")
def real_drive(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    log = shared("sequences", "pandaset_002")
    folder = tmp_path_factory.mktemp("real")
    (folder / "car.toml").write_text(CAR)
    argv = ["replay", str(log), "--vehicle", str(folder / "car.toml"), "-o", str(folder / "run")]
    cache = ["--cache", str(folder / "cache.sqlite")]
    with pytest.MonkeyPatch.context() as patch:
        fetch_networks(patch, folder / "models", "yolox-nano")
        assert run([*argv, "--detectors", "yolox-nano", *cache]) == 0
    return open_run(folder / "run")


def columns(real_drive: RunFolder, reference: str) -> tuple[Floats, Floats, Floats]:
    """Ranges, their standard deviations and the distance travelled, by row."""
    table = real_drive.table("range")
    pose = real_drive.table("pose", ["t_ns", "travelled_m"])
    gone = dict(zip(pose["t_ns"].to_pylist(), pose["travelled_m"].to_pylist(), strict=True))
    rows = [row for row in table.to_pylist() if row["reference"] == reference]
    return (
        np.array([row["range_m"] for row in rows]),
        np.sqrt([row["var_m2"] for row in rows]),
        np.array([gone.get(row["t_ns"], 0.0) for row in rows]),
    )


@pytest.mark.slow
@pytest.mark.parametrize("reference", ["end", "start"])
def test_range_decreases_and_interval_contains_truth(real_drive: RunFolder, reference: str) -> None:
    range_m, sd_m, gone_m = columns(real_drive, reference)
    true_m = TRUTH_M[reference] + CAMERA_M - gone_m

    # The car stands in its first 23 of 80 frames, in which no approach opens. One light marks the
    # start, and its assumed size is no range until growth confirms it.
    assert len(range_m) >= {"end": 55, "start": 15}[reference]
    steps_m, moved_m = np.diff(range_m), np.diff(gone_m)
    # While the vehicle stands, wheels and poses move back by millimetres.
    assert (steps_m <= np.maximum(-moved_m, 0.0) + 0.01).all()
    assert (np.abs(range_m - true_m) < 1.96 * sd_m).all()
    assert (np.abs(range_m / true_m - 1.0) < 0.1).all()
    assert sd_m[-1] < 0.8 * sd_m[0]
