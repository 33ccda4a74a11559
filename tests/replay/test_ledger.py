"""Ledger: rows in file = used + skipped + dropped, for any order of events."""

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.replay.errors import AccountError, LossWarning
from crosscue.replay.ledger import (
    DETAILS_KEPT,
    NOT_ASKED_TIME,
    NOT_ASKED_TOPIC,
    Detail,
    Ledger,
    TopicAccount,
    warn_of,
)

NOT_FOUND = "declared by the format, not in its bytes"


def test_loss_of_unknown_size_is_a_loss() -> None:
    ledger = Ledger("log")
    ledger.drop("", "cut", None)

    assert not ledger.is_whole


def test_rows_are_counted_beyond_kept_details() -> None:
    ledger = Ledger("log")
    ledger.find("/t", 2 * DETAILS_KEPT)
    for _ in range(2 * DETAILS_KEPT):
        ledger.skip("/t", "bad")

    assert len(ledger.details) == DETAILS_KEPT
    assert ledger.topic("/t").used == 0


@dataclass
class _Rows:
    topic: str
    rows: int
    first_ns: int = 0
    step_ns: int = 1
    times_ns: tuple[int, ...] = ()

    @property
    def log_ns(self) -> NDArray[np.int64]:
        if self.times_ns:
            return np.array(self.times_ns, np.int64)
        return self.first_ns + self.step_ns * np.arange(self.rows, dtype=np.int64)

    def __len__(self) -> int:
        return self.rows


def _read_through(ledger: Ledger, found: int, yielded: int, skipped: int) -> None:
    def blocks() -> Iterator[_Rows]:
        ledger.find("/t", found)
        ledger.skip("/t", "not selected", skipped)
        yield _Rows("/t", yielded)

    for _ in ledger.handing_on(blocks()):
        ledger.skip("/t", "not decodable", 1)
        ledger.skip_more("/t", "not decodable", 1)
        ledger.spoil("/t", "damaged", 1)


def test_account_is_checked_against_yielded_rows() -> None:
    ledger = Ledger("log")
    _read_through(ledger, found=10, yielded=7, skipped=3)

    ledger.check({"/t": 4})

    account = ledger.topic("/t")
    assert (account.in_file, account.used) == (10, 4)
    assert account.skipped == {"not selected": 3, "not decodable": 2}
    assert account.dropped == {"damaged": 1}
    with pytest.raises(AccountError, match="please report"):
        ledger.check({"/t": 5})


@pytest.mark.parametrize(("found", "yielded", "skipped"), [(11, 7, 3), (10, 8, 3), (10, 7, 2)])
def test_account_that_does_not_add_up_raises(found: int, yielded: int, skipped: int) -> None:
    ledger = Ledger("log")
    _read_through(ledger, found, yielded, skipped)

    with pytest.raises(AccountError, match="does not add up"):
        ledger.check()


class Fate(NamedTuple):
    """Some rows of a topic of a file, and what becomes of them.

    ``hidden`` rows are in a damaged place whose topic is unknown; ``gone`` rows are missing without
    a trace, so that only a declared count shows it.
    """

    topic: str
    becomes: Literal["used", "skipped", "dropped", "spoiled", "hidden", "gone"]
    reason: str
    rows: int


FATES = st.builds(
    Fate,
    st.sampled_from(["/a", "/b", "/c"]),
    st.sampled_from(["used", "skipped", "dropped", "spoiled", "hidden", "gone"]),
    st.sampled_from(["cut", "torn", "burnt"]),
    st.integers(1, 5),
)


def _read(ledger: Ledger, fate: Fate) -> None:
    if fate.becomes in ("used", "skipped", "spoiled"):
        ledger.find(fate.topic, fate.rows)
    if fate.becomes == "skipped":
        ledger.skip(fate.topic, fate.reason, fate.rows)
    elif fate.becomes == "spoiled":
        ledger.spoil(fate.topic, fate.reason, fate.rows)
    elif fate.becomes in ("dropped", "hidden"):
        ledger.drop("" if fate.becomes == "hidden" else fate.topic, fate.reason, fate.rows)


def _total(fates: Sequence[Fate], *becomes: str) -> Counter[str]:
    """Rows by reason."""
    found: Counter[str] = Counter()
    for fate in fates:
        if fate.becomes in becomes:
            found[fate.reason] += fate.rows
    return found


