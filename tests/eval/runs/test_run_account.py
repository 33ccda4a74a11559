"""The account of a run: it balances, is printed once, and is the same everywhere."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval import cli
from crosscue.eval.runs.account import (
    Account,
    LogAccount,
    ScoredAccount,
    SummedAccount,
    TopicLine,
    account,
    account_lines,
    account_of,
    check_account,
    details_of,
    detecting_of,
    joined_accounts,
    line,
    reading_of,
    sum_accounts,
)
from crosscue.eval.runs.folder import create, open_run
from crosscue.eval.runs.tables.skipped import write_skipped
from crosscue.replay.errors import AccountError
from crosscue.replay.ledger import (
    CHANGED,
    DETAILS_KEPT,
    DIFFERS,
    NOT_ASKED_TIME,
    NOT_ASKED_TOPIC,
    Ledger,
)
from support.commands import json_of, output_of
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
    check_account(found)
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
    damaged: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    _, log, vehicle = damaged
    run = tmp_path / ("long_" * 12) / "run"
    run.parent.mkdir()
    for argv in (
        ["replay", str(log), "--vehicle", str(vehicle), "-o", str(run), "--json"],
        f"replay {log} --vehicle {vehicle} -o {run} --json --overwrite --from 1 --to 8".split(),
        ["estimate", str(run), "--json"],
    ):
        found = _checked_account(run, json.loads(output_of(*argv, status=3)))
        assert {stage for stage, _, _ in found.lines()} == {"reading", "estimating"}
        assert not found.is_whole
        assert found.estimating["wheel speeds"].used > 0

    assert cli.run(["view", str(run), "-o", str(tmp_path / "x.rrd"), "-q"]) == 3
    assert cli.run(["compare", str(run), str(run), "-q"]) == 3
    text = output_of("estimate", run, status=3)
    assert text.count("account  ") == 1
    # A path is in one line, however long it is, so that it can be copied.
    assert text.splitlines()[0] == f"run      {run}"
    assert text.splitlines()[1].split()[0] == "pose"
    assert sum(one.used for at, _, one in found.lines() if at == "reading") > 0


def test_account_of_undecodable_pictures_balances_for_detect(tmp_path: Path) -> None:
    log, run = picture_folder(tmp_path / "cam", 6, "rate_hz: 10\n"), tmp_path / "run"
    pictures = sorted(log.glob("*.png"))
    content = bytearray(pictures[2].read_bytes())
    content[16:24] = (60_000).to_bytes(4, "big") * 2
    content[29:33] = __import__("zlib").crc32(bytes(content[12:29])).to_bytes(4, "big")
    pictures[2].write_bytes(content)
    pictures[4].write_bytes(b"")

    argv = ["detect", str(log), "-o", str(run), "--detectors", BRIGHT, "--no-cache", "--json"]
    found = _checked_account(run, json.loads(output_of(*argv, status=3)))
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


@pytest.mark.parametrize("stage", ["reading", "detecting", "estimating"])
@pytest.mark.parametrize("by", [-1, 1])
@pytest.mark.parametrize("what", ["entered", "used", "skipped", "dropped"])
def test_unbalanced_account_raises_an_error(stage: str, by: int, what: str) -> None:
    wrong = account(
        [log_account("a", "/t", used=7, skipped={"dull": 2}, dropped={"cut": 1})],
        {"/cam": line(5, 4, {}, {"not decoded": 1})},
        {"headings": line(9, 6, {"rejected by the gate": 3})},
    )
    (one,) = [one for at, _, one in wrong.lines() if at == stage]
    if what in ("entered", "used"):
        object.__setattr__(one, what, getattr(one, what) + by)
    else:
        getattr(one, what)["another"] = by

    with pytest.raises(AccountError, match=f"{stage} .*please report"):
        check_account(wrong)


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
    damaged: tuple[Path, Path, Path], tmp_path: Path
) -> None:
    _, log, vehicle = damaged
    text = "\n".join(row for row in vehicle.read_text().splitlines() if "heading_rad" not in row)
    for dbc in vehicle.parent.glob("*.dbc"):
        (tmp_path / dbc.name).write_bytes(dbc.read_bytes())
    (tmp_path / "car.toml").write_text(text)
    run = tmp_path / "run"

    printed = json_of("replay", log, "--vehicle", tmp_path / "car.toml", "-o", run, status=3)
    assert any("start heading" in sentence for sentence in printed["notices"])
    headings = _checked_account(run, printed).estimating["headings"]
    assert headings.entered == headings.used + sum(headings.skipped.values())


def _scored(of: Account, **scoring: Any) -> ScoredAccount:
    return ScoredAccount(
        reading=of.reading,
        detecting=of.detecting,
        estimating=of.estimating,
        is_whole=of.is_whole,
        scoring=scoring,
    )


def _ledger() -> Ledger:
    """11 rows of /b: 5 used, 2 skipped, 4 dropped; and an unknown number of unknown topics."""
    ledger = Ledger("b.log", integrity="checked")
    ledger.declare("/b", 11)
    ledger.find("/b", 7)
    ledger.topic("/b").handed_on = 5
    ledger.skip("/b", "dull", 1)
    ledger.skip("/b", "bad", 1, "at byte 5")
    ledger.drop("/b", "torn", 1, "at byte 7")
    ledger.drop("/b", "cut", 3)
    ledger.drop("", "who knows", None, "to the end")
    ledger.drop("", "who knows", None, "and again")
    ledger.drop("", "lost", None)
    ledger.notice("no index")
    return ledger


def test_lines_of_an_account_are_in_the_order_of_stages_and_names() -> None:
    """Each stage has its own streams, sorted; sums have the same lines."""
    first = log_account("a", "/t", used=7)
    both = LogAccount(
        log="a",
        integrity="x",
        is_whole=True,
        notices=(),
        topics={"/z": first.topics["/t"], "/a": first.topics["/t"]},
    )
    made = _scored(
        account([both], {"/cam": line(1, 1, {})}, {"x": line(2, 2, {})}), y=line(3, 3, {})
    )
    expected = [
        ("reading", "/a", 7),
        ("reading", "/z", 7),
        ("detecting", "/cam", 1),
        ("estimating", "x", 2),
        ("scoring", "y", 3),
    ]

    assert [(stage, name, one.used) for stage, name, one in made.lines()] == expected
    total = sum_accounts([made, made])
    assert [(stage, name, one.used) for stage, name, one in total.lines()] == [
        (stage, name, 2 * used) for stage, name, used in expected
    ]


def test_line_leaves_out_zero_counts_and_sorts_reasons() -> None:
    made = line(9, 2, {"z": 1, "a": 2, "none": 0}, {"y": 3, "b": 1, "none": 0}, ["cut"])

    assert list(made.skipped.items()) == [("a", 2), ("z", 1)]
    assert list(made.dropped.items()) == [("b", 1), ("y", 3)]
    assert made.unknown == ("cut",)
    assert (made.entered, made.used) == (9, 2)
    assert line(2, 2, {}).dropped == {}


def test_account_of_a_log_has_every_count_of_its_ledger() -> None:
    (made,) = reading_of([_ledger()])

    assert (made.log, made.integrity, made.is_whole) == ("b.log", "checked", False)
    assert made.notices == ("no index",)
    assert list(made.topics) == ["", "/b"]
    known = made.topics["/b"]
    assert (known.declared, known.found, known.entered, known.used) == (11, 7, 11, 5)
    assert list(known.skipped.items()) == [("bad", 1), ("dull", 1)]
    assert list(known.dropped.items()) == [("cut", 3), ("torn", 1)]
    assert made.topics[""].dropped_unknown == ("lost", "who knows")
    assert made.topics[""].declared is None


def test_account_of_an_unbalanced_ledger_raises() -> None:
    ledger = _ledger()
    ledger.topic("/b").found += 1

    with pytest.raises(AccountError, match="8 rows found"):
        reading_of([ledger])


def test_frames_are_compared_with_the_detectors_count() -> None:
    """11 frames: 5 used, 2 skipped, 4 dropped; the detectors counted 5."""
    ledger = _ledger()
    ledger.drop("/b", "cut", None)
    ledger.drop("/b", "cut", None)

    assert detecting_of("/b", ledger, 5) == {
        "/b": line(11, 5, {"dull": 1, "bad": 1}, {"torn": 1, "cut": 3}, ["cut"])
    }
    with pytest.raises(AccountError, match="detecting /b: 11 in, 6 used, 2 skipped, 4 dropped"):
        account([], detecting_of("/b", ledger, 6))


def test_account_is_whole_only_without_losses_in_every_stage() -> None:
    complete = log_account("a", "/t", used=7, skipped={"dull": 2})

    assert account([complete], {"/cam": line(5, 4, {"dull": 1})}).is_whole
    assert not account([log_account("a", "/t", used=7, dropped={"cut": 1})]).is_whole
    assert not account([complete], {"/cam": line(5, 4, {}, {"not decoded": 1})}).is_whole
    assert not account([complete], {"/cam": line(5, 5, {}, {}, ["cut"])}).is_whole
    assert not account([complete], None, {"x": line(5, 4, {}, {"cut": 1})}).is_whole
    lost = complete.model_copy(update={"is_whole": False})
    assert not account([lost]).is_whole


def test_error_names_stage_and_counts() -> None:
    """3 in, but 1 used + 1 skipped + 2 dropped = 4; then -1 used, although the sum is right."""
    made = _scored(account([]), **{"": line(3, 1, {"dull": 1}, {"cut": 2})})

    with pytest.raises(AccountError) as error:
        check_account(made)

    assert str(error.value) == (
        "scoring rows of unknown topics: 3 in, 1 used, 1 skipped, 2 dropped: this does not add up; "
        "it is a bug in crosscue, please report it"
    )
    with pytest.raises(AccountError, match="scoring x: 0 in, -1 used"):
        check_account(_scored(account([]), x=line(0, -1, {"dull": 1})))
    check_account(_scored(account([]), x=line(0, 0, {})))


def _topic(used: int) -> TopicLine:
    return log_account("", "/t", used=used).topics["/t"]


def _log(log: str, *, whole: bool, notices: tuple[str, ...], **topics: TopicLine) -> LogAccount:
    return LogAccount(log=log, integrity=log, is_whole=whole, notices=notices, topics=topics)


def test_topic_of_an_earlier_stage_is_taken_from_it() -> None:
    """Stage 2 read "fix" (2 rows) after stage 1 read "cam" (9 rows) and 4 rows of no topic."""
    ours = _log("a", whole=True, notices=("two", "both"), fix=_topic(2), cam=_topic(1))
    before = _log("a", whole=True, notices=("one", "both"), fix=_topic(5), cam=_topic(9))
    before.topics[""] = _topic(4)

    (made,) = joined_accounts([ours], [_log("b", whole=False, notices=()), before], "cam")

    assert (made.log, made.integrity, made.is_whole) == ("a", "a", True)
    assert made.notices == ("one", "both", "two")
    assert made.topics == {"fix": _topic(2), "cam": _topic(9), "": _topic(4)}
    ours.topics[""] = _topic(3)
    (made,) = joined_accounts([ours], [before], "cam")
    assert made.topics[""] == _topic(3)
    del before.topics[""], ours.topics[""]
    assert "" not in joined_accounts([ours], [before], "cam")[0].topics


@pytest.mark.parametrize(("ours", "before"), [(True, False), (False, True)])
def test_joined_log_is_whole_only_if_both_are(ours: bool, before: bool) -> None:
    (made,) = joined_accounts(
        [_log("a", whole=ours, notices=())],
        [_log("a", whole=before, notices=(), cam=_topic(1))],
        "cam",
    )

    assert not made.is_whole


@pytest.mark.parametrize(
    "earlier",
    [
        [],
        [_log("b", whole=False, notices=("one",), cam=_topic(1))],
        [_log("a", whole=False, notices=("one",), fix=_topic(1))],
    ],
)
def test_log_without_the_topic_before_is_unchanged(earlier: list[LogAccount]) -> None:
    ours = _log("a", whole=True, notices=("two",), fix=_topic(2))

    assert joined_accounts([ours], earlier, "cam") == [ours]


def test_sum_counts_runs_and_those_with_unknown_losses() -> None:
    """Two of three runs lost an unknown number: 3 runs, 2 of them unknown, 14 frames."""
    unknown = account([], {"/cam": line(6, 4, {"dull": 1}, {"cut": 1}, ["cut", "torn"])})
    whole = account([], {"/cam": line(2, 2, {})})

    total = sum_accounts([unknown, whole, unknown]).detecting["/cam"]

    assert (total.entered, total.used) == (14, 10)
    assert (total.skipped, total.dropped) == ({"dull": 2}, {"cut": 2})
    assert (total.runs, total.runs_with_unknown_drops) == (3, 2)
    assert total.unknown == ()
    assert sum_accounts([whole, whole]).is_whole
    assert not sum_accounts([unknown, whole]).is_whole
    assert not sum_accounts([whole, unknown]).is_whole


def test_sum_that_does_not_balance_raises() -> None:
    with pytest.raises(AccountError, match="scoring x: 2 in, 1 used"):
        sum_accounts([_scored(account([]), x=line(2, 1, {}))])
    assert isinstance(sum_accounts([]), SummedAccount)
    assert sum_accounts([]).is_whole


def test_printed_account_lists_losses_first_and_rows_that_were_not_selected_never() -> None:
    """Rows: 1,000 used + 4 skipped + 2,001 dropped = 3,005, and more of unknown topics."""
    log = log_account(
        "a",
        "/z",
        used=1000,
        skipped={"dull": 2, NOT_ASKED_TIME: 1, NOT_ASKED_TOPIC: 1},
        dropped={"cut": 2001},
    )
    log.topics[""] = account_of(_ledger()).topics[""]
    made = account([log], {"/cam": line(2, 1, {}, {"bent": 1})}, {"a": line(3, 2, {"gate": 1})})

    assert account_lines(_scored(made, cue=line(4, 3, {"no truth": 1}))) == [
        "account  reading    3,005 rows: 1,000 used, 4 skipped, at least 2,001 dropped",
        "         detecting  2 frames: 1 used, 0 skipped, 1 dropped",
        "         estimating 3 readings: 2 used, 1 skipped, 0 dropped",
        "         scoring    4 judgements: 3 used, 1 skipped, 0 dropped",
        "  dropped an unknown number of reading unknown topics: lost",
        "  dropped an unknown number of reading unknown topics: who knows",
        "  dropped 2,001 of reading /z: cut",
        "  dropped 1 of detecting /cam: bent",
        "  skipped 2 of reading /z: dull",
        "  skipped 1 of estimating a: gate",
        "  to write what can be read: crosscue convert LOG -o OUT.mcap --salvage",
    ]


def test_unknown_losses_are_printed_with_the_topic_or_as_unknown_topics() -> None:
    made = account([], {"": line(2, 1, {"dull": 1}), "/cam": line(0, 0, {}, {}, ["cut"])})

    assert account_lines(made)[1:] == [
        "  dropped an unknown number of detecting /cam: cut",
        "  skipped 1 of detecting unknown topics: dull",
    ]


@pytest.mark.parametrize(
    ("reasons", "more"), [(20, []), (21, ["  and 1 more reasons: manifest.json"])]
)
def test_printed_account_has_at_most_twenty_reasons(reasons: int, more: list[str]) -> None:
    skipped = {f"reason {n:02}": 1 for n in range(reasons)}

    shown = account_lines(account([], {"/cam": line(reasons, 0, skipped)}))

    assert shown[1:] == [
        *(f"  skipped 1 of detecting /cam: reason {n:02}" for n in range(20)),
        *more,
    ]


@pytest.mark.parametrize(
    ("rows", "frames", "is_damaged"),
    [
        ({"cut": 1, DIFFERS: 1}, {}, True),
        ({DIFFERS: 1, CHANGED: 1}, {}, False),
        ({"not decoded": 1}, {"not decoded": 1}, False),
        ({}, {"not decoded": 1}, False),
    ],
)
def test_salvage_is_suggested_only_for_damaged_logs(
    rows: dict[str, int], frames: dict[str, int], is_damaged: bool
) -> None:
    """Rows that differ from a seal, or whose picture does not decode, cannot be salvaged.

    The other log and the other camera, without losses, are read afterwards.
    """
    logs = [log_account("a", "/a", used=1, dropped=rows), log_account("b", "/b", used=1)]
    cameras = {"/a": line(1 + len(frames), 1, {}, frames), "/b": line(1, 1, {})}

    assert any("--salvage" in text for text in account_lines(account(logs, cameras))) == is_damaged


def test_unknown_loss_of_a_log_suggests_salvage() -> None:
    assert any("--salvage" in text for text in account_lines(account([account_of(_ledger())])))


def test_first_five_losses_are_shown_with_their_place() -> None:
    ledger = Ledger("log")
    for n in range(5):
        ledger.drop("/t", "cut", 1, f"at byte {n}")

    assert details_of([_ledger(), ledger]) == [
        "dropped  /b: torn: at byte 7",
        "dropped  rows: who knows: to the end",
        "dropped  rows: who knows: and again",
        "dropped  /t: cut: at byte 0",
        "dropped  /t: cut: at byte 1",
    ]
