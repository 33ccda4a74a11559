"""The scored study, as its tables and figures take it."""

from __future__ import annotations

from dataclasses import dataclass

from crosscue.eval.scoring.drives import Scores
from crosscue.eval.scoring.runs import RunScored
from crosscue.eval.scoring.scene.belief import BeliefDifference
from crosscue.eval.studies.attribution import Attribution


@dataclass(frozen=True, slots=True)
class StudyScores:
    """The scored study.

    Attributes:
        scored: Every drive beside its truth.
        scores: All together.
        worth: What each of the nine cues was worth; empty where that was not asked.
        calibrated: All again, each intersection with messages learned at the others; None where
            there are too few.
        difference: Calibrated less source, by feature.
    """

    scored: tuple[RunScored, ...]
    scores: Scores
    worth: dict[str, Attribution]
    calibrated: Scores | None
    difference: dict[str, BeliefDifference]
