"""The queries of the page on queries run and return what they should."""

import re
from pathlib import Path
from typing import Any, Final

import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.catalog.query.catalog import Catalog
from crosscue.eval.runs.account import Account, Line
from support.catalog_runs import add_run, runs_below
from support.manifests import detected
from support.scoring import (
    CUES,
    approach,
    belief_table,
    cue_table,
    frame_table,
    range_table,
    span,
    truth,
    truth_folder,
)

PAGE: Final = Path(__file__).parents[3] / "docs" / "howto" / "query.md"
PAGE_QUERIES: Final = re.findall(r"```sql\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def catalog(tmp_path_factory: pytest.TempPathFactory) -> Catalog:
    """Small runs with data for all queries: one approach each, in rain, within 30 m."""
    folder = tmp_path_factory.mktemp("fleet")
    runs = runs_below(folder / "runs")
    signs = detected("front", {"signs": "objects"})
    late = {
        "frames": frame_table(50),
        "cues": cue_table(CUES),
        "belief": belief_table({"intersection": {20: 0.95}, "left": {30: 0.97}}),
        "range": range_table(8, 45, 0.5),
    }
    lost = Line(entered=5, used=2, skipped={}, dropped={"cut": 3})
    account = Account(reading=(), detecting={"front": lost}, estimating={}, is_whole=False)
    add_run(runs / "c/wednesday", "wednesday", found=late, detect=signs, account=account)
    crosscue.tag_runs([runs / "a"], {"route": "north"})
    signs_there = [span("stop_sign", 0, 40, count=1, visible=1.0)]
    drive = truth(signs_there, [approach(conditions=("rain", "dusk"))])
    reported = truth_folder(folder / "truth", drive)
    for path in runs.rglob("manifest.json"):
        argv = ["score", str(path.parent), "--truth", str(reported), "--without-figures", "-q"]
        assert cli.run(argv) in (0, 3)
    return crosscue.catalog(runs)


def test_queries_of_the_page_return_expected_rows(catalog: Catalog) -> None:
    def rows(number: int) -> list[dict[str, Any]]:
        return list(catalog.query(PAGE_QUERIES[number - 1]).to_pylist())

    assert all(map(rows, range(1, len(PAGE_QUERIES) + 1)))
    assert rows(1) == [{"vehicle": "car", "crosscue": "0", "runs": 5, "with_losses": 1}]
    assert [row["run"] for row in rows(2)] == ["c/wednesday"]
    assert rows(3)[0]["detected_m"] == 20.0
    assert {row["first_m"] for row in rows(4)} == {30.0}
    assert rows(5)[0] | {"condition": ""} == rows(5)[1] | {"condition": ""}
    assert rows(5)[0]["mean_m"] == pytest.approx((4 * 30.0 + 20.0) / 5)
    assert rows(8) == [
        {"log": f"{day}.mcap", "before_m": 30.0, "after_m": 30.0} for day in ("monday", "tuesday")
    ]
    assert rows(9) == [
        {"stage": "detecting", "stream": "front", "reason": "cut", "rows": 3, "runs": 1}
    ]
    assert [(row["route"], row["approaches"]) for row in rows(10)] == [("north", 2)]
