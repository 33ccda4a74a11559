"""The import graph stays within bounds.

The goals of architecture.md are a longest chain of 12 and about a dozen files per folder. Lower the
bounds when the numbers fall.
"""

import ast
from collections import Counter
from functools import cache
from pathlib import Path

import grimp
import pytest

import crosscue

PACKAGES = [
    f"crosscue.{name}"
    for name in ("replay", "detectors", "fusion", "localization", "datasets", "eval")
]
TOP = ("crosscue", "crosscue.results", "crosscue.testing", "crosscue.verb")
"""Modules of the package ``crosscue``, whose links to the other folders grimp does not follow."""
LONGEST_CHAIN = 12
FILES_PER_FOLDER = 13
Graph = dict[str, set[str]]


@pytest.fixture(scope="module")
def imports() -> Graph:
    """Modules of ours that each module imports, anywhere in its file."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    # The six folders have no files, so they would only lower the average.
    named = graph.modules - set(PACKAGES)
    found = {one: set(graph.find_modules_directly_imported_by(one)) for one in named}
    folder = Path(crosscue.__file__).parent
    files = {name: folder / f"{name.partition('.')[2] or '__init__'}.py" for name in TOP}
    known = {*found, *TOP}
    return found | {name: imported_by(path, known) for name, path in files.items()}


def imported_by(path: Path, known: set[str]) -> set[str]:
    """Return the modules of ours that a file imports, anywhere in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            full_names = {f"{node.module}.{name.name}" for name in node.names}
            found |= full_names & known or {node.module}
    return found & known


def longest_chain(imports: Graph) -> list[str]:
    """Return the longest chain of imports, the importing module first."""
    open_now: set[str] = set()

    @cache
    def from_here(name: str) -> tuple[str, ...]:
        assert name not in open_now, f"{name} imports itself, by way of {sorted(open_now)}"
        open_now.add(name)
        chains: list[tuple[str, ...]] = [from_here(one) for one in sorted(imports[name])]
        found: tuple[str, ...] = max(chains, key=len, default=())
        open_now.discard(name)
        return (name, *found)

    chains_of_all: list[tuple[str, ...]] = [from_here(one) for one in imports]
    longest = max(chains_of_all, key=len)
    return list(longest)


def test_longest_chain_of_imports_is_within_bound(imports: Graph) -> None:
    chain = longest_chain(imports)

    assert len(chain) <= LONGEST_CHAIN, "\n".join(chain)


def test_number_of_files_per_folder_is_within_bound(imports: Graph) -> None:
    packages = {name.rsplit(".", 1)[0] for name in imports}
    files = Counter(
        name.rsplit(".", 1)[0] for name in imports if name not in packages and "." in name
    )
    full = {folder: count for folder, count in files.items() if count > FILES_PER_FOLDER}

    assert not full


def test_chain_is_measured_and_cycle_is_reported() -> None:
    assert longest_chain({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == ["a", "b", "c"]
    with pytest.raises(AssertionError, match="imports itself"):
        longest_chain({"a": {"b"}, "b": {"a"}})
