"""The account of a run: every row, frame and reading of all stages, by outcome.

For every topic of every log, and for every input stream of a stage::

    in = used + skipped (by reason) + dropped (by reason)

The manifest contains it as ``account``: *reading* covers the topics of each log, *detecting* the
camera's frames, and *estimating* the inputs of the filters. ``score`` adds *scoring* to
``metrics.json``. Used rows are counted independently by their consumer, so the identity can fail;
that is a bug in crosscue.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, TypeAlias

from pydantic import Field

from crosscue.replay.errors import AccountError
from crosscue.replay.ledger import CHANGED, DIFFERS, NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.ledger import TopicAccount as Counted

from .record import Record

REASONS_SHOWN: Final = 20
DETAILS_SHOWN: Final = 5
# Name for rows whose topic is unknown.
UNATTRIBUTED: Final = ""
_ROWS: Final = {
    "reading": "rows", "detecting": "frames", "estimating": "readings", "scoring": "judgements",
}  # fmt: skip


class Counts(Record):
    """Counts of one stream of a stage: in = used + skipped + dropped."""

    entered: int = Field(validation_alias="in", serialization_alias="in")
    used: int
    skipped: dict[str, int]
    """Number of skipped rows by reason."""
    dropped: dict[str, int]
    """Number of dropped rows by reason."""

    @property
    def unknown(self) -> tuple[str, ...]:
        """Reasons for which an unknown number of rows was dropped."""
        return ()


class Line(Counts):
    """One stream of a stage of one drive."""

    dropped_unknown: tuple[str, ...] = ()
    """Reasons for which an unknown number of rows was dropped."""

    @property
    def unknown(self) -> tuple[str, ...]:
        """The same as ``dropped_unknown``."""
        return self.dropped_unknown


class TopicLine(Line):
    """One topic of a log."""

    declared: int | None
    """Number of rows that the log itself declares; None if it declares none."""
    found: int
    """Number of rows found in its bytes."""


class SummedLine(Counts):
    """One stream of a stage over many drives."""

    runs: int
    runs_with_unknown_drops: int


class LogAccount(Record):
    """Account of every row of one log."""

    log: str
    integrity: str
    is_whole: bool
    notices: tuple[str, ...]
    topics: dict[str, TopicLine]
    """Account by topic; the empty name is for rows whose topic is unknown."""


class Account(Record):
    """The account of one run."""

    reading: tuple[LogAccount, ...]
    detecting: dict[str, Line]
    """Frames by camera."""
    estimating: dict[str, Line]
    """Inputs of the filters by stream."""
    is_whole: bool
    """True if no row was dropped in any stage."""

    def lines(self) -> Iterator[tuple[str, str, Counts]]:
        """Yield stage, name and counts of every stream, in order."""
        for log in self.reading:
            yield from _named("reading", log.topics)
        yield from _named("detecting", self.detecting)
        yield from _named("estimating", self.estimating)


class ScoredAccount(Account):
    """The account of one run that was scored."""

    scoring: dict[str, Line]

    def lines(self) -> Iterator[tuple[str, str, Counts]]:
        """Stage, name and counts of everything, in order."""
        yield from super().lines()
        yield from _named("scoring", self.scoring)


class SummedAccount(Record):
    """Sums of the accounts of many runs."""

    reading: dict[str, SummedLine]
    """Sums by topic."""
    detecting: dict[str, SummedLine]
    estimating: dict[str, SummedLine]
    scoring: dict[str, SummedLine]
    is_whole: bool

    def lines(self) -> Iterator[tuple[str, str, Counts]]:
        """Stage, name and counts of everything, in order."""
        for stage in _ROWS:
            yield from _named(stage, getattr(self, stage))


# Any of the accounts.
HasLines: TypeAlias = Account | SummedAccount


def _named(stage: str, part: Mapping[str, Counts]) -> Iterator[tuple[str, str, Counts]]:
    return ((stage, name, one) for name, one in sorted(part.items()))


def line(
    entered: int,
    used: int,
    skipped: Mapping[str, int],
    dropped: Mapping[str, int] | None = None,
    unknown: Iterable[str] = (),
) -> Line:
    """Return the line of one stream of a stage, without reasons whose count is zero."""
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
    """Return the account of a run after checking it.

    Args:
        reading: ``account_of`` each log.
        detecting: Frames by camera.
        estimating: Inputs of the filters by stream.

    Raises:
        AccountError: The account does not balance.
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
    check_account(made)
    return made


def detecting_of(camera: str, ledger: Ledger, frames: int) -> dict[str, Line]:
    """Return the line of the camera; ``frames`` is the detectors' own count of frames."""
    topic = ledger.topic(camera)
    unknown = sorted(set(topic.dropped_unknown))
    return {camera: line(topic.in_file, frames, topic.skipped, topic.dropped, unknown)}


