"""The text of the product uses the terms of the style guide.

This covers names, comments, docstrings and messages of every module, and the pages of the
documentation. The changelog is excluded, because past entries are not reworded.
"""

import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
FOLDERS: Final = (
    "replay",
    "detectors",
    "fusion",
    "localization",
    "datasets",
    "eval",
    "benchmarks",
    "tests",
    "docs",
)

PHRASES: Final = {
    "report": r"(?<!can )(?<!cannot )(?<!could )\b(tell|tells|told|telling)\b(?! (\w+ ){0,4}apart)"
    r"(?! from)",
    "fraction of": r"\bshares? of\b",
    "observations": r"\b(independent|positive|negative|first|second|third|every) looks?\b"
    r"(?! (like|at|for|up|into|as|ahead|inside))",
    "examine": r"\b(looked|looks) at\b",
    "repair": r"\b(mend(s|ed|ing)?|put right)\b",
    "does not exist, is not one": r"\b(there (is|are) none|is none(?! of))\b",
    "overconfident": r"\b(over|under)-sure\b",
    "ego vehicle": r"\bown cars?\b",
    "all features established": r"\bbelieved in full\b",
    "exits, fails": r"\bway out\b",
    "expected": r"[:;,] wants?\b(?! to)",
    "again, over": r"\banew\b",
    "a noun, at the start of a docstring": r'"""(What|Which|How (far|many|much|often)|Likewise) ',
    "permanently": r"\bfor ever\b",
    "consistent, of a filter": r"\bhonest\b",
    "where known": r"\bas far as (it |that )?(is|can be) (known|said)\b",
    "is not a": r"(?<!there )\bis no (layout|time|number|text|multiplexer|file|table|count)\b",
}
"""Recommended words, and patterns of the words in prose that they replace."""

NAMES: Final = {
    "report": r"(^|_)(told|tells|tell)(_|$)(?!apart|from)",
    "max or min": r"^_?(MOST|LEAST|most|least)(_(?!common|recent|squares)|$)",
    "fraction": r"(^|_)(?<!dead_end_)(?<!row_)(?<!column_)shares?(_at|_by_cluster)?$|[a-z]Shares$",
    "repair": r"(^|_)mend(s|ed|ing)?(_|$)",
    "overconfident": r"(^|_)(over|under)_sure(_|$)",
    "a test's name without article or pronoun": r"^test_(an?|the|it|what|which|whatever)_",
    "a noun": r"^test_\w*_(what|whatever|nobody)_",
    "states, reports, requires": r"^test_\w*_(says?|said|knows|hears|speaks|wants)(_|$)",
    "unsupported, unrelated": r"^test_\w*_foreign(_|$)",
    "selected, requested": r"^test_\w*_asked_for(_|$)",
    "is missing, is invalid": r"^test_\w*_is_none(_|$)",
}
"""Recommended words, and patterns of the words in identifiers that they replace."""

NAMES_OF_OTHERS: Final = {"tell", "row_shares", "column_shares"}
"""Names of other libraries: a method of files, and arguments of Rerun."""


def _sources(ending: str) -> list[Path]:
    return sorted(
        path
        for folder in FOLDERS
        for path in (ROOT / folder).rglob(f"*{ending}")
        if "_build" not in path.parts and path != Path(__file__)
    )


def _words(path: Path) -> Iterator[tuple[int, str, dict[str, str]]]:
    """Yield line and text of each token to check, and the table that applies to it."""
    text = path.read_text(encoding="utf-8")
    # Splitting a file into tokens is slow, and most files contain none of the words.
    if not _may_be_in(text):
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME and token.string not in NAMES_OF_OTHERS:
            yield token.start[0], token.string, NAMES
        elif token.type in (tokenize.COMMENT, tokenize.STRING):
            yield token.start[0], token.string, PHRASES


def _may_be_in(text: str) -> bool:
    """Return whether a text contains any word of the tables."""
    prose, names = " ".join(text.split()), "\n".join(set(re.findall(r"\w+", text)))
    return bool(
        _loosely(*PHRASES.values()).search(prose) or _loosely(*NAMES.values()).search(names)
    )


@cache
def _loosely(*patterns: str) -> re.Pattern[str]:
    """Combine patterns without their lookaround assertions, for a fast first search."""
    around = r"\(\?<?!(?:[^()]|\([^()]*\))*\)"
    return re.compile("|".join(re.sub(around, "", one) for one in patterns), re.MULTILINE)


def _replaced(where: str, text: str, table: dict[str, str]) -> Iterator[str]:
    words = " ".join(text.split())
    if not _loosely(*table.values()).search(words):
        return
    for instead, pattern in table.items():
        if found := re.search(pattern, words):
            yield f"{where}: {found[0]!r}; write: {instead}"


def test_code_uses_terms_of_style_guide() -> None:
    found = [
        line
        for path in _sources(".py")
        for number, text, table in _words(path)
        for line in _replaced(f"{path}:{number}", text, table)
    ]

    assert not found, "\n".join(found)


def test_documentation_uses_terms_of_style_guide() -> None:
    top = ("README.md", "CONTRIBUTING.md", "SECURITY.md")
    pages = [*_sources(".md"), *(ROOT / name for name in top)]
    found = [
        line
        for page in pages
        for number, text in enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
        for line in _replaced(f"{page.relative_to(ROOT)}:{number}", text, PHRASES)
    ]

    assert not found, "\n".join(found)


def test_replaced_terms_are_found() -> None:
    assert list(_replaced("a.py:1", "the reader tells of two losses", PHRASES))
    assert list(_replaced("a.py:1", "MOST_BYTES", NAMES))
    assert list(_replaced("a.py:1", "test_a_line_says_what_it_says", NAMES))
    assert list(_replaced("a.py:1", "test_log_knows_its_time", NAMES))
    assert not list(_replaced("a.py:1", "test_log_is_read_completely", NAMES))
    assert not list(_replaced("a.py:1", "cannot tell one from the other", PHRASES))
    assert not list(_replaced("a.py:1", "told apart by their order", PHRASES))
