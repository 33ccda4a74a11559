"""Settings of training from the public interface."""

from pathlib import Path

import pytest

import crosscue
from crosscue.eval.training.mask_rcnn import MaskRcnnTrainingSettings
from crosscue.eval.training.road import RoadTrainingSettings


def test_invalid_training_settings_are_refused_before_writing(tmp_path: Path) -> None:
    road = RoadTrainingSettings(layouts=["L1"], width_px=130)
    masks = MaskRcnnTrainingSettings(data="gone", images="gone", window_px=(65, 64))

    with pytest.raises(crosscue.UsageError, match="multiple of 16"):
        crosscue.train_road(road, tmp_path / "a.safetensors")
    with pytest.raises(crosscue.UsageError, match="multiples of 32"):
        crosscue.train_mask_rcnn(masks, tmp_path / "a.safetensors")
    with pytest.raises(crosscue.UsageError, match="expected --test-layouts"):
        crosscue.train_road(RoadTrainingSettings(), measure="embedded")
    with pytest.raises(crosscue.UsageError, match="only for scoring"):
        crosscue.render_training_frames(tmp_path / "c", ["A"])
    assert not [*tmp_path.iterdir()]
