"""Failures of runs: frames, ranking, diverse causes, a site, and the labelling loop."""

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.datasets.truth.coco import read_coco
from crosscue.detectors.training.annotations import read_training_coco as read_to_train
from crosscue.eval import cli
from crosscue.eval.failures.approach_level import flips_without_truth
from crosscue.eval.failures.browse import Site
from crosscue.eval.failures.imported_truth import ImportedLabels
from crosscue.eval.failures.record import Failure, distance_bin, read_failures, write_failures
from crosscue.eval.fit.truth_check import check_truth
from crosscue.eval.runs.folder import write_manifest
from crosscue.eval.runs.manifest import EstimateManifest
from crosscue.eval.scoring.columns import BeliefRows
from crosscue.eval.training.mask_rcnn import MaskRcnnTrainingSettings
from crosscue.replay.errors import OutputError, SchemaError, UsageError
from crosscue.replay.progress import watching
from support.commands import output_of
from support.refusals import refusal
from support.scene_run import SIZE, scene_run
from support.scoring import at, truth_folder


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Write a synthetic run and its truth to one folder."""
    folder = tmp_path_factory.mktemp("failing")
    return scene_run(folder).path, truth_folder(folder / "truth")


def failure(severity: float = 1.0, **changes: object) -> Failure:
    usual: dict[str, object] = {
        "run": "runs/a",
        "kind": "missed",
        "level": "frames",
        "what": "stop_sign",
        "cause": "not detected",
        "reported": "",
        "t_ns": 0,
        "at_s": 0.0,
        "start_ns": 0,
        "end_ns": 0,
        "frames": 1,
        "approach": None,
        "intersection": "",
        "conditions": (),
        "distance_m": None,
    }
    return Failure(**(usual | {"severity": severity} | changes))  # type: ignore[arg-type]


def test_visible_sign_is_missed_until_its_first_detection(drive: tuple[Path, Path]) -> None:
    found = crosscue.failures(drive[0], truth=drive[1])

    (sign,) = [one for one in found.failures if one.what == "stop_sign"]
    assert (sign.kind, sign.level, sign.frames) == ("missed", "frames", 5)
    assert (sign.start_ns, sign.end_ns) == (at(5), at(9))
    # Detection should be easiest at the nearest frame; the run starts at its first frame.
    assert (sign.t_ns, sign.at_s, sign.distance_m) == (at(9), 0.9, 31.0)
    assert (sign.intersection, sign.conditions) == ("A", ("rain",))
    assert sign.cause == "not detected"
    assert sign.severity == pytest.approx(math.log2(6))


def test_overconfident_range_is_a_failure(tmp_path: Path) -> None:
    folder = scene_run(tmp_path / "drive").path
    truth = truth_folder(tmp_path / "truth")
    assert not [f for f in crosscue.failures(folder, truth=truth).failures if f.kind == "range"]

    path = folder / "range.parquet"
    table = pq.read_table(path)
    var = table["var_m2"].to_numpy().copy()
    # An error of half a metre with an s.d. of 0.1 m is five standard deviations.
    var[5:8] = 0.01
    column = table.schema.get_field_index("var_m2")
    pq.write_table(table.set_column(column, "var_m2", pa.array(var)), path)

    (wrong,) = [f for f in crosscue.failures(folder, truth=truth).failures if f.kind == "range"]
    assert (wrong.what, wrong.cause, wrong.frames) == ("range to start", "interval too narrow", 3)
    assert wrong.severity == pytest.approx(25.0 / (2.0 * math.log(2.0)))


def test_run_without_truth_reports_only_flipped_beliefs(drive: tuple[Path, Path]) -> None:
    found = crosscue.failures(drive[0])

    assert found.without_truth == (drive[0],)
    assert {one.kind for one in found.failures} <= {"flipped"}


def _belief(**features: list[float]) -> BeliefRows:
    rows = len(next(iter(features.values())))
    return BeliefRows(
        np.array([at(row) for row in range(rows)]),
        np.full(rows, 3),
        {name: np.array(values) for name, values in features.items()},
        np.zeros(rows, np.bool_),
    )


def _flips(belief: BeliefRows, cues: Mapping[str, list[int]] | None = None) -> list[Failure]:
    positives = {name: np.array([at(f) for f in frames]) for name, frames in (cues or {}).items()}
    return flips_without_truth(belief, positives, "run", 0.9)


def test_decided_belief_is_flipped_where_it_crosses_one_half() -> None:
    (flip,) = _flips(_belief(straight=[0.5, 0.95, 0.95, 0.6, 0.4, 0.05]))

    assert (flip.kind, flip.what, flip.t_ns, flip.start_ns) == ("flipped", "straight", at(4), at(2))
    assert flip.severity == pytest.approx(-math.log2(0.05))
    assert flip.cause == "no cue speaks against it"


def test_flip_names_the_contradicting_cue() -> None:
    belief = _belief(intersection=[0.5, 0.95, 0.4], left=[0.5, 0.95, 0.1])
    (left,) = [
        one for one in _flips(belief, {"one_way_right": [2]}) if one.what == "left"
    ]  # one-way right excludes a turn to the left

    assert left.cause == "a cue speaks against it"
    assert "one way right in 1 frames" in left.reported


@pytest.mark.parametrize("ending", ["parquet", "json"])
def test_failure_table_is_read_back_also_after_its_folder_moved(
    tmp_path: Path, ending: str
) -> None:
    (tmp_path / "before").mkdir()
    kept = failure(run=str(tmp_path / "before" / "run"), conditions=("rain",), distance_m=3.5)
    table = tmp_path / "before" / f"worst.{ending}"
    write_failures([kept], table)

    assert read_failures(table) == (kept,)
    (tmp_path / "before").rename(tmp_path / "after")
    (moved,) = read_failures(tmp_path / "after" / table.name)
    assert moved.run == str(tmp_path / "after" / "run")


def test_result_is_available_as_table_text_and_dict(
    drive: tuple[Path, Path], tmp_path: Path
) -> None:
    found = crosscue.failures(drive[0], truth=drive[1], top=2, output=tmp_path / "top.json")

    assert found.table.num_rows == len(found) == 2
    assert "stop_sign" in repr(found)
    assert found.found == sum(group.failures for group in found.groups)
    assert len(json.loads((tmp_path / "top.json").read_text())["failures"]) == 2
    assert found.as_dict()["found"] == found.found


def test_where_option_selects_runs(drive: tuple[Path, Path]) -> None:
    line = ["failures", str(drive[0].parent), "--truth", str(drive[1]), "--json"]

    everything = output_of(*line)
    assert output_of(*line, "--where", "stage = 'estimate'") == everything
    assert "no run where false" in refusal(1, *line, "--where", "false")
    assert cli.run([*line, str(drive[0]), "--where", "true"]) == 2


def test_each_distance_has_one_bin() -> None:
    assert [distance_bin(d) for d in (None, -1.0, 0.0, 9.9, 10.0, 79.9, 80.0)] == [
        "unknown",
        "0-10 m",
        "0-10 m",
        "0-10 m",
        "10-20 m",
        "40-80 m",
        "80 m and more",
    ]


def missing_links(page: Path) -> list[Path]:
    """Files to which a page refers and that do not exist."""
    found = re.findall(r'(?:href|src)="([^":]+)"', page.read_text(encoding="utf-8"))
    assert found
    return [path for path in (page.parent / unquote(one) for one in found) if not path.exists()]


@pytest.fixture(scope="module")
def site_of_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Site]:
    folder = tmp_path_factory.mktemp("site")
    run, truth = scene_run(folder).path, truth_folder(folder / "truth")
    return folder, crosscue.browse(run, folder / "site", truth=truth)


def test_all_links_resolve_and_each_failure_has_page_and_picture(
    site_of_run: tuple[Path, Site],
) -> None:
    folder, site = site_of_run
    pages = sorted((folder / "site").rglob("*.html"))

    for page in pages:
        assert missing_links(page) == [], page
    assert len(list((folder / "site" / "f").iterdir())) == site.failures > 1
    assert site.without_picture == 0
    small, large = ({p.name for p in (folder / "site" / part).iterdir()} for part in ("t", "p"))
    assert small == large


def test_names_are_escaped_in_pages(site_of_run: tuple[Path, Site]) -> None:
    folder, _ = site_of_run
    for page in (folder / "site").rglob("*.html"):
        assert "<img src=x" not in page.read_text()


def test_missing_log_yields_pages_without_pictures(tmp_path: Path) -> None:
    run, truth = scene_run(tmp_path / "drive").path, truth_folder(tmp_path / "truth")
    (tmp_path / "drive" / "drive.mcap").unlink()

    site = crosscue.browse(run, tmp_path / "site", truth=truth)
    assert site.pictures == 0
    assert site.without_picture == site.failures
    assert "drive.mcap" in site.reasons[0]


@pytest.fixture(scope="module")
def worst(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A table of the failures of the synthetic run, next to the run."""
    folder = tmp_path_factory.mktemp("loop")
    run, truth = scene_run(folder), truth_folder(folder / "truth")
    manifest = run.drive_manifest()
    assert isinstance(manifest, EstimateManifest)
    assert manifest.detect is not None
    detect = manifest.detect.model_copy(update={"logs": manifest.logs})
    write_manifest(run, manifest.model_copy(update={"detect": detect}))
    crosscue.failures(run.path, truth=truth, output=folder / "worst.parquet")
    return folder / "worst.parquet"


