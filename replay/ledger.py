"""The account of what became of every message of a log.

For every topic: ``in file = used + skipped (by reason) + dropped (by reason)``.

* *found*: rows that a reader met in the file's bytes and could tell apart;
* *skipped*: of those, the ones not handed on or not decodable, each with a reason;
* *used*: found less skipped;
* *dropped*: rows that must have been in the file (a declared count, a damaged chunk whose index
  says what it held, a cut record) but could not be read.

A loss whose extent cannot be known (a cut file without statistics) is a ``Loss`` with count None:
the log is then not whole, and the summary says "at least".
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, Protocol, TypeVar

from .errors import AccountError, LossWarning

DETAILS_KEPT: Final = 1000
"""Single skips and losses kept with time and text; counts are exact beyond it."""

NOT_ASKED_TIME: Final = "outside --from/--to"
NOT_ASKED_TOPIC: Final = "topic not asked for"
DIFFERS: Final = "bytes differ from the seal"
CHANGED: Final = "files differ from the seal"


class RowsOfTopic(Protocol):
    """What a reader hands on: rows of one topic."""

    @property
    def topic(self) -> str:
        """Topic name."""
        ...

    def __len__(self) -> int: ...


B = TypeVar("B", bound=RowsOfTopic)


@dataclass(frozen=True, slots=True)
class Detail:
    """One thing skipped or dropped, for ``skipped.parquet``.

    Attributes:
        topic: Topic name, or empty where the damage hides it.
        reason: The same short text as in the counts.
        detail: Where and why: byte offset, declared against found, the library's words.
        t_ns: Log time where known.
        count: Rows concerned; None if that cannot be known.
        is_dropped: Dropped, not merely skipped.
    """

    topic: str
    reason: str
    detail: str
    t_ns: int | None
    count: int | None
    is_dropped: bool


@dataclass(slots=True)
class TopicAccount:
    """Counts of one topic; see the module's text for the terms.

    Two counts are kept apart from the others, so that they can be held against them: the rows that
    the reader really handed on (``Ledger.handing_on``), and those that were skipped or spoiled
    after that.
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
        """Rows handed on and understood."""
        return self.found - self.skipped.total()

    @property
    def in_file(self) -> int:
        """Rows that are or must have been in the file."""
        return self.found + self.dropped.total()

    @property
    def is_whole(self) -> bool:
        """Nothing dropped; skips are choices or bad messages, not losses."""
        return not self.dropped.total() and not self.dropped_unknown


@dataclass(slots=True)
class Ledger:
    """One log's account, filled by its reader and by the decoders.

    Attributes:
        log: Path as the user gave it.
        integrity: In plain words, which checksums were verified, or that the format has none.
        accounts: By topic name; the empty name holds what cannot be attributed.
        details: The first ``DETAILS_KEPT`` single skips and losses.
        notices: Plain sentences about the log that are not a loss (no index, clock reset, ...).
    """

    log: str
    integrity: str = "not checked"
    accounts: dict[str, TopicAccount] = field(default_factory=dict)
    details: list[Detail] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    _is_reading: bool = True

    def topic(self, name: str) -> TopicAccount:
        """The account of ``name``, opened when first asked for."""
        return self.accounts.setdefault(name, TopicAccount())

    def declare(self, topic: str, count: int | None) -> None:
        """What the format itself says it holds of ``topic``."""
        self.topic(topic).declared = count

    def find(self, topic: str, count: int) -> None:
        """``count`` rows met in the bytes."""
        self.topic(topic).found += count

    def skip(
        self, topic: str, reason: str, count: int = 1, detail: str = "", t_ns: int | None = None
    ) -> None:
        """``count`` of the rows found are not used.

        Args:
            topic: Topic name.
            reason: Short and the same for all of a kind; numbers belong in ``detail``.
            count: Rows.
            detail: Where and why.
            t_ns: Log time of the first one.
        """
        if count:
            self.skip_more(topic, reason, count)
            if reason not in (NOT_ASKED_TIME, NOT_ASKED_TOPIC):
                self._keep(Detail(topic, reason, detail, t_ns, count, is_dropped=False))

    def skip_more(self, topic: str, reason: str, count: int) -> None:
        """Count more rows skipped for a reason that has been reported with its detail already."""
        self.topic(topic).skipped[reason] += count
        self._refuse(topic, count)

    def drop(
        self,
        topic: str,
        reason: str,
        count: int | None,
        detail: str = "",
        t_ns: int | None = None,
    ) -> None:
        """Rows of the file that could not be read; ``count`` is None where it is unknown."""
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
        """Of the rows found, ``count`` turn out to be damaged: they are dropped, not skipped."""
        self.find(topic, -count)
        self._refuse(topic, count)
        self.drop(topic, reason, count, detail, t_ns)

    def handing_on(self, blocks: Iterable[B]) -> Iterator[B]:
        """A reader's blocks, their rows counted as they leave it, for ``check``."""
        rest = iter(blocks)
        while True:
            self._is_reading = True
            block = next(rest, None)
            self._is_reading = False
            if block is None:
                return
            self.topic(block.topic).handed_on += len(block)
            yield block

    def check(self, used: Mapping[str, int] | None = None) -> None:
        """Hold the account against what was counted apart from it; at the end of a whole pass.

        Args:
            used: By topic, rows that whoever was handed them has used, by its own count.

        Raises:
            AccountError: Rows have come from nowhere or gone without a word.
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
                    f"{count} by what used them; it is a bug in crosscue, please report it"
                )

    def _refuse(self, topic: str, count: int) -> None:
        if not self._is_reading:
            self.topic(topic).refused += count

    def notice(self, sentence: str) -> None:
        """Say something about the log once; a repeated sentence is kept once."""
        if sentence not in self.notices:
            self.notices.append(sentence)

    def settle(self, topic: str, reason: str = "declared by the format, not in its bytes") -> None:
        """Compare with the declared count at the end of a full pass.

        Fewer found than declared: the rest is dropped. More: a notice; the bytes are the truth.
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
        """Give rows dropped without a name to the topic that lacks rows: they are the same ones.

        Returns:
            How many of the ``missing`` rows have so been dropped with their own reason and place.
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
        """Name the topic of so many ``rows`` among the details of losses without one."""
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
        """Nothing is known to be dropped."""
        return all(account.is_whole for account in self.accounts.values())

    def drops(self) -> Iterator[Detail]:
        """The details that are losses."""
        return (d for d in self.details if d.is_dropped)

    def _keep(self, detail: Detail) -> None:
        if len(self.details) < DETAILS_KEPT:
            self.details.append(detail)


def warn_of(ledger: Ledger) -> None:
    """Warn of all that was dropped from a log."""
    for drop in ledger.drops():
        detail = f" ({drop.detail})" if drop.detail else ""
        text = f"{ledger.log}: {drop.topic or 'unknown topics'}: {drop.reason}{detail}"
        warnings.warn(text, LossWarning, stacklevel=3)
