"""The labelling loop: failing frames are exported, corrected, imported and used."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.datasets.truth.coco import read_coco
from crosscue.detectors.training.annotations import read_training_coco as read_to_train
from crosscue.eval.failures.imported_truth import ImportedLabels
from crosscue.eval.failures.record import Failure, read_failures
from crosscue.eval.fit.truth_check import check_truth
from crosscue.eval.runs.folder import write_manifest
from crosscue.eval.runs.manifest import EstimateManifest
from crosscue.eval.training.mask_rcnn import MaskRcnnTrainingSettings
from crosscue.replay.errors import OutputError, SchemaError, UsageError
from crosscue.replay.progress import watching
from support.scene_run import SIZE, scene_run
from support.scoring import at, truth_folder


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
