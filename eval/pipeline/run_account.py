"""One account per run: what became of every row, frame and reading, over all stages.

For every topic of every log, and for every stream that a stage takes in::

    in = used + skipped (by reason) + dropped (by reason)

The manifest holds it under ``account``: *reading* has the topics of each log; *detecting* the
camera's frames; *estimating* what the filters take. ``score`` adds *scoring* to ``metrics.json``.
What was used is counted by who used it, so that the identity can fail; then it is a bug of ours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from crosscue.replay.errors import AccountError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.seal.log import CHANGED, DIFFERS
from crosscue.replay.signals.kinds import Signal

from .accounts import account_of

if TYPE_CHECKING:
    from .pose import PoseStage

STAGES: Final = ("reading", "detecting", "estimating", "scoring")
REASONS_SHOWN: Final = 20
DETAILS_SHOWN: Final = 5
_ROWS: Final = {
    "reading": "rows", "detecting": "frames", "estimating": "readings", "scoring": "judgements",
}  # fmt: skip

Line = dict[str, Any]
"""``in``, ``used``, ``skipped`` and ``dropped`` by reason, reasons in ``dropped_unknown``."""
Account = dict[str, Any]


def line(
    entered: int, used: int, skipped: Mapping[str, int], dropped: Mapping[str, int] | None = None
) -> Line:
    """One stream of a stage; reasons that nothing was left out for are left out."""
    return {
        "in": entered,
        "used": used,
        "skipped": {why: n for why, n in sorted(skipped.items()) if n},
        "dropped": {why: n for why, n in sorted((dropped or {}).items()) if n},
        "dropped_unknown": [],
    }


def account(
    reading: Sequence[Mapping[str, Any]],
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
    made: Account = {
        "reading": list(reading),
        "detecting": dict(detecting or {}),
        "estimating": dict(estimating or {}),
    }
    check(made)
    made["is_whole"] = all(log["is_whole"] for log in reading) and not any(
        _is_dropped(one) for _, _, one in lines(made)
    )
    return made


def detecting_of(camera: str, ledger: Ledger, frames: int) -> dict[str, Line]:
    """The camera's frames: ``frames`` is what detectors were given, by their own count."""
    topic = ledger.topic(camera)
    found = line(topic.in_file, frames, topic.skipped, topic.dropped)
    return {camera: found | {"dropped_unknown": sorted(set(topic.dropped_unknown))}}


def estimating_of(stage: PoseStage, frames: tuple[int, int] | None) -> dict[str, Line]:
    """What the filters took of the readings that reached them.

    Args:
        stage: After its last window.
        frames: Frames detected and frames that cues and belief were estimated for, if any were.
    """
    wheels, track, got = stage.odometry_counts, stage.track_counts, stage.received
    rejected = {
        "not finite": wheels.not_finite,
        "repeated time": wheels.repeated,
        "out of order": wheels.out_of_order,
    }
    found = {
        "wheel speeds": line(
            got[Signal.WHEEL_SPEEDS], wheels.rows - sum(rejected.values()), rejected
        ),
        "headings": line(
            got[Signal.HEADING] + got[Signal.MAGNETIC_FIELD],
            track.headings_accepted + stage.started_with,
            {
                "too soon after the last one used": track.headings_thinned,
                "refused by the gate": track.headings_rejected,
                "earlier than the estimate": track.headings_late,
                "not finite": track.headings_bad,
                "after the last wheel speeds": stage.waiting,
            },
        ),
    }
    if stage.turn is not None:
        found["turn rates"] = line(
            got[stage.turn],
            wheels.turn_rows - wheels.turn_dropped,
            {
                "not finite, repeated or out of order": wheels.turn_dropped,
                "before the first wheel speeds": stage.turn_early,
            },
        )
    if frames is not None:
        found["frames"] = line(*frames, {})
    return {name: one for name, one in found.items() if one["in"]}


def lines(of: Mapping[str, Any]) -> Iterator[tuple[str, str, Line]]:
    """Stage, name and counts of everything in an account, in order."""
    for stage in STAGES:
        part = of.get(stage) or {}
        if isinstance(part, Mapping):
            yield from ((stage, name, one) for name, one in sorted(part.items()))
            continue
        for log in part:
            yield from ((stage, name, one) for name, one in sorted(log["topics"].items()))


