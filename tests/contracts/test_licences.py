"""The page of licences names every installed dependency that is not permissive."""

import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PAGE: Final = ROOT / "docs" / "reference" / "licences.md"
RESTRICTED: Final = re.compile(r"GPL|NVIDIA|Proprietary", re.IGNORECASE)
NAME: Final = re.compile(r"[A-Za-z0-9._-]+")


def _required(name: str, found: dict[str, str]) -> dict[str, str]:
    """Add the licence of each installed package that a package requires, by name."""
    try:
        package = distribution(name)
    except PackageNotFoundError:
        return found
    metadata = package.metadata
    fields = ("License-Expression", "License", "Classifier")
    texts = (text for field in fields for text in metadata.get_all(field, []))
    # A whole licence in the field begins with its title.
    found[name] = " ".join(text[:80] for text in texts if "Intended" not in text)
    for requirement in package.requires or ():
        match = NAME.match(requirement)
        assert match is not None
        if "extra ==" not in requirement and match[0].lower() not in found:
            _required(match[0].lower(), found)
    return found


def test_page_and_readme_name_dependencies_that_are_not_permissive() -> None:
    page = PAGE.read_text(encoding="utf-8")
    restricted = {
        name for name, text in _required("crosscue", {}).items() if RESTRICTED.search(text)
    }

    assert "python-can" in restricted
    families = {"`nvidia-" if one.startswith("nvidia-") else one for one in restricted}
    families = {"`cuda-" if one.startswith("cuda-") else one for one in families}
    assert {one for one in families if one not in page} == set()
    readme = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Licence")[2]
    assert "python-can" in readme
    assert "CUDA" in readme