@given(st.lists(FATES, max_size=12), st.sets(st.sampled_from(["/a", "/b", "/c"])))
def test_declared_rows_are_used_skipped_or_dropped_and_each_loss_is_counted_once(
    fates: list[Fate], declaring: set[str]
) -> None:
    ledger = Ledger("log")
    by_topic = {topic: [one for one in fates if one.topic == topic] for topic in declaring}
    for topic, its in by_topic.items():
        ledger.declare(topic, sum(one.rows for one in its))
    for fate in fates:
        _read(ledger, fate)
    for topic in sorted(declaring):
        ledger.settle(topic)

    for topic, its in by_topic.items():
        account = ledger.topic(topic)
        lost = account.dropped.total()
        assert account.declared == account.used + account.skipped.total() + lost
        assert account.used == _total(its, "used").total()
        assert account.skipped == _total(its, "skipped")
    # Rows of unknown topics are attributed as long as a topic lacks rows. What was dropped is then
    # what was taken away: each reason as often as it occurred, and the rest was not found.
    hidden = _total(fates, "hidden")
    lacking = [one for its in by_topic.values() for one in its]
    missing = _total(lacking, "hidden", "gone").total()
    nameless = ledger.topic("").dropped
    assert nameless.total() == max(0, hidden.total() - missing)
    expected = _total(fates, "dropped", "spoiled", "hidden")
    expected[NOT_FOUND] = max(0, missing - hidden.total())
    dropped = sum((account.dropped for account in ledger.accounts.values()), Counter[str]())
    assert dropped == +expected
    for name, account in ledger.accounts.items():
        shown: Counter[str] = Counter()
        for one in ledger.drops():
            shown[one.reason] += (one.count or 0) if one.topic == name else 0
        assert +shown == +account.dropped
    assert not ledger.notices


def test_losses_of_unknown_topics_are_attributed_once_with_place_and_reason() -> None:
    """Of 1 torn and 6 cut rows, /t takes 1 torn and 3 cut ones, and then 2 more cut ones."""
    ledger = Ledger("log")
    ledger.drop("/a", "cut", 2, "in /a")
    ledger.skip("", "cut", 2, "not a loss")
    ledger.drop("", "cut", None, "to the end")
    ledger.drop("", "torn", 1, "at 10", t_ns=10)
    ledger.drop("", "cut", 3, "at 30", t_ns=30)
    ledger.drop("", "cut", 3, "at 60", t_ns=60)
    before = ledger.details[:3]

    assert ledger.claim("/t", 4) == 4
    assert ledger.topic("/t").dropped == {"torn": 1, "cut": 3}
    assert ledger.topic("").dropped == {"cut": 3}
    first = [
        Detail("/t", "torn", "at 10", 10, 1, is_dropped=True),
        Detail("/t", "cut", "at 30", 30, 3, is_dropped=True),
    ]
    assert ledger.details == [*before, *first, Detail("", "cut", "at 60", 60, 3, is_dropped=True)]

    assert ledger.claim("/t", 2) == 2
    assert ledger.topic("/t").dropped == {"torn": 1, "cut": 5}
    assert ledger.topic("").dropped == {"cut": 1}
    assert ledger.details == [
        *before,
        *first,
        Detail("/t", "cut", "at 60", 60, 2, is_dropped=True),
        Detail("", "cut", "at 60", 60, 1, is_dropped=True),
    ]
    assert ledger.claim("/t", 5) == 1
    assert ledger.claim("/t", 4) == 0


def test_declared_rows_of_unknown_topics_are_not_attributed_to_themselves() -> None:
    """Of 3 declared rows 1 was cut, so 2 were not found."""
    ledger = Ledger("log")
    ledger.declare("", 3)
    ledger.drop("", "cut", 1)

    ledger.settle("")

    assert ledger.topic("").dropped == {"cut": 1, NOT_FOUND: 2}


def test_missing_rows_are_stored_with_reason_and_counts() -> None:
    """7 rows are declared and 3 found; 1 is lost elsewhere, so 3 are missing."""
    ledger = Ledger("log")
    ledger.declare("/t", 7)
    ledger.find("/t", 3)
    ledger.drop("", "cut", 1)

    ledger.settle("/t", "no partner")

    assert ledger.details == [
        Detail("/t", "cut", "", None, 1, is_dropped=True),
        Detail("/t", "no partner", "declared 7, found 3", None, 3, is_dropped=True),
    ]
    assert ledger.topic("/t").dropped == {"cut": 1, "no partner": 3}
    assert not ledger.is_whole


def test_surplus_rows_are_reported_with_both_counts() -> None:
    """2 rows are declared, 2 are found and 1 is dropped."""
    ledger = Ledger("log")
    ledger.declare("/t", 2)
    ledger.find("/t", 2)
    ledger.drop("/t", "cut", 1)

    ledger.settle("/t")
    ledger.settle("/t")

    assert ledger.notices == ["/t: the file declares 2 messages, holds 3"]


