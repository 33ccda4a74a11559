"""The package, changelog, citation and release tag state the same version."""

import re
import subprocess
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def newest_heading() -> str:
    found = re.search(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert found
    return found[1]


def test_changelog_and_citation_have_version_of_package() -> None:
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)

    assert newest_heading().split()[0] == VERSION
    assert cited
    assert cited[1] == VERSION


def test_release_tag_has_version_of_package_and_dated_changelog() -> None:
    command = ["git", "-C", str(ROOT), "tag", "--points-at", "HEAD", "v*"]
    tags = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()

    assert tags in ([], [f"v{VERSION}"])
    if tags:
        assert re.fullmatch(r"\S+ \(\d{4}-\d\d-\d\d\)", newest_heading())
