"""No module imports itself, directly or by way of others.

import-linter holds the direction between packages; this covers the modules inside them.
"""

from graphlib import TopologicalSorter

import grimp

PACKAGES = [
    f"crosscue.{name}"
    for name in ("replay", "detectors", "fusion", "localization", "datasets", "eval")
]


def test_imports_have_no_cycle() -> None:
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    imports = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}

    assert len([*TopologicalSorter(imports).static_order()]) == len(imports) > 100
