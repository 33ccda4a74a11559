"""Cross-validate beliefs over layouts, with ablations of cues and rules."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from crosscue.replay.progress import Progress, emit
from crosscue.replay.vehicle.cue_table import groups

from .beliefs import (
    EVERYWHERE,
    KINDS,
    RULES,
    believed,
    believed_everywhere,
    with_fusion,
    with_rules,
)
from .drives import LayoutDrive
from .learning import FoldFits, fit_beliefs, lessons_of
from .score import DriveBelief, LayoutDifference, LayoutScores, score_difference, score_layouts


def score_layout_study(drives: Sequence[LayoutDrive], *, ablation: bool = True) -> LayoutScores:
    """Score the drives of each fold with beliefs fitted to the other folds, then run ablations.

    Args:
        drives: Finished drives.
        ablation: True to also leave out each cue and each rule.
    """
    lessons = lessons_of(drives)
    folds = sorted({one.fold for one in drives})
    learned = {}
    for done, fold in enumerate(folds, 1):
        learned[fold] = fit_beliefs([one for one in drives if one.fold != fold], lessons)
        emit(Progress("learning", done, len(folds), "folds"))

    def of_kind(kind: str) -> list[DriveBelief]:
        return _all(
            drives,
            lambda one: believed(
                one,
                with_fusion(one, learned[one.fold].fusions[kind]),
                learned[one.fold].base_rates,
            ),
            f"scoring {kind}",
        )

    kinds = {kind: of_kind(kind) for kind in KINDS}

    def without(cues: frozenset[str]) -> list[DriveBelief]:
        return [
            believed_everywhere(one, lessons.drives[one.name], learned[one.fold].temporal, cues)
            for one in drives
        ]

    kinds[EVERYWHERE] = without(frozenset())
    cues: dict[str, LayoutDifference] = {}
    for done, (group, some) in enumerate(groups().items() if ablation else (), 1):
        left = without(frozenset(cue.name for cue in some))
        cues[group] = score_difference(kinds[EVERYWHERE], left)
        emit(Progress("leaving out cues", done, len(groups()), "cues"))
    rules = _by_rule(drives, learned) if ablation else {}
    return LayoutScores(
        {kind: score_layouts(some) for kind, some in kinds.items()},
        {
            f"{name} less {kind}": score_difference(kinds[kind], kinds[name])
            for name in ("temporal", EVERYWHERE)
            for kind in KINDS
            if kind != name
        },
        cues,
        {rule: score_layouts(some) for rule, some in rules.items()},
        {rule: score_difference(rules[""], some) for rule, some in rules.items() if rule},
        len(drives),
        len({one.layout for one in drives}),
        {
            fold: (one.temporal.temporal.exponent, one.temporal.temporal.lapse)
            for fold, one in learned.items()
        },
    )


def _by_rule(
    drives: Sequence[LayoutDrive], learned: Mapping[int, FoldFits]
) -> dict[str, list[DriveBelief]]:
    return {
        rule: _all(
            drives,
            lambda one, rule=rule: believed(  # type: ignore[misc]
                one, with_rules(one, rule or None), learned[one.fold].base_rates
            ),
            f"without {rule or 'nothing'}",
        )
        for rule in ("", *RULES)
    }


def _all(
    drives: Sequence[LayoutDrive],
    belief_of: Callable[[LayoutDrive], DriveBelief],
    doing: str,
) -> list[DriveBelief]:
    found = []
    for done, one in enumerate(drives, 1):
        found.append(belief_of(one))
        emit(Progress(doing, done, len(drives), "drives"))
    return found
