"""One account per run: what became of every row, frame and reading, over all stages.

For every topic of every log, and for every stream that a stage takes in::

    in = used + skipped (by reason) + dropped (by reason)

The manifest holds it under ``account``: *reading* has the topics of each log; *detecting* the
camera's frames; *estimating* what the filters take. ``score`` adds *scoring* to ``metrics.json``.
What was used is counted by who used it, so the identity can fail; that is a bug in crosscue.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, Protocol

from pydantic import Field

from crosscue.replay.base import (
    CHANGED,
    DIFFERS,
    NOT_ASKED_TIME,
    NOT_ASKED_TOPIC,
    AccountError,
    Ledger,
)
from crosscue.replay.base import TopicAccount as Counted

from .record import Record

REASONS_SHOWN: Final = 20
DETAILS_SHOWN: Final = 5
UNATTRIBUTED: Final = ""
"""The topic of what no topic can be named for."""
_ROWS: Final = {
    "reading": "rows", "detecting": "frames", "estimating": "readings", "scoring": "judgements",
}  # fmt: skip


class Counts(Record):
    """What became of one stream of a stage: in = used + skipped + dropped."""

    entered: int = Field(validation_alias="in", serialization_alias="in")
    used: int
    skipped: dict[str, int]
    """By reason."""
    dropped: dict[str, int]
    """By reason."""

    @property
    def unknown(self) -> tuple[str, ...]:
        """Reasons for which a number that cannot be known was dropped."""
        return ()


class Line(Counts):
    """One stream of a stage of one drive."""

    dropped_unknown: tuple[str, ...] = ()
    """Reasons for which a number that cannot be known was dropped."""

    @property
    def unknown(self) -> tuple[str, ...]:
        """The same."""
        return self.dropped_unknown


class TopicLine(Line):
    """One topic of a log."""

    declared: int | None
    """What the log itself says it holds."""
    found: int
    """Rows met in its bytes."""


class SummedLine(Counts):
    """One stream of a stage over many drives."""

    runs: int
    runs_with_unknown_drops: int


class LogAccount(Record):
    """What became of every row of one log."""

    log: str
    integrity: str
    is_whole: bool
    notices: tuple[str, ...]
    topics: dict[str, TopicLine]
    """The empty name holds what no topic can be named for."""


class Account(Record):
    """The account of one run."""

    reading: tuple[LogAccount, ...]
    detecting: dict[str, Line]
    """By camera."""
    estimating: dict[str, Line]
    """By stream."""
    is_whole: bool
    """Nothing was dropped in any stage."""

    def lines(self) -> Iterator[tuple[str, str, Counts]]:
        """Stage, name and counts of everything, in order."""
        for log in self.reading:
            yield from _named("reading", log.topics)
        yield from _named("detecting", self.detecting)
        yield from _named("estimating", self.estimating)


class ScoredAccount(Account):
    """The account of one run that was laid beside its truth."""

    scoring: dict[str, Line]

    def lines(self) -> Iterator[tuple[str, str, Counts]]:
        """Stage, name and counts of everything, in order."""
        yield from super().lines()
        yield from _named("scoring", self.scoring)


class SummedAccount(Record):
    """The accounts of many runs added up."""

    reading: dict[str, SummedLine]
    """By topic."""
    detecting: dict[str, SummedLine]
    estimating: dict[str, SummedLine]
    scoring: dict[str, SummedLine]
    is_whole: bool

    def lines(self) -> Iterator[tuple[str, str, Counts]]:
        """Stage, name and counts of everything, in order."""
        yield from _named("reading", self.reading)
        yield from _named("detecting", self.detecting)
        yield from _named("estimating", self.estimating)
        yield from _named("scoring", self.scoring)


class HasLines(Protocol):
    """Any of the accounts."""

    def lines(self) -> Iterator[tuple[str, str, Counts]]:
        """Stage, name and counts of everything, in order."""
        ...


def _named(stage: str, part: Mapping[str, Counts]) -> Iterator[tuple[str, str, Counts]]:
    return ((stage, name, one) for name, one in sorted(part.items()))


def line(
    entered: int,
    used: int,
    skipped: Mapping[str, int],
    dropped: Mapping[str, int] | None = None,
    unknown: Iterable[str] = (),
) -> Line:
    """One stream of a stage; reasons that nothing was left out for are left out."""
    return Line(
        entered=entered,
        used=used,
        skipped={why: n for why, n in sorted(skipped.items()) if n},
        dropped={why: n for why, n in sorted((dropped or {}).items()) if n},
        dropped_unknown=tuple(unknown),
    )


def account(
    reading: Sequence[LogAccount],
    detecting: Mapping[str, Line] | None = None,
    estimating: Mapping[str, Line] | None = None,
) -> Account:
    """The account of a run, checked.

    Args:
        reading: ``account_of`` each log.
        detecting: By camera.
        estimating: By stream.

    Raises:
        AccountError: It does not add up.
    """
    stages = {**(detecting or {}), **(estimating or {})}.values()
    topics = [one for log in reading for one in log.topics.values()]
    made = Account(
        reading=tuple(reading),
        detecting=dict(detecting or {}),
        estimating=dict(estimating or {}),
        is_whole=all(log.is_whole for log in reading)
        and not any(one.dropped or one.unknown for one in (*topics, *stages)),
    )
    check(made)
    return made


def detecting_of(camera: str, ledger: Ledger, frames: int) -> dict[str, Line]:
    """The camera's frames: ``frames`` is what detectors were given, by their own count."""
    topic = ledger.topic(camera)
    unknown = sorted(set(topic.dropped_unknown))
    return {camera: line(topic.in_file, frames, topic.skipped, topic.dropped, unknown)}