@pytest.fixture(scope="module")
def exported(worst: Path) -> Path:
    return crosscue.export(worst, worst.parent / "labelling").file


def write_corrected(exported: Path, to: Path, change: Callable[[dict[str, object]], None]) -> Path:
    """Write the export with a change applied to each box."""
    tree = json.loads(exported.read_text())
    for box in tree["annotations"]:
        change(box)
    to.write_text(json.dumps(tree))
    return to


def test_export_writes_each_recorded_picture_with_its_detections(
    worst: Path, exported: Path
) -> None:
    frames = set(pq.read_table(worst)["t_ns"].to_pylist())
    labels = read_coco(exported)

    assert {one.t_ns for one in labels.pictures} == frames
    assert {one.size_px for one in labels.pictures} == {SIZE}
    for one in labels.pictures:
        assert (exported.parent / "images" / one.name).read_bytes()[:2] == b"\xff\xd8"
        # The car is exported, the object that no cue uses is not.
        assert one.t_ns is not None
        x = 20.0 + (one.t_ns - at(0)) // 100_000_000
        assert [thing.box_px for thing in one.things] == [(x, 40.0, x + 40.0, 52.0)]


def test_corrected_boxes_are_imported_and_used_for_training_and_fitting(
    worst: Path, exported: Path, tmp_path: Path
) -> None:
    def wider(box: dict[str, object]) -> None:
        box["bbox"] = [*box["bbox"][:2], 44.0, 12.0]  # type: ignore[index]

    corrected_file = write_corrected(exported, tmp_path / "corrected.json", wider)
    found = crosscue.import_truth(corrected_file, tmp_path / "labelled", export=exported.parent)
    assert isinstance(found, ImportedLabels)

    (drive,) = found.drives.values()
    assert found.missing == 0
    objects = read_coco(Path(drive.objects))
    original = {one.t_ns: one for one in read_coco(exported).pictures}
    for one in objects.pictures:
        (thing,), (before,) = one.things, original[one.t_ns].things
        assert thing.box_px is not None
        assert before.box_px is not None
        assert thing.box_px[2] - thing.box_px[0] == 44.0
        assert thing.box_px[0] == before.box_px[0]
    # The truth fits the log, and training and the fit of the detector read all pictures.
    log = worst.parent / "drive.mcap"
    assert check_truth(drive.truth, log).objects == len(objects.pictures)
    assert read_to_train(found.coco, found.images, ("car",)).objects == len(objects.pictures)
    fitted = crosscue.fit_detector(worst.parent / "run", drive.objects, detector="finder")
    assert [one.name for one in fitted.classes] == ["car"]
    assert fitted.fitted_to + fitted.held_out == len(objects.pictures)
    # One step of training uses the same file.
    settings = MaskRcnnTrainingSettings(
        data=found.coco, images=found.images, classes=("car",), steps=1, batch=1, check_images=1
    )
    small = replace(settings, width_px=SIZE[0], window_px=(64, 64), device="cpu")
    lines: list[object] = []
    with watching(lines.append):
        trained = crosscue.train_mask_rcnn(small, tmp_path / "net.safetensors")
    assert trained.path.stat().st_size > 0
    counts = [re.search(r"(\d+) pictures?, \d+ of (\d+) object", str(line)) for line in lines[:2]]
    assert [sum(int(one[n]) for one in counts if one) for n in (1, 2)] == [len(original)] * 2


