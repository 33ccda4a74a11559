"""Networks in the public interface: the catalog, a user's card, and its check."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import crosscue
from crosscue.detectors.catalog.cards import check_card
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


def test_card_is_drafted_and_checked_from_python(tmp_path: Path) -> None:
    (tmp_path / "net.onnx").write_bytes(bright_box_model())

    drafted = crosscue.draft_card(tmp_path / "net.onnx", class_names=["bright"], size_px=(96, 64))
    checked = check_card(drafted.path)

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
