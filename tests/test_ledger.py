"""In file = used + skipped + dropped, whatever happens in whatever order."""

from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.ledger import DETAILS_KEPT, Ledger

_COUNTS = st.integers(0, 1000)


@given(
    found=_COUNTS,
    declared=st.none() | _COUNTS,
    skips=st.lists(st.sampled_from("abc")),
    dropped=_COUNTS,
)
def test_the_identity_holds(
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


def test_fewer_than_declared_is_a_loss_and_more_is_only_said() -> None:
    ledger = Ledger("log")
    for topic, found in (("/few", 3), ("/many", 9)):
        ledger.declare(topic, 5)
        ledger.find(topic, found)
        ledger.settle(topic)

    assert ledger.topic("/few").dropped.total() == 2
    assert ledger.topic("/many").is_whole
    assert any("/many" in sentence for sentence in ledger.notices)


def test_a_loss_nobody_can_count_still_is_a_loss() -> None:
    ledger = Ledger("log")
    ledger.drop("", "cut", None)

    assert not ledger.is_whole


def test_counts_go_on_when_details_stop() -> None:
    ledger = Ledger("log")
    ledger.find("/t", 2 * DETAILS_KEPT)
    for _ in range(2 * DETAILS_KEPT):
        ledger.skip("/t", "bad")

    assert len(ledger.details) == DETAILS_KEPT
    assert ledger.topic("/t").used == 0
