"""Networks in the public interface: the catalog, a user's card, and its check."""

import json

import pytest

import crosscue
from crosscue.eval.cli import run


def test_model_catalog_matches_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    found = crosscue.models()

    assert run(["model", "list", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found.as_dict()
    assert run(["model", "list"]) == 0
    assert capsys.readouterr().out == f"{found!r}\n"
    assert len(repr(found).splitlines()) == len(found) >= 4
    assert repr(crosscue.model(found[0].name)) == repr(found[0])
