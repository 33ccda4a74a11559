"""Public names exist, are documented, and are imported lazily."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

import crosscue
from crosscue.eval import cli

ROOT: Final = Path(__file__).parents[3]
HEAVY: Final = ("torch", "rerun", "ray", "matplotlib", "numba", "pyarrow", "numpy", "pydantic")


def test_import_of_crosscue_loads_no_heavy_packages() -> None:
    code = f"import sys, crosscue; print(sorted(set({HEAVY!r}) & sys.modules.keys()))"

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert done.stdout.strip() == "[]"


def test_version_equals_output_of_the_command(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.run(["--version"]) == 0

    assert capsys.readouterr().out == f"crosscue {crosscue.__version__}\n"
    assert re.fullmatch(r"\d+\.\d+.*", crosscue.__version__)


@pytest.mark.parametrize("name", crosscue.__all__)
def test_public_name_exists_and_is_documented(name: str) -> None:
    found = getattr(crosscue, name)

    assert (found.__doc__ or "").strip()
    assert name in dir(crosscue)


def test_reference_pages_list_exactly_the_public_names() -> None:
    listed = [
        name
        for page in ("interface", "errors")
        for name in re.findall(
            r"^\.\. auto(?:function|class|exception|data):: crosscue\.(\w+)(?:\(\))?$",
            (ROOT / "docs" / "reference" / f"{page}.md").read_text(encoding="utf-8"),
            re.MULTILINE,
        )
    ]

    assert sorted(listed) == sorted(crosscue.__all__)