def check_account(of: HasLines) -> None:
    """Check that in = used + skipped + dropped in every line.

    Raises:
        AccountError: A line does not balance, or a count is negative.
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
    """Return the account of one log."""
    return LogAccount(
        log=ledger.log,
        integrity=ledger.integrity,
        is_whole=ledger.is_whole,
        notices=tuple(ledger.notices),
        topics={name: _topic_line(one) for name, one in sorted(ledger.accounts.items())},
    )


def _topic_line(of: Counted) -> TopicLine:
    unknown = sorted(set(of.dropped_unknown))
    counts = line(of.in_file, of.used, of.skipped, of.dropped, unknown)
    return TopicLine(**dict(counts), declared=of.declared, found=of.found)


def reading_of(ledgers: Iterable[Ledger]) -> list[LogAccount]:
    """Return the accounts of reading after checking each log's ledger.

    Raises:
        AccountError: A ledger does not balance.
    """
    found = []
    for ledger in ledgers:
        ledger.check()
        found.append(account_of(ledger))
    return found


def joined_accounts(
    ours: Sequence[LogAccount], earlier: Sequence[LogAccount], topic: str
) -> list[LogAccount]:
    """Return a stage's accounts, with ``topic`` taken from the earlier stage that read it."""
    logs = {one.log: one for one in earlier}
    return [_joined(one, logs.get(one.log), topic) for one in ours]


def _joined(ours: LogAccount, before: LogAccount | None, topic: str) -> LogAccount:
    if before is None or topic not in before.topics:
        return ours
    topics = {**ours.topics, topic: before.topics[topic]}
    if UNATTRIBUTED not in ours.topics and UNATTRIBUTED in before.topics:
        topics[UNATTRIBUTED] = before.topics[UNATTRIBUTED]
    notices = tuple(dict.fromkeys([*before.notices, *ours.notices]))
    is_whole = ours.is_whole and before.is_whole
    return ours.model_copy(update={"is_whole": is_whole, "notices": notices, "topics": topics})


def sum_accounts(accounts: Iterable[Account | SummedAccount]) -> SummedAccount:
    """Return the sums of the accounts of many runs, topic by topic.

    Raises:
        AccountError: An account does not balance.
    """
    whole = True
    totals: dict[tuple[str, str], SummedLine] = {}
    for one in accounts:
        whole = whole and one.is_whole
        for stage, name, counts in one.lines():
            totals[stage, name] = _plus(totals.get((stage, name), _NONE), counts)

    by_stage: dict[str, dict[str, SummedLine]] = {stage: {} for stage in _ROWS}
    for (stage, name), total in totals.items():
        by_stage[stage][name] = total
    made = SummedAccount(**by_stage, is_whole=whole)
    check_account(made)
    return made


_NONE: Final = SummedLine(
    entered=0, used=0, skipped={}, dropped={}, runs=0, runs_with_unknown_drops=0
)


def _plus(total: SummedLine, counts: Counts) -> SummedLine:
    return SummedLine(
        entered=total.entered + counts.entered,
        used=total.used + counts.used,
        skipped=dict(Counter(total.skipped) + Counter(counts.skipped)),
        dropped=dict(Counter(total.dropped) + Counter(counts.dropped)),
        runs=total.runs + 1,
        runs_with_unknown_drops=total.runs_with_unknown_drops + bool(counts.unknown),
    )


def account_lines(of: HasLines) -> list[str]:
    """Return the account as text: a line for each stage, then a line for each reason."""
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
    shown = [text for _, text in sorted(reasons, key=lambda reason: reason[0])]
    if len(shown) > REASONS_SHOWN:
        shown[REASONS_SHOWN:] = [f"and {len(shown) - REASONS_SHOWN} more reasons: manifest.json"]
    if _has_damaged_logs(of):
        shown.append("to write what can be read: crosscue convert LOG -o OUT.mcap --salvage")
    titles = ["account", *[""] * (len(head) - 1)]
    return [f"{title:9}{text}" for title, text in zip(titles, head, strict=True)] + [
        f"  {text}" for text in shown
    ]


def details_of(ledgers: Iterable[Ledger]) -> list[str]:
    """Return location and reason of the first dropped rows."""
    found = [one for ledger in ledgers for one in ledger.drops() if one.detail]
    shown = [f"dropped  {one.topic or 'rows'}: {one.reason}: {one.detail}" for one in found]
    return shown[:DETAILS_SHOWN]


def _in_words(of: Sequence[Counts], noun: str) -> str:
    entered, used = sum(one.entered for one in of), sum(one.used for one in of)
    skipped = sum(n for one in of for n in one.skipped.values())
    dropped = sum(n for one in of for n in one.dropped.values())
    at_least = "at least " if any(one.unknown for one in of) else ""
    return f"{entered:,} {noun}: {used:,} used, {skipped:,} skipped, {at_least}{dropped:,} dropped"


def _has_damaged_logs(of: HasLines) -> bool:
    """Return whether rows were dropped because a log is damaged.

    Rows that differ from a seal or do not decode do not count.
    """
    reasons: dict[str, set[str]] = {"reading": set(), "detecting": set()}
    for stage, _, one in of.lines():
        if stage in reasons:
            reasons[stage] |= {*one.dropped, *one.unknown}
    return bool(reasons["reading"] - reasons["detecting"] - {DIFFERS, CHANGED})
