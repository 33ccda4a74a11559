"""Training pictures from the public interface equal those of the command."""

from __future__ import annotations

import argparse
import json
from dataclasses import fields
from importlib import import_module
from pathlib import Path

import pytest

import crosscue
from crosscue.eval.cli import run


@pytest.mark.slow
def test_training_frames_equal_those_of_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[tuple[int, int]] = []

    found = crosscue.render_training_frames(
        tmp_path / "a",
        ["L400-L401"],
        per_layout=1,
        width_px=64,
        on_runs=lambda done, of: seen.append((done, of)),
    )
    line = ["train", "frames", "L400-L401", "--per-layout", "1", "--width", "64"]
    assert run([*line, "-o", str(tmp_path / "b"), "--json"]) == 0

    assert seen == [(1, 2), (2, 2)]
    assert json.loads(capsys.readouterr().out) == found.as_dict() | {
        "coco": str(tmp_path / "b" / "coco.json")
    }
    made = [sorted((tmp_path / name).rglob("*.*")) for name in "ab"]
    assert [one.read_bytes() for one in made[0]] == [one.read_bytes() for one in made[1]]
    assert len(made[0]) == 1 + found.pictures == 3
    with pytest.raises(crosscue.UsageError, match="only for scoring"):
        crosscue.render_training_frames(tmp_path / "c", ["A"])


def test_intersection_study_refuses_training_layouts() -> None:
    with pytest.raises(crosscue.UsageError, match="expected some of A to H"):
        crosscue.IntersectionStudy(layouts=("L1",))


def _defaults(command: str) -> dict[str, object]:
    """Return the command's defaults of optional arguments."""
    parser = argparse.ArgumentParser()
    import_module(f"crosscue.eval.commands.train.{command}").add_arguments(parser)
    return {
        action.dest: action.default
        for action in parser._actions
        if not action.required and action.default is not argparse.SUPPRESS
    }


@pytest.mark.parametrize(
    ("command", "settings"),
    [
        ("road", crosscue.RoadTrainingSettings()),
        ("mask_rcnn", crosscue.MaskRcnnTrainingSettings(data="", images="")),
    ],
)
def test_training_settings_have_the_defaults_of_the_command(
    command: str, settings: crosscue.RoadTrainingSettings | crosscue.MaskRcnnTrainingSettings
) -> None:
    flags = {"width_px": "width", "window_px": "window"}
    defaults = _defaults(command)

    for field in fields(settings):
        value = getattr(settings, field.name)
        if field.name not in ("data", "images"):
            default = defaults[flags.get(field.name, field.name)]
            if isinstance(value, tuple):
                value, default = list(value), list(default or ())  # type: ignore[call-overload]
            assert value == default, field.name


def test_invalid_training_settings_are_refused_before_writing(tmp_path: Path) -> None:
    road = crosscue.RoadTrainingSettings(layouts=["L1"], width_px=130)
    masks = crosscue.MaskRcnnTrainingSettings(data="gone", images="gone", window_px=(65, 64))

    with pytest.raises(crosscue.UsageError, match="multiple of 16"):
        crosscue.train_road(road, tmp_path / "a.safetensors")
    with pytest.raises(crosscue.UsageError, match="multiples of 32"):
        crosscue.train_mask_rcnn(masks, tmp_path / "a.safetensors")
    with pytest.raises(crosscue.UsageError, match="expected --test-layouts"):
        crosscue.measure_road("embedded")
    assert not [*tmp_path.iterdir()]
