"""Training pictures from the public interface equal those of the command."""

import json
from pathlib import Path

import pytest

import crosscue
from crosscue.eval.cli import run
from crosscue.eval.training.mask_rcnn import MaskRcnnTrainingSettings
from crosscue.eval.training.road import RoadTrainingSettings
from crosscue.replay.progress import Progress, watching


@pytest.mark.slow
def test_training_frames_equal_those_of_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[object] = []

    with watching(seen.append):
        found = crosscue.render_training_frames(
            tmp_path / "a", ["L400-L401"], per_layout=1, width_px=64
        )
    line = ["train", "frames", "L400-L401", "--per-layout", "1", "--width", "64"]
    assert run([*line, "-o", str(tmp_path / "b"), "--json"]) == 0

    assert seen == [Progress("rendering", done, 2, "runs") for done in (1, 2)]
    assert json.loads(capsys.readouterr().out) == found.as_dict() | {
        "coco": str(tmp_path / "b" / "coco.json")
    }
    made = [sorted((tmp_path / name).rglob("*.*")) for name in "ab"]
    assert [one.read_bytes() for one in made[0]] == [one.read_bytes() for one in made[1]]
    assert len(made[0]) == 1 + found.pictures == 3
    with pytest.raises(crosscue.UsageError, match="only for scoring"):
        crosscue.render_training_frames(tmp_path / "c", ["A"])


def test_invalid_training_settings_are_refused_before_writing(tmp_path: Path) -> None:
    road = RoadTrainingSettings(layouts=["L1"], width_px=130)
    masks = MaskRcnnTrainingSettings(data="gone", images="gone", window_px=(65, 64))

    with pytest.raises(crosscue.UsageError, match="multiple of 16"):
        crosscue.train_road(road, tmp_path / "a.safetensors")
    with pytest.raises(crosscue.UsageError, match="multiples of 32"):
        crosscue.train_mask_rcnn(masks, tmp_path / "a.safetensors")
    with pytest.raises(crosscue.UsageError, match="expected --test-layouts"):
        crosscue.train_road(RoadTrainingSettings(), measure="embedded")
    assert not [*tmp_path.iterdir()]
