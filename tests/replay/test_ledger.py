"""Ledger: rows in file = used + skipped + dropped, for any order of events."""

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.base import DETAILS_KEPT, AccountError, Ledger

_COUNTS = st.integers(0, 1000)


@given(
    found=_COUNTS,
    declared=st.none() | _COUNTS,
    skips=st.lists(st.sampled_from("abc")),
    dropped=_COUNTS,
)
def test_rows_in_file_equal_used_skipped_and_dropped(
    found: int, declared: int | None, skips: list[str], dropped: int
) -> None:
    ledger = Ledger("log")
    ledger.declare("/t", declared)
    ledger.find("/t", found + len(skips))
    for reason in skips:
        ledger.skip("/t", reason)
    ledger.drop("/t", "damaged", dropped)
    ledger.settle("/t")

    account = ledger.topic("/t")
    assert account.in_file == account.used + account.skipped.total() + account.dropped.total()
    assert account.in_file >= (declared or 0)
    assert ledger.is_whole == (account.dropped.total() == 0)


def test_missing_declared_rows_are_a_loss_and_surplus_is_a_notice() -> None:
    ledger = Ledger("log")
    for topic, found in (("/few", 3), ("/many", 9)):
        ledger.declare(topic, 5)
        ledger.find(topic, found)
        ledger.settle(topic)

    assert ledger.topic("/few").dropped.total() == 2
    assert ledger.topic("/many").is_whole
    assert any("/many" in sentence for sentence in ledger.notices)


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


def test_declared_count_causes_one_detail_or_notice_on_mismatch() -> None:
    for declared, missing, notices in ((5, 0, 0), (6, 1, 0), (4, 0, 1)):
        ledger = Ledger("log")
        ledger.declare("/t", declared)
        ledger.find("/t", 5)
        ledger.settle("/t")

        assert ledger.topic("/t").dropped.total() == missing
        assert len(ledger.details) == missing
        assert len(ledger.notices) == notices


def test_dropped_rows_are_not_counted_as_missing() -> None:
    ledger = Ledger("log")
    ledger.declare("/t", 5)
    ledger.find("/t", 3)
    ledger.drop("/t", "damaged", 2)
    ledger.settle("/t")

    assert ledger.topic("/t").dropped == {"damaged": 2}
    assert not ledger.notices
