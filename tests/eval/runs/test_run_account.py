"""The account of a run: it balances, is printed once, and is the same everywhere."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval import cli
from crosscue.eval.runs.account import (
    Account,
    account,
    account_lines,
    account_of,
    check,
    line,
    summed,
)
from crosscue.eval.runs.folder import create, open_run
from crosscue.eval.runs.tables.skipped import write_skipped
from crosscue.replay.base import DETAILS_KEPT, AccountError, Ledger
from support.manifests import log_account
from support.pictures import picture_folder

BRIGHT = "support.detecting:build"


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """A drive whose log is truncated: its folder, its log and its vehicle file."""
    folder = tmp_path_factory.mktemp("drive")
    files = write_drive(folder / "drive", DriveSettings(seed=3, blocks=1, block_m=60.0))
    content = files.log.read_bytes()
    files.log.write_bytes(content[: len(content) * 4 // 5])
    return folder, files.log, files.vehicle


def _checked_account(run: Path, printed: dict[str, Any]) -> Account:
    """Return the run's account after comparing it with the output and the skipped table."""
    folder = open_run(run)
    found = folder.drive_manifest().account
    check(found)
    assert printed["account"] == found.as_json()
    reported: Counter[tuple[str, str, bool]] = Counter()
    unknown = set()
    for row in folder.table("skipped").to_pylist():
        reported[row["topic"], row["reason"], row["is_dropped"]] += row["count"] or 0
        if row["count"] is None:
            unknown.add((row["topic"], row["reason"]))
    expected: Counter[tuple[str, str, bool]] = Counter()
    for log in found.reading:
        for topic, one in log.topics.items():
            expected.update({(topic, reason, False): n for reason, n in one.skipped.items()})
            expected.update({(topic, reason, True): n for reason, n in one.dropped.items()})
            assert {(topic, reason) for reason in one.dropped_unknown} <= unknown
    assert +reported == +expected
    return found


