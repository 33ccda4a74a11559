"""Effect of leaving out a cue on the scores of drives."""

import math
from collections.abc import Mapping

import pytest

from crosscue.eval.scoring.columns import RunTables
from crosscue.eval.scoring.drives import as_metrics, pool_scores, score_drive
from crosscue.eval.studies.attribution import (
    AttributedDrive,
    attribute,
    attribution_lines,
    attribution_tree,
)
from crosscue.replay.files.tree_text import strict_json
from support.scoring import BELIEF, CUES, belief_table, good_truth, range_table, tables

Beliefs = Mapping[str, Mapping[int, float]]
LATE: Beliefs = {**BELIEF, "right": {33: 0.92}}
NEVER: Beliefs = {"intersection": {}, "left": {}, "right": {}, "straight": {}}


def _tables(belief: Beliefs) -> RunTables:
    return tables(CUES, belief_table(belief), range_table(8, 45, 0.5), frames=50)


def _drive(name: str, by_cue: Mapping[str, Beliefs]) -> AttributedDrive:
    """A drive whose belief changes if one of the given cues is left out."""
    truth = good_truth(name)

    def estimate(cues: frozenset[str], /) -> RunTables:
        changed = [belief for cue, belief in by_cue.items() if cue in cues]
        return _tables(changed[0] if changed else BELIEF)

    return AttributedDrive(score_drive(_tables(BELIEF), truth), truth, estimate)


GROUPS = {
    "parked": ("parked_left", "parked_right"),
    "stop_sign": ("stop_sign",),
    "road": ("road_left",),
}


def test_cue_effect_is_distance_lost_without_it() -> None:
    drives = [_drive(f"d{i}", {"parked_right": LATE, "stop_sign": NEVER}) for i in range(6)]
    found = attribute(drives, GROUPS)

    # The right road is established in frame 25 (15 m) with parked cars, in frame 33 (7 m) without.
    assert found["parked"].full_m.value == pytest.approx(8.0)
    assert found["parked"].full_m.low == pytest.approx(8.0)
    assert found["parked"].measures["approaches.full_m"].without == pytest.approx(7.0)
    assert found["parked"].measures["approaches.full_from_8_m"].without == 0.0
    assert found["parked"].belief["right"].verdict == "first"
    assert found["stop_sign"].detected_only_with == found["stop_sign"].full_only_with == 6
    assert math.isnan(found["stop_sign"].full_m.value)


def test_attribution_is_serialised_and_summary_fits_80_columns() -> None:
    drive = _drive("d", {"stop_sign": NEVER})
    found = attribute([drive], GROUPS)
    metrics = as_metrics(pool_scores([drive.judged])) | {"attribution": attribution_tree(found)}

    assert '"detected_only_with": 1' in strict_json(metrics)
    lines = attribution_lines(found)
    assert max(map(len, lines)) <= 80
    assert len(lines) == len(GROUPS) + 2
