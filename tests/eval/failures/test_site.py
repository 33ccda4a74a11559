"""A site of failures: each failure has a page that lists reach with and without the script."""

import re
from pathlib import Path
from urllib.parse import unquote

import pytest

import crosscue
from crosscue.eval.failures.browse import Site
from support.scene_run import scene_run
from support.scoring import truth_folder


def missing_links(page: Path) -> list[Path]:
    """Files to which a page refers and that do not exist."""
    found = re.findall(r'(?:href|src)="([^":]+)"', page.read_text(encoding="utf-8"))
    assert found
    return [path for path in (page.parent / unquote(one) for one in found) if not path.exists()]


@pytest.fixture(scope="module")
def site_of_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Site]:
    folder = tmp_path_factory.mktemp("site")
    run, truth = scene_run(folder).path, truth_folder(folder / "truth")
    return folder, crosscue.browse(run, folder / "site", truth=truth)


def test_all_links_resolve_and_each_failure_has_page_and_picture(
    site_of_run: tuple[Path, Site],
) -> None:
    folder, site = site_of_run
    pages = sorted((folder / "site").rglob("*.html"))

    for page in pages:
        assert missing_links(page) == [], page
    assert len(list((folder / "site" / "f").iterdir())) == site.failures > 1
    assert site.without_picture == 0
    small, large = ({p.name for p in (folder / "site" / part).iterdir()} for part in ("t", "p"))
    assert small == large


def test_names_are_escaped_in_pages(site_of_run: tuple[Path, Site]) -> None:
    folder, _ = site_of_run
    for page in (folder / "site").rglob("*.html"):
        assert "<img src=x" not in page.read_text()


def test_missing_log_yields_pages_without_pictures(tmp_path: Path) -> None:
    run, truth = scene_run(tmp_path / "drive").path, truth_folder(tmp_path / "truth")
    (tmp_path / "drive" / "drive.mcap").unlink()

    site = crosscue.browse(run, tmp_path / "site", truth=truth)
    assert site.pictures == 0
    assert site.without_picture == site.failures
    assert "drive.mcap" in site.reasons[0]
