"""A site of failures: each failure has a page that lists reach with and without the script."""

from html.parser import HTMLParser
from pathlib import Path

import pytest

import crosscue
from crosscue.eval.failures.browse import Site
from support.scene_run import scene_run
from support.scoring import truth_folder


class Links(HTMLParser):
    """Parser of a page's links and content."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.found: list[Path] = []
        self.scripts = 0
        self._folder = page.parent
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep the addresses that an element refers to."""
        self.scripts += tag == "script"
        for name, value in attrs:
            if name in ("href", "src") and value is not None and "://" not in value:
                self.found.append((self._folder / value).resolve())


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
        assert [path for path in Links(page).found if not path.exists()] == [], page
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
