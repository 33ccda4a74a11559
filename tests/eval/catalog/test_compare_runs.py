"""``crosscue compare`` of two runs or of two sets of runs."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import fsspec
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.catalog.compare import compare_runs, open_scored, read_tolerance
from crosscue.eval.catalog.many_runs import compare_many
from crosscue.eval.runs.account import Account, line
from crosscue.eval.runs.folder import create, open_run, write_manifest
from crosscue.eval.scoring.by_drive import DriveMetric, by_drive_table
from crosscue.replay.errors import UsageError
from crosscue.replay.vehicle.fusion import Fusion
from crosscue.replay.vehicle.vehicle import Vehicle
from support.catalog_runs import scored_run
from support.commands import json_of, output_of
from support.manifests import estimated
from support.refusals import refusal
from support.scoring import (
    BELIEF,
    CUES,
    belief_table,
    cue_table,
    frame_table,
    range_table,
    run_folder,
    truth_folder,
)

WORSE_CUES = {**CUES, "stop_sign": {frame: int(frame >= 3) for frame in range(40)}}


def _pair(
    tmp_path: Path, *, scored: bool = True, drives: int = 1, places: int = 6
) -> tuple[Path, Path]:
    """Good drives, and the same drives with seven false stop signs each."""
    false_signs = {
        "frames": frame_table(50),
        "cues": cue_table(WORSE_CUES),
        "belief": belief_table(BELIEF),
        "range": range_table(8, 45, 0.5),
    }
    runs: dict[str, list[str]] = {"a": [], "b": []}
    for number in range(drives):
        folder = tmp_path / str(number)
        truth_folder(folder, place=f"place {number % places}")
        (folder / "drive.mcap").write_text(f"drive {number}")
        for name, tables, established in (("a", None, 0.9), ("b", false_signs, 0.3)):
            settings = Vehicle(version=1, fusion=Fusion(established=established))
            run = run_folder(folder / name, tables, settings=settings)
            runs[name].append(str(run.path))
    if not scored:
        return Path(runs["a"][0]), Path(runs["b"][0])
    for name, paths in runs.items():
        to = ["-o", str(tmp_path / f"scores-{name}")] if drives > 1 else []
        assert cli.run(["score", *paths, *to, "-q", "--without-figures"]) == 0
    if drives == 1:
        return Path(runs["a"][0]), Path(runs["b"][0])
    return tmp_path / "scores-a", tmp_path / "scores-b"


@pytest.mark.slow
def test_drives_of_one_place_count_once(tmp_path: Path) -> None:
    good, worse = _pair(tmp_path, drives=6, places=2)

    found = json_of("compare", good, worse)
    (one,) = (one for one in found["judged"] if one["path"] == "cues.stop_sign.precision")
    assert (one["verdict"], one["drives"], one["places"]) == ("too few places", 6, 2)
    assert one["more_places"] == 4


@pytest.mark.slow
def test_difference_in_every_drive_is_decided(tmp_path: Path) -> None:
    good, worse = _pair(tmp_path, drives=6)

    text = output_of("compare", good, worse, status=1)
    assert "WORSE      cues.stop_sign.precision: 1 -> 0.945946" in text
    assert "better     cues.stop_sign.recall: 0.857143 -> 1" in text
    assert "drives     6 in both runs" in text
    # The recall is better, so the reversed comparison finds it worse.
    found = json_of("compare", worse, good, status=1)
    assert (found["worse"], found["better"]) == (
        ["cues.stop_sign.recall"],
        ["cues.stop_sign.precision"],
    )
    # A tolerance is the allowed loss of a metric; the last one that matches applies.
    narrow = ["10%", "cues.stop_*=0.01"]
    for tolerances, status in ((["10%"], 0), (["0.01"], 1), (narrow, 1), (narrow[::-1], 0)):
        argv = ["compare", str(good), str(worse), "-q", "--tolerance", *tolerances]
        assert cli.run(argv) == status


def test_drives_of_only_one_run_are_counted_and_left_out(tmp_path: Path) -> None:
    good, worse = _pair(tmp_path, drives=3)
    one = tmp_path / "1" / "b"

    text = output_of("compare", good, one)
    assert "drives     1 in both runs; 2 only in the first, 0 only in the second" in text
    assert "not a run folder" in refusal(4, "compare", good, tmp_path)
    assert worse.exists()


@pytest.mark.parametrize("text", ["", "a", "-1", "nan", "1e999", "x=%", "5%%"])
def test_invalid_tolerance_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"expected 0\.01"):
        read_tolerance(text)


def test_tables_of_different_rows_or_columns_report_the_difference(tmp_path: Path) -> None:
    good, worse = _pair(tmp_path, scored=False)
    pq.write_table(frame_table(49), worse / "frames.parquet")
    pq.write_table(cue_table(CUES).drop_columns(["count"]), worse / "cues.parquet")
    (worse / "range.parquet").unlink()
    nan = belief_table({**BELIEF, "left": {20: float("nan")}})
    pq.write_table(nan, worse / "belief.parquet")
    pq.write_table(nan, good / "belief.parquet")

    found = {one.name: one for one in compare_runs(open_run(good), open_run(worse)).tables}
    # A number that is missing in both is not a difference.
    assert set(found) == {"cues", "frames", "range"}
    assert found["frames"].what == "different number of rows"
    assert found["cues"].what == "different columns: count int64 and nothing"
    assert found["range"].what == "only in the first run"


@pytest.mark.parametrize("lossy", ["a", "b"])
def test_losses_in_either_run_exit_3(tmp_path: Path, lossy: str) -> None:
    lost = Account(
        reading=(), detecting={"/cam": line(5, 4, {}, {"cut": 1})}, estimating={}, is_whole=False
    )
    for name in ("a", "b"):
        changes: dict[str, Any] = {"account": lost} if name == lossy else {}
        run_folder(tmp_path / name, None, **changes)

    assert cli.run(["compare", str(tmp_path / "a"), str(tmp_path / "b"), "-q"]) == 3


def test_control_characters_in_names_are_not_printed(tmp_path: Path) -> None:
    runs = [
        run_folder(
            tmp_path / name,
            {"t": pa.table({"\x1b[2J": [value]})},
            versions={"\x1b]0;x\x07": f"\x1b[31m{value}"},
        )
        for name, value in (("a", 1), ("b", 2))
    ]

    assert "\x1b" not in output_of("compare", *(str(run.path) for run in runs), status=1)


def test_metrics_of_unpaired_drives_are_not_compared(tmp_path: Path) -> None:
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        drives = {name: {"distance_m": 8.0}, "both": {"distance_m": float(name == "a")}}
        (folder / "metrics.json").write_text(json.dumps({"pose": {"by_drive": drives}}))
        pq.write_table(by_drive_table(iter([])), folder / "by_drive.parquet")

    found = compare_runs(open_scored(tmp_path / "a"), open_scored(tmp_path / "b"))

    assert [one.path for one in found.metrics] == ["pose.by_drive.both.distance_m"]


def test_damaged_scores_are_reported(tmp_path: Path) -> None:
    good, worse = _pair(tmp_path)
    for text in ("{", "[]", "[" * 100_000):
        (worse / "score" / "metrics.json").write_text(text)
        assert "run crosscue score again" in refusal(4, "compare", good, worse)


RECALL = "cues.stop_sign.recall"
DUSK = "cues.stop_sign.by_condition.dusk.recall"


def scored_runs(folder: Path, right: Sequence[int], first: int = 0) -> list[Path]:
    """Write a run of each drive that found the given number of 20 signs, half at dusk."""
    found = []
    for number, count in enumerate(right, first):
        parts = [
            DriveMetric(f"drive {number}", RECALL, "mean", float(count), 20),
            DriveMetric(f"drive {number}", DUSK, "mean", float(count // 2), 10),
        ]
        found.append(scored_run(folder / f"{folder.name}-{number}", parts).path)
    return found


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write runs of eight drives before and after a change that misses signs in each."""
    folder = tmp_path_factory.mktemp("fleet")
    scored_runs(folder / "before", [18, 19, 20, 18, 19, 20, 18, 19])
    scored_runs(folder / "after", [12, 14, 13, 11, 14, 15, 12, 13])
    return folder


