"""The account of every row of a log.

For every topic, ``in file = used + skipped (by reason) + dropped (by reason)``, where

* *found* rows were identified in the file's bytes by a reader;
* *skipped* rows were found, but not selected or not decodable, each with a reason;
* *used* rows are the found rows that were not skipped;
* *dropped* rows must have been in the file (a declared count, a damaged chunk whose index lists its
  contents, a truncated record), but could not be read.

The extent of some losses is unknown (a truncated file without statistics). Such a loss is recorded
with the count None. The log is then incomplete, and the summary reports "at least".
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from .errors import AccountError
from .losses import warn_of_loss

# Maximum number of skips and losses stored with their details; counts stay exact beyond it.
DETAILS_KEPT: Final = 1000

NOT_ASKED_TIME: Final = "outside --from/--to"
NOT_ASKED_TOPIC: Final = "topic not selected"
OTHER_TYPE: Final = "another message type on the same topic"
DAMAGED_RECORD: Final = "damaged record"
MESSAGE_TOO_LARGE: Final = "message over the size limit"
DIFFERS: Final = "bytes differ from the seal"
CHANGED: Final = "files differ from the seal"


class RowsOfTopic(Protocol):
    """Rows of one topic, as yielded by a reader."""

    @property
    def topic(self) -> str:
        """Topic name."""

    @property
    def log_ns(self) -> NDArray[np.int64]:
        """Log times in stored order."""

    def __len__(self) -> int: ...


# Min rows of a topic whose log times all decrease to report it.
REVERSED_ROWS: Final = 3
_LATEST_NS: Final = (1 << 63) - 1
B = TypeVar("B", bound=RowsOfTopic)


@dataclass(frozen=True, slots=True)
class Detail:
    """One skip or loss, as stored in ``skipped.parquet``.

    Attributes:
        topic: Topic name, or empty where the damage hides it.
        reason: The same short text as in the counts.
        detail: Place and cause: byte offset, declared and found counts, a library's message.
        t_ns: Log time where known.
        count: Number of rows, or None where unknown.
        is_dropped: True if the rows were dropped, False if they were skipped.
    """

    topic: str
    reason: str
    detail: str
    t_ns: int | None
    count: int | None
    is_dropped: bool


@dataclass(slots=True)
class TopicAccount:
    """Row counts of one topic; the module's docstring defines the terms.

    Two counts are independent of the others and serve to check them: ``handed_on``, the rows that
    the reader yielded (see ``Ledger.handing_on``), and ``refused``, those that were skipped or
    spoiled after that.
    """

    declared: int | None = None
    found: int = 0
    skipped: Counter[str] = field(default_factory=Counter)
    dropped: Counter[str] = field(default_factory=Counter)
    dropped_unknown: list[str] = field(default_factory=list)
    handed_on: int = 0
    refused: int = 0

    @property
    def used(self) -> int:
        """Number of rows that were yielded and decoded."""
        return self.found - self.skipped.total()

    @property
    def in_file(self) -> int:
        """Number of rows that are, or must have been, in the file."""
        return self.found + self.dropped.total()

    @property
    def is_whole(self) -> bool:
        """True if no row was dropped; skipped rows do not count as losses."""
        return not self.dropped.total() and not self.dropped_unknown


@dataclass(slots=True)
class Ledger:
    """One log's account, filled by its reader and by the decoders.

    Attributes:
        log: Path as the user wrote it.
        integrity: A sentence on which checksums were verified, or that the format has none.
        accounts: Accounts by topic name; the empty name holds losses of unknown topics.
        details: The first ``DETAILS_KEPT`` skips and losses.
        notices: Sentences about the log that report no loss (no index, clock reset, ...).
    """

    log: str
    integrity: str = "not checked"
    accounts: dict[str, TopicAccount] = field(default_factory=dict)
    details: list[Detail] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    _is_reading: bool = True

    def topic(self, name: str) -> TopicAccount:
        """Return the account of a topic, created on first use."""
        return self.accounts.setdefault(name, TopicAccount())

    def declare(self, topic: str, count: int | None) -> None:
        """Record the number of rows that the file declares for ``topic``."""
        self.topic(topic).declared = count

    def find(self, topic: str, count: int) -> None:
        """Count rows found in the file's bytes."""
        self.topic(topic).found += count

    def skip(
        self, topic: str, reason: str, count: int = 1, detail: str = "", t_ns: int | None = None
    ) -> None:
        """Count rows that were found but are not used.

        Args:
            topic: Topic name.
            reason: Short text, identical for all skips of a kind; numbers belong in ``detail``.
            count: Number of rows.
            detail: Place and cause.
            t_ns: Log time of the first row.
        """
        if count:
            self.skip_more(topic, reason, count)
            if reason not in (NOT_ASKED_TIME, NOT_ASKED_TOPIC):
                self._keep(Detail(topic, reason, detail, t_ns, count, is_dropped=False))

    def skip_more(self, topic: str, reason: str, count: int) -> None:
        """Count more skipped rows for a reason whose detail is already recorded."""
        self.topic(topic).skipped[reason] += count
        self._refuse(topic, count)

    def drop(
        self, topic: str, reason: str, count: int | None, detail: str = "", t_ns: int | None = None
    ) -> None:
        """Count rows of the file that could not be read; ``count`` is None where unknown."""
        if count == 0:
            return
        account = self.topic(topic)
        if count is None:
            account.dropped_unknown.append(reason)
        else:
            account.dropped[reason] += count
        self._keep(Detail(topic, reason, detail, t_ns, count, is_dropped=True))

    def spoil(
        self, topic: str, reason: str, count: int = 1, detail: str = "", t_ns: int | None = None
    ) -> None:
        """Count rows that were found but prove to be damaged: they become dropped rows."""
        self.find(topic, -count)
        self._refuse(topic, count)
        self.drop(topic, reason, count, detail, t_ns)

    def handing_on(self, blocks: Iterable[B]) -> Iterator[B]:
        """Pass a reader's blocks through and count their rows, for ``check``."""
        rest, order = iter(blocks), ReversedTimes()
        while True:
            self._is_reading = True
            block = next(rest, None)
            self._is_reading = False
            if block is None:
                order.report(self)
                return
            self.topic(block.topic).handed_on += len(block)
            order.follow(block)
            yield block

    def check(self, used: Mapping[str, int] | None = None) -> None:
        """Check the account against independent counts, at the end of a complete pass.

        Args:
            used: Number of used rows by topic, as counted by the consumer of the blocks.

        Raises:
            AccountError: The counts do not add up.
        """
        for name, account in self.accounts.items():
            left = account.handed_on - account.refused
            if account.used != left or left < 0 or account.found < 0:
                raise AccountError(
                    f"{self.log}: {name or 'rows of unknown topics'}: {account.found} rows found, "
                    f"{account.skipped.total()} skipped, {left} used: this does not add up; it is "
                    "a bug in crosscue, please report it"
                )
        for name, count in (used or {}).items():
            if self.topic(name).used != count:
                raise AccountError(
                    f"{self.log}: {name}: {self.topic(name).used} rows used by the account, "
                    f"{count} by the consumer's count; it is a bug in crosscue, please report it"
                )

    def _refuse(self, topic: str, count: int) -> None:
        if not self._is_reading:
            self.topic(topic).refused += count

    def notice(self, sentence: str) -> None:
        """Add a notice about the log; a repeated sentence is stored once."""
        if sentence not in self.notices:
            self.notices.append(sentence)

    def settle(self, topic: str, reason: str = "declared by the format, not in its bytes") -> None:
        """Compare the rows found with the declared count, at the end of a complete pass.

        If fewer rows were found, the difference is dropped. If more were found, the bytes take
        precedence and a notice is added.
        """
        account = self.topic(topic)
        if account.declared is None:
            return
        missing = account.declared - account.in_file
        if missing > 0:
            detail = f"declared {account.declared}, found {account.found}"
            self.drop(topic, reason, missing - self.claim(topic, missing), detail)
        elif missing < 0:
            self.notice(
                f"{topic}: the file declares {account.declared} messages, holds {account.in_file}"
            )

    def claim(self, topic: str, missing: int) -> int:
        """Attribute losses of unknown topics to a topic that lacks rows.

        Returns:
            The number of ``missing`` rows attributed this way; they keep their reason and detail.
        """
        nameless, account = self.accounts.get(""), self.topic(topic)
        if nameless is None or nameless is account:
            return 0
        left = missing
        for reason, count in list(nameless.dropped.items()):
            taken = min(count, left)
            left -= taken
            nameless.dropped -= Counter({reason: taken})
            account.dropped += Counter({reason: taken})
            self._rename(reason, topic, taken)
        return missing - left

    def _rename(self, reason: str, topic: str, rows: int) -> None:
        """Set the topic of up to ``rows`` rows in the details of losses without a topic."""
        for i, one in enumerate(self.details):
            if not rows:
                return
            if one.topic or not one.is_dropped or one.reason != reason or one.count is None:
                continue
            taken = min(one.count, rows)
            rows -= taken
            self.details[i] = replace(one, topic=topic, count=taken)
            if one.count > taken:
                self._keep(replace(one, count=one.count - taken))

    @property
    def is_whole(self) -> bool:
        """True if no row is known to be dropped."""
        return all(account.is_whole for account in self.accounts.values())

    def drops(self) -> Iterator[Detail]:
        """Return the details of dropped rows."""
        return (d for d in self.details if d.is_dropped)

    def _keep(self, detail: Detail) -> None:
        if len(self.details) < DETAILS_KEPT:
            self.details.append(detail)


