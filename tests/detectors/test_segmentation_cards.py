"""A card is drafted for segmentation networks as well, and the road is drawn in a picture."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray

import crosscue
from crosscue.detectors.base import Frame
from crosscue.detectors.networks.model_detector import RoadModel, build
from crosscue.replay.errors import UsageError, VehicleError
from support.data import shared
from support.onnx_models import constant_model

# Real networks, with their class names behind the background.
ROAD_NETWORKS = {
    "road-segmentation-adas-0001/road-segmentation-adas-0001.xml": "road,curb,mark",
    "twinlitenet/twinlitenet_best.onnx": "road",
}
PICTURE = Path("sequences", "pandaset_002", "camera", "front_camera", "00.jpg")


def scores(size: tuple[int, int], classes: int = 3) -> NDArray[np.float32]:
    """Class scores (1, C, h, w): class 1 in the lower half, class 0 above it."""
    values = np.zeros((1, classes, size[1], size[0]), np.float32)
    values[0, 0, : size[1] // 2] = values[0, 1, size[1] // 2 :] = 1.0
    return values


def network(folder: Path, size: tuple[int, int] = (64, 32), **outputs: object) -> Path:
    """Write a network for pictures of a size."""
    path = folder / "road.onnx"
    values = {name: np.asarray(value) for name, value in outputs.items()}
    path.write_bytes(constant_model((1, 3, size[1], size[0]), values))
    return path


@pytest.mark.parametrize("size", [(64, 32), (16, 8)], ids=["whole size", "a quarter"])
@pytest.mark.parametrize("names", ["sky,road,curb", "road,curb"], ids=["all", "no background"])
def test_card_is_written_and_road_is_found(
    tmp_path: Path, size: tuple[int, int], names: str
) -> None:
    card = crosscue.draft_card(network(tmp_path, mask=scores(size)), classes=names).path

    detector = build(card=str(card))
    assert isinstance(detector, RoadModel)
    mask = detector.road_mask(Frame(0, "", np.zeros((64, 128, 3), np.uint8), (128, 64)))
    np.testing.assert_array_equal(mask.mean(axis=1), np.arange(size[1]) >= size[1] // 2)


@pytest.mark.parametrize(
    ("size", "outputs"),
    [
        ((64, 32), {"depth": np.zeros((1, 1, 32, 64), np.float32)}),
        ((64, 32), {"cells": np.zeros((1, 85, 1, 2), np.float32)}),
        ((64, 32), {"a": scores((64, 32), 4), "b": scores((16, 8), 4)}),
        # Edge Impulse's FOMO has a grid of 12 x 12 for a picture of 96 x 96.
        ((96, 96), {"grid": scores((12, 12), 2)}),
    ],
    ids=["one channel", "cells of stride 32", "maps of two sizes", "grid of centres"],
)
def test_other_maps_are_not_taken_for_classes(
    tmp_path: Path, size: tuple[int, int], outputs: dict[str, NDArray[np.float32]]
) -> None:
    with pytest.raises(UsageError, match=f"{next(iter(outputs))} .*: not supported"):
        crosscue.draft_card(network(tmp_path, size, **outputs), classes="road,face")


def test_maps_of_points_are_not_taken_for_classes(tmp_path: Path) -> None:
    """A pose network's maps are zero but for a spot; a pixel's class has a high score."""
    maps = np.zeros((1, 17, 8, 16), np.float32)
    maps[0, :, 5, 7] = 0.9

    with pytest.raises(VehicleError, match=r"not written: .*maps of points"):
        crosscue.draft_card(
            network(tmp_path, maps=maps), classes=",".join(["road", *map(str, range(16))])
        )


def test_weak_scores_of_both_signs_are_classes(tmp_path: Path) -> None:
    """Logits of a network with random weights."""
    weak = np.random.default_rng(0).normal(0.0, 0.02, (1, 11, 8, 16)).astype(np.float32)

    names = ",".join(["road", *map(str, range(10))])
    assert crosscue.draft_card(network(tmp_path, logits=weak), classes=names).path.exists()


@pytest.mark.parametrize("weights", ROAD_NETWORKS)
def test_real_network_draws_its_road(tmp_path: Path, weights: str) -> None:
    given = shared("weights") / weights
    for path in (given, given.with_suffix(".bin")):
        if path.exists():
            shutil.copy(path, tmp_path)

    picture = shared(*PICTURE.parts)
    found = crosscue.draft_card(
        tmp_path / given.name, classes=ROAD_NETWORKS[weights], picture=picture
    )

    detector = build(card=str(found.path))
    assert isinstance(detector, RoadModel)
    pixels = np.asarray(cv2.imread(str(picture)), np.uint8)
    mask = detector.road_mask(Frame(0, "", pixels, (pixels.shape[1], pixels.shape[0])))
    above, below = np.array_split(mask, 2)
    assert below.mean() > 0.3
    assert above.mean() < 0.1
    drawn = np.asarray(cv2.imread(str(found.picture)), np.int64)
    assert np.abs(drawn - pixels).max(axis=2).mean() > 10.0


def test_networks_of_transformers_get_imagenet_s_mean(tmp_path: Path) -> None:
    path = network(tmp_path, logits=scores((16, 8)))
    model = onnx.load(path)
    assert all(model.graph.input[0].name not in node.input for node in model.graph.node)
    model.graph.input[0].name = "pixel_values"
    onnx.save(model, path)

    given = crosscue.model(crosscue.draft_card(path, classes="road,curb").path).card.input

    assert (given.colour, given.mean[0]) == ("rgb", 123.675)
