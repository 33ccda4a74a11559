"""Tests of the catalog: every entry is complete, and downloads are verified and resumed."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from torchvision.models import get_model_weights

from crosscue.detectors.base import Detections, DetectorChoice
from crosscue.detectors.catalog import entries, fetch, places
from crosscue.detectors.catalog.card import ModelCard, WeightFile
from crosscue.detectors.catalog.class_names import cue_label
from crosscue.detectors.registry import make
from crosscue.replay.errors import CrosscueError, UsageError
from support.data import shared
from support.range_server import Served, serving

CONTENT = bytes(range(256)) * 4096
SHA256 = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv(places.VARIABLE, str(folder))
    monkeypatch.delenv(fetch.DATA, raising=False)
    monkeypatch.delenv(fetch.MIRROR, raising=False)
    return folder


@pytest.fixture
def server() -> Iterator[Served]:
    with serving() as served:
        served.files["net.onnx"] = CONTENT
        yield served


@pytest.fixture
def card(server: Served, cache: Path, monkeypatch: pytest.MonkeyPatch) -> ModelCard:
    """Set up a catalog with one model, ``net``, with weights on the server."""
    whole = entries.entry("yolox-nano")
    file = WeightFile(
        name="net.onnx", url=f"{server.base}/net.onnx", size_bytes=len(CONTENT), sha256=SHA256
    )
    changed = whole.model_copy(
        update={"weights": "net.onnx", "sha256": SHA256, "files": (file,), "licence": "MIT"}
    )
    monkeypatch.setattr(fetch, "entry", lambda name: changed)
    return changed


@pytest.mark.parametrize("name", places.names())
def test_every_entry_describes_its_model_and_weights(name: str) -> None:
    card = entries.entry(name)

    assert card.about
    assert card.licence
    assert card.source
    assert card.files[0].name == card.weights
    assert card.files[0].sha256 == card.sha256
    assert len(set(card.output.classes)) == len(card.output.classes)


@pytest.mark.parametrize("name", places.names())
def test_thresholds_of_an_entry_have_counts_with_and_without_the_object(name: str) -> None:
    card = entries.entry(name)

    for label, one in card.scores.items():
        if one.threshold is None:
            continue
        for begin in (f"{label} found above {one.threshold}", f"{label} above {one.threshold} w"):
            (shown,) = [each for each in card.evidence if each.metric.startswith(begin)]
            assert shown.boxes
            assert shown.low is not None
            assert shown.high is not None
            assert shown.low <= shown.value <= shown.high
            assert shown.measured


def test_run_uses_the_threshold_of_an_entry_unless_the_vehicle_file_has_one() -> None:
    """A stop sign at 0.7 is below the threshold of yolox-nano, 0.75."""
    card = entries.entry("yolox-nano")
    known = {label: one.threshold for label, one in card.scores.items() if one.threshold}
    box, score = np.array([[0.0, 0.0, 9.0, 9.0]]), np.array([0.7])
    found = Detections(0, (9, 9), box, score, ("stop sign",), (b"",)).with_min_scores(known)

    assert known["stop sign"] == 0.75
    assert found.are_sure(None).tolist() == [False]
    assert found.are_sure(0.6).tolist() == [True]


@pytest.mark.parametrize("name", [name for name in places.names() if "rcnn" in name])
def test_torchvision_entries_match_the_installed_torchvision(name: str) -> None:
    """Compare URL, start of the hash, network and classes with the installed package."""
    card = entries.entry(name)
    assert card.network is not None
    weights = get_model_weights(card.network.architecture).DEFAULT
    (file,) = card.files

    assert file.url == weights.url
    assert file.sha256.startswith(Path(weights.url).stem.rsplit("-", 1)[-1])
    assert file.size_bytes / 2**20 == pytest.approx(weights.meta["_file_size"], abs=1e-3)
    assert entries.weights_path(card, file).name == Path(weights.url).name
    theirs = weights.meta["categories"][1:]
    assert len(theirs) == len(card.output.classes)
    assert all(
        ours == name or (name == "N/A" and ours.startswith("unused"))
        for ours, name in zip(card.output.classes, theirs, strict=True)
    )
    published = weights.meta["_metrics"]["COCO-val2017"]
    stated = {one.metric: one.value for one in card.evidence if "COCO val2017" in one.pictures}
    assert stated["box AP, %"] == published["box_map"]
    assert stated.get("mask AP, %") == published.get("mask_map")


@pytest.mark.parametrize("name", places.names())
def test_every_available_entry_runs(
    name: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Load the weights with the recorded hash from the data folder."""
    monkeypatch.setenv(fetch.DATA, str(shared("weights").parent))
    monkeypatch.setenv(fetch.MIRROR, "http://127.0.0.1:9")
    try:
        fetch.fetch_weights(name)
    except CrosscueError:
        pytest.skip(f"the weights of {name} are not available")

    detector = make(DetectorChoice(name, name))

    assert detector.identity.startswith("model-")


@pytest.mark.parametrize("name", ["my.onnx", "nets/own.safetensors", "weights.pth"])
def test_weights_in_place_of_a_detector_are_answered_with_how_to_name_them(name: str) -> None:
    with pytest.raises(UsageError, match=r"expected a model card.*crosscue model init.*detectors"):
        make(DetectorChoice(name, name))


@pytest.mark.parametrize("content", [CONTENT[:-1] + b"x", CONTENT + b"more", b"<html>404</html>"])
def test_download_with_another_hash_is_not_kept(
    card: ModelCard, server: Served, content: bytes
) -> None:
    server.files["net.onnx"] = content

    for _ in range(2):
        if content.startswith(CONTENT):
            (found,) = fetch.fetch_weights("net")
            assert found.path.read_bytes() == CONTENT
            continue
        with pytest.raises(
            CrosscueError, match=r"the download is not net\.onnx|interrupted after 16"
        ):
            fetch.fetch_weights("net")
        assert not entries.weights_path(card, card.files[0]).exists()


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("Traffic_Light", "traffic light"),
        ("StopSign", "stop sign"),
        ("stop-sign", "stop sign"),
        ("vehicle", "car"),
        ("no entry", "do not enter"),
        ("giraffe", None),
        ("stop light", None),
    ],
)
def test_class_names_map_to_cue_labels(name: str, label: str | None) -> None:
    assert cue_label(name) == label
