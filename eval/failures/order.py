"""Order of failures: by severity, by cause, and with many kinds among the first few."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from .record import Failure


@dataclass(frozen=True, slots=True)
class CauseGroup:
    """Failures with the same kind, subject and cause.

    Attributes:
        kind: Kind of failure.
        what: The feature, cue or range concerned.
        cause: Cause of the failures.
        failures: Number of failures.
        runs: Number of runs with such a failure.
        severity: Severity of the worst failure.
    """

    kind: str
    what: str
    cause: str
    failures: int
    runs: int
    severity: float


def ranked(failures: Sequence[Failure]) -> tuple[Failure, ...]:
    """Return failures with the most severe first, independent of their input order."""
    return tuple(sorted(failures, key=_rank))


def _rank(one: Failure) -> tuple[object, ...]:
    return -one.severity, -one.frames, one.run, one.t_ns, one.kind, one.what, one.level, one.cause


def diverse(failures: Sequence[Failure], top: int) -> tuple[Failure, ...]:
    """Return the worst failure of every group, then the second of every group, and so on.

    Within a group, every run occurs before one occurs again. No group therefore has two among the
    first N before every group has one, and the first N are a prefix of the first N + 1.
    """
    ordered = ranked(failures)
    in_run: Counter[tuple[object, ...]] = Counter()
    turns = []
    for one in ordered:
        turns.append(in_run[*one.group, one.run])
        in_run[*one.group, one.run] += 1
    in_group: Counter[tuple[str, str, str]] = Counter()
    picks = []
    for i in sorted(range(len(ordered)), key=lambda i: (turns[i], i)):
        picks.append((in_group[ordered[i].group], i))
        in_group[ordered[i].group] += 1
    return tuple(ordered[i] for _, i in sorted(picks)[:top])


def cause_groups(failures: Sequence[Failure]) -> tuple[CauseGroup, ...]:
    """Group failures by cause, the largest group first."""
    members: dict[tuple[str, str, str], list[Failure]] = {}
    for one in ranked(failures):
        members.setdefault(one.group, []).append(one)
    groups = [
        CauseGroup(*group, len(some), len({one.run for one in some}), some[0].severity)
        for group, some in members.items()
    ]
    return tuple(sorted(groups, key=lambda g: (-g.failures, -g.severity, g.kind, g.what, g.cause)))