def check(of: HasLines) -> None:
    """Hold every line to in = used + skipped + dropped.

    Raises:
        AccountError: One does not add up, or a count is below zero.
    """
    for stage, name, one in of.lines():
        parts = [one.used, *one.skipped.values(), *one.dropped.values()]
        if one.entered != sum(parts) or min(parts) < 0:
            raise AccountError(
                f"{stage} {name or 'rows of unknown topics'}: {one.entered} in, {one.used} used, "
                f"{sum(one.skipped.values())} skipped, {sum(one.dropped.values())} dropped: "
                "this does not add up; it is a bug in crosscue, please report it"
            )


def account_of(ledger: Ledger) -> LogAccount:
    """One log's account."""
    return LogAccount(
        log=ledger.log,
        integrity=ledger.integrity,
        is_whole=ledger.is_whole,
        notices=tuple(ledger.notices),
        topics={name: _topic_line(one) for name, one in sorted(ledger.accounts.items())},
    )


def _topic_line(of: Counted) -> TopicLine:
    return TopicLine(
        declared=of.declared,
        entered=of.in_file,
        found=of.found,
        used=of.used,
        skipped=dict(sorted(of.skipped.items())),
        dropped=dict(sorted(of.dropped.items())),
        dropped_unknown=tuple(sorted(set(of.dropped_unknown))),
    )


def reading_of(ledgers: Iterable[Ledger]) -> list[LogAccount]:
    """The part on reading, each log's ledger checked.

    Raises:
        AccountError: One does not add up.
    """
    found = []
    for ledger in ledgers:
        ledger.check()
        found.append(account_of(ledger))
    return found


def joined_accounts(
    ours: Sequence[LogAccount], earlier: Sequence[LogAccount], topic: str
) -> list[LogAccount]:
    """Accounts of one stage with that of ``topic`` taken from an earlier one, which read it."""
    logs = {one.log: one for one in earlier}
    return [_joined(one, logs.get(one.log), topic) for one in ours]


def _joined(ours: LogAccount, before: LogAccount | None, topic: str) -> LogAccount:
    if before is None or topic not in before.topics:
        return ours
    topics = {**ours.topics, topic: before.topics[topic]}
    if UNATTRIBUTED not in ours.topics and UNATTRIBUTED in before.topics:
        topics[UNATTRIBUTED] = before.topics[UNATTRIBUTED]
    return LogAccount(
        log=ours.log,
        integrity=ours.integrity,
        is_whole=ours.is_whole and before.is_whole,
        notices=tuple(dict.fromkeys([*before.notices, *ours.notices])),
        topics=topics,
    )