def test_skips_and_losses_are_stored_with_place_time_and_count() -> None:
    ledger = Ledger("log")
    ledger.find("/t", 20)
    ledger.skip("/t", "bad", 2, "at byte 7", 5)
    ledger.skip("/t", "bad")
    ledger.skip("/t", "bad", 0)
    ledger.skip("/t", NOT_ASKED_TIME, 3)
    ledger.skip("/t", NOT_ASKED_TOPIC, 4)
    ledger.spoil("/t", "torn", 2, "at byte 9", 6)
    ledger.spoil("/t", "torn")
    ledger.drop("/t", "cut", 0)
    ledger.drop("/t", "cut", None, "to the end", 8)

    assert ledger.details == [
        Detail("/t", "bad", "at byte 7", 5, 2, is_dropped=False),
        Detail("/t", "bad", "", None, 1, is_dropped=False),
        Detail("/t", "torn", "at byte 9", 6, 2, is_dropped=True),
        Detail("/t", "torn", "", None, 1, is_dropped=True),
        Detail("/t", "cut", "to the end", 8, None, is_dropped=True),
    ]
    account = ledger.topic("/t")
    assert account.skipped == {"bad": 3, NOT_ASKED_TIME: 3, NOT_ASKED_TOPIC: 4}
    assert account.dropped == {"torn": 3}
    assert account.dropped_unknown == ["cut"]
    assert (account.found, account.used, account.in_file) == (17, 7, 20)
    assert not account.is_whole


@pytest.mark.parametrize(
    ("blocks", "is_reversed"),
    [
        ([_Rows("/t", 4, 100, -1), _Rows("/t", 0), _Rows("/t", 2, 96, -1)], True),
        ([_Rows("/t", 1, 100), _Rows("/t", 1, 99), _Rows("/t", 1, 98)], True),
        ([_Rows("/t", 2, 100, -1)], False),
        ([_Rows("/t", 4, 100, -1), _Rows("/t", 2, 97, -1)], False),
        ([_Rows("/t", 4, 100, -1), _Rows("/t", 2, 96, 1), _Rows("/t", 4, 90, -1)], False),
        ([_Rows("/t", 4, 100, 0)], False),
        # Each row is earlier than the first, and the last one later than the row before.
        ([_Rows("/t", 3, times_ns=(100, 90, 95))], False),
    ],
)
def test_topic_is_reported_if_all_its_times_decrease(
    blocks: list[_Rows], is_reversed: bool
) -> None:
    ledger = Ledger("log")

    assert list(ledger.handing_on(blocks)) == blocks

    rows = sum(map(len, blocks))
    expected = f"/t: every one of its {rows} rows is earlier in log time than the row before"
    assert [one.startswith(expected) for one in ledger.notices] == [True] * is_reversed
    assert ledger.is_whole


def test_rows_of_several_blocks_add_up() -> None:
    ledger = Ledger("log")

    def blocks() -> Iterator[_Rows]:
        for rows in (2, 3):
            ledger.find("/t", rows)
            yield _Rows("/t", rows)

    assert [len(block) for block in ledger.handing_on(blocks())] == [2, 3]
    ledger.check({"/t": 5})
    ledger.topic("/empty")
    ledger.check({"/empty": 0})


@pytest.mark.parametrize(
    "wrong",
    [
        TopicAccount(found=0, skipped=Counter(bad=1), refused=1),
        TopicAccount(found=-1, skipped=Counter(bad=-2), handed_on=1),
    ],
)
def test_account_with_negative_counts_raises(wrong: TopicAccount) -> None:
    ledger = Ledger("a.log")
    ledger.accounts[""] = wrong
    skipped, left = wrong.skipped.total(), wrong.handed_on - wrong.refused

    with pytest.raises(AccountError) as error:
        ledger.check()

    assert str(error.value) == (
        f"a.log: rows of unknown topics: {wrong.found} rows found, {skipped} skipped, {left} used: "
        "this does not add up; it is a bug in crosscue, please report it"
    )


def test_error_names_topic_and_both_counts() -> None:
    ledger = Ledger("a.log")
    ledger.find("/t", 1)
    with pytest.raises(AccountError, match=r"^a.log: /t: 1 rows found, 0 skipped, 0 used: this"):
        ledger.check()
    ledger.topic("/t").handed_on = 1

    with pytest.raises(AccountError) as error:
        ledger.check({"/t": 2})

    assert str(error.value) == (
        "a.log: /t: 1 rows used by the account, 2 by the consumer's count; it is a bug in "
        "crosscue, please report it"
    )


@pytest.mark.parametrize(
    ("topic", "shown"), [(None, [0, 1, 2]), ("/t", [1, 2]), ("/other", [0, 2]), ("/none", [2])]
)
def test_each_loss_of_the_topics_read_is_one_warning(topic: str | None, shown: list[int]) -> None:
    ledger = Ledger("a.log")
    ledger.skip("/t", "not a loss")
    ledger.drop("/other", "late", 1)
    ledger.drop("/t", "cut", 1, "at byte 9")
    ledger.drop("", "torn", None)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of(ledger, topic)

    every = ["a.log: /other: late", "a.log: /t: cut (at byte 9)", "a.log: unknown topics: torn"]
    assert [str(one.message) for one in caught] == [every[number] for number in shown]
    assert {one.category for one in caught} == {LossWarning}
