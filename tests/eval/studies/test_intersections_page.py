"""The template of the intersections study uses only existing fields of its records."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval.failures.causes import Finding
from crosscue.eval.studies.intersections.conditions import ConditionCost

PAGE: Final = Path(__file__).parents[3] / "eval" / "report" / "templates" / "intersections.html.j2"


@pytest.mark.parametrize(("rows", "kind"), [("findings", Finding), ("conditions", ConditionCost)])
def test_template_uses_only_existing_fields(
    rows: str, kind: type[Finding] | type[ConditionCost]
) -> None:
    text = PAGE.read_text(encoding="utf-8")
    loop = text.partition(f"{{% for one in {rows} %}}")[2].partition("{% endfor %}")[0]
    used = {*re.findall(r"\bone\.(\w+)", loop)}

    assert used
    assert used <= {field.name for field in fields(kind)}