def test_account_of_truncated_log_balances_for_replay_and_estimate(
    damaged: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, log, vehicle = damaged
    run = tmp_path / "run"
    for argv in (
        ["replay", str(log), "--vehicle", str(vehicle), "-o", str(run), "--json"],
        [
            "replay",
            str(log),
            "--vehicle",
            str(vehicle),
            "-o",
            str(run),
            "--json",
            "--overwrite",
            "--from",
            "1",
            "--to",
            "8",
        ],
        ["estimate", str(run), "--json"],
    ):
        assert cli.run(argv) == 3
        found = _checked_account(run, json.loads(capsys.readouterr().out))
        assert {stage for stage, _, _ in found.lines()} == {"reading", "estimating"}
        assert not found.is_whole
        assert found.estimating["wheel speeds"].used > 0

    assert cli.run(["view", str(run), "-o", str(tmp_path / "x.rrd"), "-q"]) == 3
    assert cli.run(["compare", str(run), str(run), "-q"]) == 3
    assert cli.run(["estimate", str(run)]) == 3
    text = capsys.readouterr().out
    assert text.count("account  ") == 1
    assert sum(one.used for at, _, one in found.lines() if at == "reading") > 0


def test_account_of_undecodable_pictures_balances_for_detect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, run = picture_folder(tmp_path / "cam", 6, "rate_hz: 10\n"), tmp_path / "run"
    pictures = sorted(log.glob("*.png"))
    content = bytearray(pictures[2].read_bytes())
    content[16:24] = (60_000).to_bytes(4, "big") * 2
    content[29:33] = __import__("zlib").crc32(bytes(content[12:29])).to_bytes(4, "big")
    pictures[2].write_bytes(content)
    pictures[4].write_bytes(b"")

    argv = ["detect", str(log), "-o", str(run), "--detectors", BRIGHT, "--no-cache", "--json"]
    assert cli.run(argv) == 3

    found = _checked_account(run, json.loads(capsys.readouterr().out))
    ((name, frames),) = found.detecting.items()
    topics = found.reading[0].topics
    assert (frames.entered, frames.used) == (6, 4)
    assert frames.used == topics[name].used
    assert frames.dropped == topics[name].dropped
    assert sum(frames.dropped.values()) + sum(frames.skipped.values()) == 2


def test_rows_beyond_the_kept_details_are_summed(tmp_path: Path) -> None:
    ledger = Ledger("log")
    ledger.find("/t", 3 * DETAILS_KEPT)
    for _ in range(DETAILS_KEPT + 7):
        ledger.skip("/t", "bad")
    ledger.drop("/t", "cut", 3)
    ledger.drop("", "who knows", None)
    run = create(tmp_path / "run", overwrite=False)
    write_skipped(run, [ledger], [account_of(ledger)])

    rows = run.table("skipped").to_pylist()
    assert sum(row["count"] for row in rows if row["reason"] == "bad") == DETAILS_KEPT + 7
    assert [row["count"] for row in rows if row["reason"] == "cut"] == [3]
    assert [row["count"] for row in rows if row["reason"] == "who knows"] == [None]


def _account() -> Account:
    return account(
        [log_account("a", "/t", used=7, skipped={"dull": 2}, dropped={"cut": 1})],
        {"/cam": line(5, 4, {}, {"not decoded": 1})},
        {"headings": line(9, 6, {"rejected by the gate": 3})},
    )


@pytest.mark.parametrize("stage", ["reading", "detecting", "estimating"])
@pytest.mark.parametrize("by", [-1, 1])
@pytest.mark.parametrize("what", ["entered", "used", "skipped", "dropped"])
def test_unbalanced_account_raises_an_error(stage: str, by: int, what: str) -> None:
    wrong = _account()
    (one,) = [one for at, _, one in wrong.lines() if at == stage]
    if what in ("entered", "used"):
        object.__setattr__(one, what, getattr(one, what) + by)
    else:
        getattr(one, what)["another"] = by

    with pytest.raises(AccountError, match=f"{stage} .*please report"):
        check(wrong)


def test_account_is_complete_only_without_losses_in_every_stage() -> None:
    complete = log_account("a", "/t", used=7, skipped={"dull": 2})
    lost = log_account("a", "/t", used=7, dropped={"cut": 1})

    assert account([complete], {"/cam": line(5, 4, {"dull": 1})}).is_whole
    assert not account([lost], {"/cam": line(5, 5, {})}).is_whole
    assert not account([complete], {"/cam": line(5, 4, {}, {"not decoded": 1})}).is_whole


def test_sum_of_accounts_adds_rows_and_keeps_losses() -> None:
    both = summed([_account(), _account()])

    assert both.reading["/t"].entered == 20
    assert both.reading["/t"].dropped == {"cut": 2}
    assert both.detecting["/cam"].runs == 2
    assert both.estimating["headings"].skipped == {"rejected by the gate": 6}
    assert not both.is_whole


def test_printed_account_has_each_stage_and_reason_once() -> None:
    text = "\n".join(account_lines(_account()))

    for words in (
        "10 rows: 7 used, 2 skipped, 1 dropped",
        "5 frames: 4 used, 0 skipped, 1 dropped",
        "9 readings: 6 used, 3 skipped, 0 dropped",
        "dropped 1 of reading /t: cut",
        "skipped 3 of estimating headings: rejected by the gate",
    ):
        assert text.count(words) == 1
    assert np.all([len(part) <= 100 for part in text.splitlines()])


def test_single_row_beyond_the_kept_details_is_counted(tmp_path: Path) -> None:
    ledger = Ledger("log")
    ledger.find("/t", 3 * DETAILS_KEPT)
    ledger.drop("/t", "cut", 3)
    ledger.drop("/t", "cut", None)
    for _ in range(DETAILS_KEPT - 1):
        ledger.skip("/t", "bad")
    run = create(tmp_path / "run", overwrite=False)

    write_skipped(run, [ledger], [account_of(ledger)])

    rows = run.table("skipped").to_pylist()
    assert sum(row["count"] for row in rows if row["reason"] == "bad") == DETAILS_KEPT - 1
    assert [row["count"] for row in rows if row["reason"] == "cut"] == [3, None]


def test_account_includes_headings_of_the_first_pose(
    damaged: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, log, vehicle = damaged
    text = "\n".join(row for row in vehicle.read_text().splitlines() if "heading_rad" not in row)
    for dbc in vehicle.parent.glob("*.dbc"):
        (tmp_path / dbc.name).write_bytes(dbc.read_bytes())
    (tmp_path / "car.toml").write_text(text)
    run = tmp_path / "run"

    assert (
        cli.run(
            ["replay", str(log), "--vehicle", str(tmp_path / "car.toml"), "-o", str(run), "--json"]
        )
        == 3
    )

    printed = json.loads(capsys.readouterr().out)
    assert any("start heading" in sentence for sentence in printed["notices"])
    headings = _checked_account(run, printed).estimating["headings"]
    assert headings.entered == headings.used + sum(headings.skipped.values())