def summed(accounts: Iterable[Account | SummedAccount]) -> SummedAccount:
    """The accounts of many runs added up, topic by topic.

    Raises:
        AccountError: One does not add up.
    """
    whole = True
    totals: dict[tuple[str, str], SummedLine] = {}
    for one in accounts:
        whole = whole and one.is_whole
        for stage, name, counts in one.lines():
            totals[stage, name] = _plus(totals.get((stage, name)), counts)

    def of(stage: str) -> dict[str, SummedLine]:
        return {name: total for (at, name), total in totals.items() if at == stage}

    made = SummedAccount(
        reading=of("reading"),
        detecting=of("detecting"),
        estimating=of("estimating"),
        scoring=of("scoring"),
        is_whole=whole,
    )
    check(made)
    return made


def _plus(total: SummedLine | None, counts: Counts) -> SummedLine:
    if total is None:
        total = SummedLine(
            entered=0, used=0, skipped={}, dropped={}, runs=0, runs_with_unknown_drops=0
        )
    return SummedLine(
        entered=total.entered + counts.entered,
        used=total.used + counts.used,
        skipped=dict(Counter(total.skipped) + Counter(counts.skipped)),
        dropped=dict(Counter(total.dropped) + Counter(counts.dropped)),
        runs=total.runs + 1,
        runs_with_unknown_drops=total.runs_with_unknown_drops + bool(counts.unknown),
    )


def account_lines(of: HasLines) -> list[str]:
    """The account for a person: a line for each stage, then what was left out and why."""
    head, reasons = [], []
    for stage, noun in _ROWS.items():
        mine = [one for at, _, one in of.lines() if at == stage]
        if mine:
            head.append(f"{stage:10} {_in_words(mine, noun)}")
    for stage, name, one in of.lines():
        for word, counts in (("skipped", one.skipped), ("dropped", one.dropped)):
            reasons += [
                (word != "dropped", f"{word} {n:,} of {stage} {name or 'unknown topics'}: {why}")
                for why, n in counts.items()
                if why not in (NOT_ASKED_TOPIC, NOT_ASKED_TIME) and stage != "scoring"
            ]
        reasons += [
            (False, f"dropped an unknown number of {stage} {name or 'unknown topics'}: {why}")
            for why in one.unknown
        ]
    said = [text for _, text in sorted(reasons, key=lambda reason: reason[0])]
    if len(said) > REASONS_SHOWN:
        said[REASONS_SHOWN:] = [f"and {len(said) - REASONS_SHOWN} reasons more: manifest.json"]
    if _has_damaged_logs(of):
        said.append("to write what can be read: crosscue convert LOG -o OUT.mcap --salvage")
    titles = ["account", *[""] * (len(head) - 1)]
    return [f"{title:9}{text}" for title, text in zip(titles, head, strict=True)] + [
        f"  {text}" for text in said
    ]


def details_of(ledgers: Iterable[Ledger]) -> list[str]:
    """Where and why the first rows were dropped."""
    found = [one for ledger in ledgers for one in ledger.drops() if one.detail]
    said = [f"dropped  {one.topic or 'rows'}: {one.reason}: {one.detail}" for one in found]
    return said[:DETAILS_SHOWN]


def _in_words(of: Sequence[Counts], noun: str) -> str:
    entered, used = sum(one.entered for one in of), sum(one.used for one in of)
    skipped = sum(n for one in of for n in one.skipped.values())
    dropped = sum(n for one in of for n in one.dropped.values())
    at_least = "at least " if any(one.unknown for one in of) else ""
    return f"{entered:,} {noun}: {used:,} used, {skipped:,} skipped, {at_least}{dropped:,} dropped"


def _has_damaged_logs(of: HasLines) -> bool:
    """Were rows dropped in reading? Those that differ from a seal, or do not decode, were not."""
    reasons: dict[str, set[str]] = {"reading": set(), "detecting": set()}
    for stage, _, one in of.lines():
        if stage in reasons:
            reasons[stage] |= {*one.dropped, *one.unknown}
    return bool(reasons["reading"] - reasons["detecting"] - {DIFFERS, CHANGED})
