"""Messages say "1 row" and "2 rows": a number is never printed beside a noun in the plural."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PACKAGES: Final = (
    "replay", "detectors", "fusion", "localization", "datasets", "eval", "crosscue",
)  # fmt: skip
NOUNS: Final = (
    "rows|messages|frames|pictures|images|drives|runs|places|steps|pairs|positions|poses|classes|"
    "files|chunks|boxes|readings|parts|times|channels|reasons|approaches|intersections|outliers|"
    "detections|objects|landmarks|points|labels|values|numbers|blocks|attachments|jumps|segments"
)
# Numbers that are two or more where the line is reached, and words that are no numbers.
MORE_THAN_ONE: Final = {
    ("replay/clocks/findings.py", "clock.value"),
    ("replay/clocks/findings.py", "count"),
    ("replay/readers/mcap/checks.py", "self.chunks"),
    ("replay/readers/mcap/checks.py", "bare"),
    ("eval/report/summary.py", "covered.truth_poses"),
    ("eval/quality/checks.py", "len(far)"),
    ("eval/quality/checks.py", "lost"),
    ("eval/quality/checks.py", "len(is_so)"),
    ("eval/quality/checks.py", "name"),
    ("eval/failures/imported_truth.py", "count"),
    ("eval/catalog/compare.py", "_short(one.rows_after)"),
    ("eval/pipeline/outcome.py", "speed"),
    ("eval/fit/ranges/fit.py", "b.pairs"),
    ("eval/fit/signs/threshold.py", "wanted"),
}


def beside(source: str) -> Iterator[tuple[str, str]]:
    """Yield each value that an f-string prints beside a noun in the plural, and the noun."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.JoinedStr):
            continue
        for value, text in zip(node.values, node.values[1:], strict=False):
            if not (isinstance(value, ast.FormattedValue) and isinstance(text, ast.Constant)):
                continue
            found = re.match(rf" (?:[a-z-]+ ){{0,2}}?({NOUNS})\b", str(text.value))
            words = ast.unparse(value.value)
            if found and not re.fullmatch(r"(\w+\.)?_?[A-Z_0-9]+|counted\(.+\)", words):
                yield words, found[1]


def test_modules_that_count_with_the_helper_do_so_everywhere() -> None:
    found = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            source, name = path.read_text(), path.relative_to(ROOT).as_posix()
            if re.search(r"^from .*safe_text import .*\bcounted\b", source, re.MULTILINE):
                found += [(name, *one) for one in beside(source)]
    assert [one for one in found if one[:2] not in MORE_THAN_ONE] == []
    assert {one[:2] for one in found} == MORE_THAN_ONE


def test_number_beside_a_plural_is_found() -> None:
    assert [*beside('f"{len(rows)} rows lost"')] == [("len(rows)", "rows")]
    assert [*beside("f\"{counted(len(rows), 'row')} lost, {MAX} rows at most\"")] == []
