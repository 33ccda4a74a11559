"""The package, changelog, citation and release tag state the same version."""

import re
import subprocess
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION = PROJECT["version"]
PACKAGES = ("replay", "detectors", "fusion", "localization", "datasets", "eval", "docs")


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


def test_hints_name_packages_that_pip_finds() -> None:
    extras = PROJECT["optional-dependencies"]
    wanted = [*PROJECT["dependencies"], *(one for name in extras for one in extras[name])]
    known = {re.split(r"[<>=;\[]", one)[0] for one in wanted}
    files = [
        path
        for folder in PACKAGES
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".md") and "_build" not in path.parts
    ]
    text = "\n".join(path.read_text(encoding="utf-8") for path in files)
    hints = set(re.findall(r"pip install ([a-z][\w-]*)", text))

    # crosscue itself is on no index, so "pip install 'crosscue[onnx]'" finds nothing.
    assert "crosscue[" not in text
    assert {"openvino", "ray", "mlflow-skinny"} <= hints
    # A database as MLflow's store needs the whole of it; see the page on scores.
    assert hints - known == {"mlflow"}
