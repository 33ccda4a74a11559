"""Measures of the import graph may improve, not deteriorate.

The goals of architecture.md are a longest chain of 12, 3.5 imports a module and about a dozen files
a folder; lower the bounds when the numbers fall.
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
TOP = ("crosscue", "crosscue.testing")
"""Modules of the package itself, whose links to the other folders grimp does not follow."""
LONGEST_CHAIN = 12
IMPORTS_PER_MODULE = 3.50
FILES_PER_FOLDER = 13
Graph = dict[str, set[str]]


@pytest.fixture(scope="module")
def imports() -> Graph:
    """From a module to those of ours that it imports, wherever in the file it does."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    # The six folders have no file of their own, so they would only lower the average.
    named = graph.modules - set(PACKAGES)
    found = {one: set(graph.find_modules_directly_imported_by(one)) for one in named}
    folder = Path(crosscue.__file__).parent
    files = {"crosscue": folder / "__init__.py", "crosscue.testing": folder / "testing.py"}
    known = {*found, *TOP}
    return found | {name: imported_by(path, known) for name, path in files.items()}


def imported_by(path: Path, known: set[str]) -> set[str]:
    """Modules of ours that a file imports, wherever in it."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found.update(name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            whole = {f"{node.module}.{name.name}" for name in node.names}
            found |= whole & known or {node.module}
    return found & known


def longest_chain(imports: Graph) -> list[str]:
    """The longest chain of imports, the importing module first."""
    open_now: set[str] = set()

    @cache
    def from_here(name: str) -> tuple[str, ...]:
        assert name not in open_now, f"{name} imports itself, by way of {sorted(open_now)}"
        open_now.add(name)
        chains: list[tuple[str, ...]] = [from_here(one) for one in sorted(imports[name])]
        found: tuple[str, ...] = max(chains, key=len, default=())
        open_now.discard(name)
        return (name, *found)

    whole: list[tuple[str, ...]] = [from_here(one) for one in imports]
    longest = max(whole, key=len)
    return list(longest)


def test_no_chain_of_imports_is_longer_than_it_was(imports: Graph) -> None:
    chain = longest_chain(imports)

    assert len(chain) <= LONGEST_CHAIN, "\n".join(chain)


def test_modules_import_no_more_than_they_did(imports: Graph) -> None:
    assert sum(map(len, imports.values())) / len(imports) <= IMPORTS_PER_MODULE


def test_no_folder_is_fuller_than_it_was(imports: Graph) -> None:
    packages = {name.rsplit(".", 1)[0] for name in imports}
    files = Counter(
        name.rsplit(".", 1)[0] for name in imports if name not in packages and "." in name
    )
    full = {folder: count for folder, count in files.items() if count > FILES_PER_FOLDER}

    assert not full


def test_one_line_imports_the_ground(imports: Graph) -> None:
    """``replay.base`` hands on what all need; who needs a part alone imports that part instead."""
    base = "crosscue.replay.base"
    ground = {base, *imports[base]} - {"crosscue.replay.safe_text"}
    # One prints the list of commands, the other is imported, without NumPy, which base needs.
    without = {"crosscue", "crosscue.eval.cli"}
    several = {
        name: sorted(found)
        for name, of in imports.items()
        if name not in ground | without and len(found := of & ground) > 1
    }

    assert not several


def test_a_chain_is_measured_and_a_cycle_is_found() -> None:
    assert longest_chain({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == ["a", "b", "c"]
    with pytest.raises(AssertionError, match="imports itself"):
        longest_chain({"a": {"b"}, "b": {"a"}})
