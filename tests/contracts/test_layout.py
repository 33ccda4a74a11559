"""Modules are formatted by ruff, with few exceptions."""

import re
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
FOLDERS: Final = (
    "replay", "detectors", "fusion", "localization", "datasets", "eval", "benchmarks", "tests",
)  # fmt: skip
MAX_SKIPS: Final = 40


def test_only_constant_tables_are_formatted_by_hand() -> None:
    marker = "# fmt: " + "skip"
    found: list[str] = []
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*.py")):
            lines = path.read_text(encoding="utf-8").splitlines()
            for number, line in enumerate(lines, 1):
                if line.endswith(marker):
                    found.append(f"{path.relative_to(ROOT)}:{number}: {line}")
                    # Only the end of a table at the top level of a module may have the marker.
                    assert re.match(r"[)\]}]", line), found[-1]

    assert len(found) <= MAX_SKIPS, "\n".join(found)
