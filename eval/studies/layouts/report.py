"""Write the results of the study of layouts as a page, as JSON and as text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from crosscue.eval.scoring.intervals import TOO_FEW, Mean
from crosscue.eval.studies.page import PageTable, write_study_page
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.versions import versions

from .figure import draw_trade_off
from .score import LayoutDifference, LayoutScore
from .score import LayoutScores as LayoutScores
from .settings import LayoutStudy, Perception

PAGE: Final = "study.html"
FIGURE: Final = "trade_off.png"
TABLES: Final = "study.json"
TITLE: Final = "Random layouts, simulated: fitted on some, tested on the others"
NOTES: Final[dict[Perception, str]] = {
    "pixels": "Everything here is simulated. The embedded networks saw rendered photographs; they "
    "were trained on other layouts of the same renderer. Intervals are 95 %, over layouts.",
    "faults": "Everything here is simulated. No network saw a picture: masks are the renderer's, "
    "with misses, false detections and errors of height drawn from settings that are not measured. "
    "Intervals are 95 %, over layouts.",
}


@dataclass(frozen=True, slots=True)
class LayoutFiles:
    """The written files."""

    page: Path
    tables: Path


def write_layout_study(
    out: Path, settings: LayoutStudy, scores: LayoutScores, failures: Mapping[str, str]
) -> LayoutFiles:
    """Write page and tables to ``out``.

    Raises:
        OutputError: A file cannot be written.
    """
    flags = (
        f"--perception {settings.perception} --blocks {settings.blocks} --runs {settings.runs} "
        f"--folds {settings.folds} --seed {settings.seed} --layouts-from {settings.layouts_from} "
        f"--width {settings.width_px}"
    )
    tree: dict[str, Any] = {
        "is_simulated": True,
        "perception": settings.perception,
        "command": f"crosscue study layouts {flags}",
        "versions": versions(),
        "failures": dict(failures),
        **_without_nan(asdict(scores)),
    }
    write_text(out / TABLES, strict_json(tree) + "\n")
    counts = f"{scores.drives} drives over {scores.layouts} layouts in {settings.folds} folds."
    draw_trade_off(scores.kinds, out / FIGURE)
    write_study_page(
        out / PAGE,
        TITLE,
        [NOTES[settings.perception], counts],
        study_tables(scores),
        [out / FIGURE],
    )
    return LayoutFiles(out / PAGE, out / TABLES)


def study_tables(scores: LayoutScores) -> list[PageTable]:
    """Return all tables, for the page and for a terminal."""
    found = [
        PageTable(
            "Beliefs",
            ("belief", "Brier", "log score", "false a drive", "full", "full, m"),
            tuple(_score_row(kind, one) for kind, one in scores.kinds.items()),
        ),
        PageTable(
            "Fully detected, by false features a drive; each belief with its own threshold",
            ("belief", *(f"{one.wanted:g}" for one in next(iter(scores.kinds.values())).trade)),
            tuple(
                (kind, *(f"{text(p.full, 2)} at {p.threshold:.4g}" for p in one.trade))
                for kind, one in scores.kinds.items()
            ),
        ),
        PageTable(
            "Brier score by feature",
            ("belief", *next(iter(scores.kinds.values())).brier_by_feature),
            tuple(
                (kind, *map(text, one.brier_by_feature.values()))
                for kind, one in scores.kinds.items()
            ),
        ),
        PageTable(
            "Belief over time less others",
            DIFFERENCE_HEAD,
            tuple(_difference_row(kind, one) for kind, one in scores.less.items()),
        ),
        PageTable(
            "Law and coverage, fractions of pictures",
            ("belief", "a way before the intersection", "no approach open"),
            tuple(
                (kind, text(one.full_before_detected), text(one.silent))
                for kind, one in scores.kinds.items()
            ),
        ),
    ]
    if scores.cues:
        found.append(
            PageTable(
                "Each cue left out of the belief over time in every picture, without less with",
                DIFFERENCE_HEAD,
                tuple(_difference_row(cue, one) for cue, one in scores.cues.items()),
            )
        )
    if scores.rules:
        found.append(
            PageTable(
                "Rules for real roads, each left out",
                ("left out", "Brier", "log score", "false a drive", "full", "full, m"),
                tuple(_score_row(rule or "none", one) for rule, one in scores.rules.items()),
            )
        )
        found.append(
            PageTable(
                "Rules for real roads, without less with",
                DIFFERENCE_HEAD,
                tuple(_difference_row(rule, one) for rule, one in scores.rules_less.items()),
            )
        )
    return found


DIFFERENCE_HEAD: Final = ("left out or compared", "Brier", "by it", "log score", "false a drive")


def _score_row(name: str, one: LayoutScore) -> tuple[str, ...]:
    values = (one.brier, one.log_score, one.false_features, one.full)
    return (name, *map(text, values), text(one.full_m, 1))


def _difference_row(name: str, one: LayoutDifference) -> tuple[str, ...]:
    brier, *others = (
        text(value, signed=True) for value in (one.brier, one.log_score, one.false_features)
    )
    return (name, brier, verdict(one.brier), *others)


def verdict(less: Mean) -> str:
    """Return the verdict of a difference: undecided if its interval contains zero or is missing."""
    return "better" if less.high < 0.0 else "worse" if less.low > 0.0 else "undecided"


def text(value: Mean, digits: int = 3, *, signed: bool = False) -> str:
    """Return a mean with its interval as text."""
    if math.isnan(value.value):
        return "-"
    sign = "+" if signed else ""
    shown = f"{value.value:{sign}.{digits}f}"
    if math.isnan(value.low):
        return f"{shown} ({TOO_FEW})"
    return f"{shown} ({value.low:{sign}.{digits}f} to {value.high:{sign}.{digits}f})"


def _without_nan(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {str(key): _without_nan(value) for key, value in tree.items()}
    if isinstance(tree, float) and math.isnan(tree):
        return None
    return tree
