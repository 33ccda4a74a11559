"""Comparison of two sets of runs: paired by drive, for any folder names."""

import json
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

import fsspec
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.catalog.many_runs import compare_many
from crosscue.eval.runs.folder import create, write_manifest
from crosscue.eval.scoring.by_drive import DriveMetric, by_drive_table
from support.manifests import estimated
from support.refusals import refusal

RECALL = "cues.stop_sign.recall"
DUSK = "cues.stop_sign.by_condition.dusk.recall"


def scored_runs(folder: Path, right: Sequence[int], first: int = 0) -> list[Path]:
    """Write a run of each drive that found the given number of 20 signs, half at dusk."""
    found = []
    for number, count in enumerate(right, first):
        run = create(folder / f"{folder.name}-{number}", overwrite=False)
        write_manifest(run, estimated())
        (run.path / "score").mkdir()
        parts = [
            DriveMetric(f"drive {number}", RECALL, "mean", float(count), 20),
            DriveMetric(f"drive {number}", DUSK, "mean", float(count // 2), 10),
        ]
        pq.write_table(by_drive_table(iter(parts)), run.path / "score" / "by_drive.parquet")
        found.append(run.path)
    return found


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write runs of eight drives before and after a change that misses signs in each."""
    folder = tmp_path_factory.mktemp("fleet")
    scored_runs(folder / "before", [18, 19, 20, 18, 19, 20, 18, 19])
    scored_runs(folder / "after", [12, 14, 13, 11, 14, 15, 12, 13])
    return folder


QUERIES = ("--runs", "run like 'after/%'", "--against", "run like 'before/%'")


def test_queries_select_the_compared_runs(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junit = tmp_path / "junit.xml"

    assert cli.run(["compare", str(fleet), *QUERIES, "--json", "--junit", str(junit)]) == 1

    found = json.loads(capsys.readouterr().out)
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


def test_markdown_option_prints_a_table(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["compare", str(fleet), *QUERIES, "--markdown", "--tolerance", "0.9"]) == 0

    text = capsys.readouterr().out
    assert "**0 worse, 0 better, 2 undecided**, 0 equal, over 8 drives" in text
    assert cli.run(["compare", str(fleet), *QUERIES, "--markdown"]) == 1
    lines = capsys.readouterr().out.splitlines()
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
