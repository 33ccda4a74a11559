"""Without faults, a simulated detector finds exactly the visible objects."""

import numpy as np

from crosscue.datasets.scenes.faulty_labels import LABELS, NO_FAULTS, FaultyLabels
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame, RoadMask
from crosscue.detectors.label_images import objects, road
from support.scenes import SMALL, when_at, world


def test_detector_without_faults_finds_exactly_visible_objects() -> None:
    there = world("A")
    settings = SceneSettings(layout="A", camera=SMALL)
    picture = FaultyLabels(there, settings, NO_FAULTS).picture(when_at(there, -20.0))
    size_px = (SMALL.width_px, SMALL.height_px)
    frame = Frame(7, "camera", np.ascontiguousarray(picture.rgb[..., ::-1]), size_px)

    (found,), (ground,) = objects()([frame]), road()([frame])

    assert isinstance(found, Detections)
    assert isinstance(ground, RoadMask)
    clear = [LABELS[one.thing.category] for one in picture.seen if one.visible > 0.7]
    hidden = [LABELS[one.thing.category] for one in picture.seen if 0.25 < one.visible <= 0.7]
    assert "stop sign" in clear
    for label in set(LABELS.values()):
        many = found.labels.count(label)
        assert clear.count(label) <= many <= clear.count(label) + hidden.count(label)
    assert rle.decode_mask(ground.mask, ground.mask_size_px)[-1].all()