def warn_of(ledger: Ledger, topic: str | None = None) -> None:
    """Issue a ``LossWarning`` for each recorded loss of a log, or of one topic and unknown ones."""
    for drop in ledger.drops():
        if topic is not None and drop.topic not in (topic, ""):
            continue
        detail = f" ({drop.detail})" if drop.detail else ""
        text = f"{ledger.log}: {drop.topic or 'unknown topics'}: {drop.reason}{detail}"
        warn_of_loss(text)


class ReversedTimes:
    """Search for topics whose log times all decrease; a topic is left at its first other step."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[int, int] | None] = {}

    def follow(self, block: RowsOfTopic) -> None:
        """Add the next rows, in stored order."""
        times, topic = block.log_ns, block.topic
        seen = self._seen.get(topic, (0, _LATEST_NS))
        if seen is not None and len(times):
            is_reversed = times[0] < seen[1] and bool((times[1:] < times[:-1]).all())
            self._seen[topic] = (seen[0] + len(times), int(times[-1])) if is_reversed else None

    def report(self, ledger: Ledger) -> None:
        """Add a notice for each topic found."""
        for topic, seen in self._seen.items():
            if seen is not None and seen[0] >= REVERSED_ROWS:
                ledger.notice(
                    f"{topic}: every one of its {seen[0]} rows is earlier in log time than the row "
                    "before; the log may have been written in reverse order"
                )