QUERIES = ("--runs", "run like 'after/%'", "--against", "run like 'before/%'")


def test_queries_select_the_compared_runs(fleet: Path, tmp_path: Path) -> None:
    junit = tmp_path / "junit.xml"

    found = json_of("compare", fleet, *QUERIES, "--junit", junit, status=1)
    assert found["worse"] == [RECALL, DUSK]
    assert found["drives"] == [8, 0, 0]
    root = ET.fromstring(junit.read_text())
    assert (root.get("tests"), root.get("failures")) == ("2", "2")
    turned = [QUERIES[0], QUERIES[3], QUERIES[2], QUERIES[1]]
    assert cli.run(["compare", str(fleet), *turned, "-q"]) == 0


def test_remote_runs_compare_like_local_runs(
    fleet: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    fsspec.filesystem("memory").put(f"{fleet}/", "/compared/", recursive=True)
    queries = QUERIES[1], QUERIES[3]

    remote = crosscue.compare_many(*queries, "memory://compared")
    local = crosscue.compare_many(*queries, fleet)

    assert {one.path: one for one in remote.judged} == {one.path: one for one in local.judged}
    assert {*remote.worse} == {RECALL, DUSK}
    assert remote.drives == local.drives == (8, 0, 0)
    with pytest.raises(crosscue.UsageError, match="memory://compared: runs on a store; copy them"):
        crosscue.failures("memory://compared")
    with pytest.raises(crosscue.UsageError, match="use --runs and --against, or copy it"):
        crosscue.compare_runs("memory://compared/before", "memory://compared/after")


def test_markdown_option_prints_a_table(fleet: Path) -> None:
    text = output_of("compare", fleet, *QUERIES, "--markdown", "--tolerance", "0.9")
    assert "**0 worse, 0 better, 2 undecided**, 0 equal, over 8 drives" in text
    lines = output_of("compare", fleet, *QUERIES, "--markdown", status=1).splitlines()
    assert "**2 worse, 0 better, 0 undecided**" in lines[0]
    assert any(line.startswith(f"| `{RECALL}` | 0.9437 | 0.65 |") for line in lines)
    assert all(line.count("|") == 7 for line in lines if line.startswith("|"))


def test_unpaired_drives_and_unscored_runs_are_reported(tmp_path: Path, fleet: Path) -> None:
    before = sorted((fleet / "before").iterdir())
    after = scored_runs(tmp_path / "after", [19] * 7, first=4)
    bare = create(tmp_path / "bare", overwrite=False)
    write_manifest(bare, estimated())

    found = compare_many(before, [*after, bare.path, tmp_path / "gone"])

    assert found.drives == (4, 4, 3)
    assert [reason.partition(";")[0] for reason in found.left_out.values()] == [
        "not scored, or by an earlier version",
        f"{tmp_path / 'gone'}: no manifest.json: not a run folder, or its run was cut short",
    ]
    assert not found.is_whole
    assert found.is_passed


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (("--runs", "true"), 2, "expected one folder with both --runs and --against"),
        (("other", *QUERIES), 2, "expected one folder with both"),
        ((), 2, "expected two runs, or --runs and --against"),
        (("--runs", "nam = 'a'", "--against", "true"), 2, "name"),
        (("--runs", "false", "--against", "true"), 2, "runs of one drive"),
        (("--runs", "false", "--against", "run like 'before/%'"), 4, "selects no run"),
    ],
)
def test_invalid_queries_are_refused_in_one_line(
    fleet: Path, words: tuple[str, ...], status: int, message: str
) -> None:
    assert message in refusal(status, "compare", fleet, *words)