def test_existing_output_is_not_replaced(worst: Path, exported: Path, tmp_path: Path) -> None:
    crosscue.import_truth(exported, tmp_path / "labelled", export=exported.parent)
    with pytest.raises(OutputError, match="exists"):
        crosscue.import_truth(exported, tmp_path / "labelled", export=exported.parent)
    crosscue.import_truth(exported, tmp_path / "labelled", export=exported.parent, add=True)

    with pytest.raises(OutputError, match="holds files already"):
        crosscue.export(worst, exported.parent)
    with pytest.raises(UsageError, match="not of a result"):
        crosscue.export(worst, worst.parent, overwrite=True)


def test_deleted_run_is_left_out_of_the_export_with_its_reason(worst: Path, tmp_path: Path) -> None:
    kept: tuple[Failure, ...] = read_failures(worst)
    gone = replace(kept[0], run=str(tmp_path / "gone"))

    found = crosscue.export([*kept, gone], tmp_path / "labelling")
    ((run, reason),) = found.failed.items()
    assert run == gone.run
    assert "no manifest.json" in str(reason)
    assert found.pictures == len({one.t_ns for one in kept})


def test_missing_pictures_are_counted_and_unknown_or_duplicate_ones_refused(
    exported: Path, tmp_path: Path
) -> None:
    tree = json.loads(exported.read_text())
    gone = tree["images"].pop()
    tree["annotations"] = [one for one in tree["annotations"] if one["image_id"] != gone["id"]]
    (tmp_path / "fewer.json").write_text(json.dumps(tree))
    found = crosscue.import_truth(
        tmp_path / "fewer.json", tmp_path / "fewer", export=exported.parent
    )
    assert isinstance(found, ImportedLabels)
    assert found.missing == 1

    tree["images"].append({**tree["images"][0], "id": 999})
    (tmp_path / "twice.json").write_text(json.dumps(tree))
    with pytest.raises(SchemaError, match=r"expected once, found 2 times"):
        crosscue.import_truth(tmp_path / "twice.json", tmp_path / "twice", export=exported.parent)
    tree["images"].pop()

    tree["images"][0]["file_name"] = "another.jpg"
    (tmp_path / "other.json").write_text(json.dumps(tree))
    with pytest.raises(SchemaError, match=r"another.jpg: not in the export"):
        crosscue.import_truth(tmp_path / "other.json", tmp_path / "other", export=exported.parent)
    assert not (tmp_path / "other").exists()
