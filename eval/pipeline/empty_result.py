"""Errors for empty results, with one line on what the log contains instead."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

from crosscue.eval.runs.folder import MANIFEST, RunFolder, clear
from crosscue.replay.base import Log, Selection, name_of
from crosscue.replay.errors import (
    CrosscueError,
    EmptyResultError,
    LogError,
    SchemaError,
    VehicleError,
)
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.kinds import Signal, SignalPlan

TOPICS_SHOWN: Final = 12
ROLES: Final[Mapping[Signal, str]] = {
    Signal.WHEEL_SPEEDS: "wheel speeds",
    Signal.YAW_RATE: "yaw rate",
    Signal.STEERING: "steering",
    Signal.MAGNETIC_FIELD: "compass",
    Signal.HEADING: "heading",
}


def empty_result(what: str, logs: Sequence[Log], selection: Selection) -> CrosscueError:
    """Return the error to raise; the logs are read again to report what they contain.

    It is a ``LogError`` if no row is left because of damage.

    Args:
        what: Description of what found no rows, and where.
        logs: Open logs.
        selection: The requested part of the logs.
    """
    rows: Counter[str] = Counter({topic.name: 0 for log in logs for topic in log.topics})
    first_ns: int | None = None
    last_ns: int | None = None
    damage: list[str] = []
    skipped: Counter[str] = Counter()
    for log in logs:
        ledger = Ledger(name_of(log))
        for block in log.read(ledger):
            if len(block):
                rows[block.topic] += len(block)
                low, high = int(block.log_ns.min()), int(block.log_ns.max())
                first_ns = low if first_ns is None else min(first_ns, low)
                last_ns = high if last_ns is None else max(last_ns, high)
        for account in ledger.accounts.values():
            skipped += account.skipped
        damage += [f"{loss.reason} ({loss.detail})" for loss in ledger.drops()]
    named = [f"{name} ({count:,} rows)" for name, count in rows.most_common(TOPICS_SHOWN)]
    more = f" and {len(rows) - TOPICS_SHOWN} more" if len(rows) > TOPICS_SHOWN else ""
    unusable = "; ".join(f"{count:,} of them: {why}" for why, count in skipped.most_common(3))
    holds = f"{skipped.total():,} rows, none usable ({unusable})" if skipped else "no row at all"
    if first_ns is not None and last_ns is not None:
        seconds = (last_ns - first_ns) * 1e-9
        holds = f"{first_ns}ns to {last_ns}ns ({seconds:.1f} s), topics {', '.join(named)}{more}"
    asked = ""
    if selection.start_ns is not None or selection.end_ns is not None:
        asked = (
            f" from {_or(selection.start_ns, 'the start')} to {_or(selection.end_ns, 'the end')}"
        )
    paths = ", ".join(map(name_of, logs))
    if first_ns is None and damage:
        return LogError(f"{paths}: {damage[0]}, and not one row is left; copy it again")
    return EmptyResultError(
        f"{paths}: {what}{asked}; the log holds {holds}; check --vehicle, --from, --to and --topics"
    )


def _or(time_ns: int | None, word: str) -> str:
    return word if time_ns is None else f"{time_ns}ns"


def silent_roles(planned: SignalPlan, received: Mapping[Signal, int]) -> dict[Signal, str]:
    """Return a sentence for each role whose planned topic had no row."""
    found = {}
    for signal, name in ROLES.items():
        source = planned.source_of(signal)
        if source is not None and not received.get(signal):
            found[signal] = f"the {name}, planned from {source.topic.name}, found no rows"
    return found


@contextmanager
def nothing_left(run: RunFolder) -> Iterator[None]:
    """Remove a run's files if the result is empty, so that the run does not look finished.

    Complete detections are kept if only the settings of the estimate are refused.
    """
    try:
        yield
    except (EmptyResultError, LogError):
        clear(run)
        raise
    except (VehicleError, SchemaError):
        if not run.file(MANIFEST).exists():
            clear(run)
        raise