def check(of: Mapping[str, Any]) -> None:
    """Hold every line to in = used + skipped + dropped.

    Raises:
        AccountError: One does not add up, or a count is below zero.
    """
    for stage, name, one in lines(of):
        parts = [one["used"], *one["skipped"].values(), *one["dropped"].values()]
        if one["in"] != sum(parts) or min(parts) < 0:
            raise AccountError(
                f"{stage} {name or 'rows of unknown topics'}: {one['in']} in, {one['used']} used, "
                f"{sum(one['skipped'].values())} skipped, {sum(one['dropped'].values())} dropped: "
                "this does not add up; it is a bug in crosscue, please report it"
            )


def is_whole(manifest: Mapping[str, Any]) -> bool:
    """Was nothing dropped in any stage of a run?"""
    return bool(manifest["account"]["is_whole"])


def reading_of(ledgers: Iterable[Ledger]) -> list[dict[str, Any]]:
    """The part on reading, each log's ledger checked.

    Raises:
        AccountError: One does not add up.
    """
    found = []
    for ledger in ledgers:
        ledger.check()
        found.append(account_of(ledger))
    return found


def summed(accounts: Iterable[Mapping[str, Any]]) -> Account:
    """The accounts of many runs added up, topic by topic."""
    whole = True
    totals: dict[str, dict[str, Line]] = {stage: {} for stage in STAGES}
    for one in accounts:
        whole = whole and bool(one["is_whole"])
        for stage, name, counts in lines(one):
            empty: Line = {
                "in": 0,
                "used": 0,
                "skipped": {},
                "dropped": {},
                "runs": 0,
                "runs_with_unknown_drops": 0,
            }
            total = totals[stage].setdefault(name, empty)
            total["runs"] += 1
            total["runs_with_unknown_drops"] += bool(counts["dropped_unknown"])
            for key in ("in", "used"):
                total[key] += counts[key]
            for key in ("skipped", "dropped"):
                total[key] = dict(Counter(total[key]) + Counter(counts[key]))
    check(totals)
    return {**totals, "is_whole": whole}


def account_lines(of: Mapping[str, Any]) -> list[str]:
    """The account for a person: a line for each stage, then what was left out and why."""
    head, reasons = [], []
    for stage in STAGES:
        mine = [one for at, _, one in lines(of) if at == stage]
        if mine:
            head.append(f"{stage:10} {_in_words(mine, _ROWS[stage])}")
    for stage, name, one in lines(of):
        for key in ("skipped", "dropped"):
            reasons += [
                (key != "dropped", f"{key} {n:,} of {stage} {name or 'unknown topics'}: {why}")
                for why, n in one[key].items()
                if why not in (NOT_ASKED_TOPIC, NOT_ASKED_TIME) and stage != "scoring"
            ]
        reasons += [
            (False, f"dropped an unknown number of {stage} {name or 'unknown topics'}: {why}")
            for why in one.get("dropped_unknown", ())
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


def _in_words(of: Sequence[Line], noun: str) -> str:
    entered, used = sum(one["in"] for one in of), sum(one["used"] for one in of)
    skipped = sum(n for one in of for n in one["skipped"].values())
    dropped = sum(n for one in of for n in one["dropped"].values())
    at_least = "at least " if any(one.get("dropped_unknown") for one in of) else ""
    return f"{entered:,} {noun}: {used:,} used, {skipped:,} skipped, {at_least}{dropped:,} dropped"


def _has_damaged_logs(of: Mapping[str, Any]) -> bool:
    """Were rows dropped in reading? Those that differ from a seal, or do not decode, were not."""
    reasons: dict[str, set[str]] = {"reading": set(), "detecting": set()}
    for stage, _, one in lines(of):
        if stage in reasons:
            reasons[stage] |= {*one["dropped"], *one.get("dropped_unknown", ())}
    return bool(reasons["reading"] - reasons["detecting"] - {DIFFERS, CHANGED})


def _is_dropped(one: Mapping[str, Any]) -> bool:
    return bool(one["dropped"] or one["dropped_unknown"])
