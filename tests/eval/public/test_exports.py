"""Public names exist, are documented, and are imported lazily."""

import re

import pytest

import crosscue
from crosscue.replay import errors as replay_errors
from support.commands import output_of


def test_version_equals_output_of_the_command() -> None:
    assert output_of("--version") == f"crosscue {crosscue.__version__}\n"
    assert re.fullmatch(r"\d+\.\d+.*", crosscue.__version__)


@pytest.mark.parametrize("name", crosscue.__all__)
def test_public_name_exists_and_is_documented(name: str) -> None:
    found = getattr(crosscue, name)

    assert (found.__doc__ or "").strip()
    assert name in dir(crosscue)


def test_public_names_are_few() -> None:
    assert len(crosscue.__all__) <= 80


def test_errors_are_in_one_module() -> None:
    ours = {name for name, one in vars(crosscue.errors).items() if isinstance(one, type)}

    assert ours == {
        name
        for name, one in vars(replay_errors).items()
        if isinstance(one, type) and issubclass(one, Exception)
    }
