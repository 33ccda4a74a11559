"""Networks in the public interface: the catalog, a user's card, and its check."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import crosscue
from crosscue.eval.cli import run
from support.onnx_models import bright_box_model


def test_model_catalog_matches_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    found = crosscue.models()

    assert run(["model", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found.as_dict()
    assert run(["model", "list"]) == 0
    assert capsys.readouterr().out == f"{found!r}\n"
    assert len(repr(found).splitlines()) == len(found) >= 4
    assert repr(crosscue.model(found[0].name)) == repr(found[0])


def test_model_lists_its_cue_labels_and_size(capsys: pytest.CaptureFixture[str]) -> None:
    found = crosscue.model("yolox-nano")

    assert {"car", "stop sign", "traffic light"} <= {*found.cue_labels}
    assert found.size_mb == pytest.approx(3.66, abs=0.01)
    assert run(["model", "show", "yolox-nano"]) == 0
    assert capsys.readouterr().out == f"{found!r}\n"


def test_misspelt_model_name_gets_a_suggestion() -> None:
    with pytest.raises(crosscue.UsageError, match="did you mean yolox-nano"):
        crosscue.model("yolox-nanno")
    with pytest.raises(crosscue.UsageError, match="did you mean yolox-nano"):
        crosscue.fetch_model("yolox-nanno")


@pytest.mark.parametrize(
    "name", ['a "quoted" one', "back\\slash", "delete\x7f", "tab\t", "Stoppschild ü"]
)
def test_card_keeps_unusual_class_names(name: str, tmp_path: Path) -> None:
    (tmp_path / "net.onnx").write_bytes(bright_box_model())

    drafted = crosscue.draft_card(tmp_path / "net.onnx", class_names=[name], size_px=(96, 64))

    assert crosscue.model(drafted.path).card.output.classes == (name,)


def test_card_is_drafted_and_checked_from_python(tmp_path: Path) -> None:
    (tmp_path / "net.onnx").write_bytes(bright_box_model())

    drafted = crosscue.draft_card(tmp_path / "net.onnx", class_names=["bright"], size_px=(96, 64))
    checked = crosscue.check_card(drafted.path)

    assert drafted.draft.kind == "end-to-end"
    assert drafted.as_dict()["picture"] is None
    card = crosscue.model(drafted.path).card
    assert card.output.classes == ("bright",)
    assert (card.input.width_px, card.input.height_px) == (96, 64)
    assert repr(checked) == f"{drafted.path}: fits its network"
    with pytest.raises(crosscue.UsageError, match="exists"):
        crosscue.draft_card(tmp_path / "net.onnx", class_names=["bright"])
    with pytest.raises(crosscue.UsageError, match="not supported as yolox"):
        crosscue.draft_card(tmp_path / "net.onnx", tmp_path / "other.toml", kind="yolox")
