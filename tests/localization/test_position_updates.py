"""Tests of pose updates with GNSS positions. The positions are simulated."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from crosscue.localization.fixes import Fixes
from crosscue.localization.pose_track import BothSources, start_belief
from crosscue.localization.position_updates import PositionUpdates
from support.beliefs import joseph

SECOND = 1_000_000_000
LEVER_M = (1.3, -0.4)
COV = np.array([[2.0, 0.3], [0.3, 1.0]])


def fixes(*rows: tuple[int, float, float]) -> Fixes:
    return Fixes(
        np.array([t for t, _, _ in rows], np.int64),
        np.array([[x, y] for _, x, y in rows]),
        np.tile(COV, (len(rows), 1, 1)),
    )


def test_position_update_applies_the_antenna_lever() -> None:
    belief = start_belief(SECOND, 4.0, 5.0, 0.7, 8.0, 1.5, 0.02, 0.5)
    measurements = PositionUpdates(LEVER_M)
    measurements.add(fixes((SECOND, 5.5, 5.2)))
    found = measurements.update(belief, 0.0)
    wanted = joseph(belief, np.array([5.5, 5.2]), COV, LEVER_M)

    assert found is not None
    # The Joseph form is linear in the heading; this one rotates the lever.
    np.testing.assert_allclose(found.mean, wanted.mean, atol=2e-4)
    np.testing.assert_allclose(found.cov, wanted.cov, atol=2e-3)


def test_late_rejected_and_thinned_positions_are_counted() -> None:
    belief = start_belief(SECOND, 0.0, 0.0, 0.0, 0.0, 1.0)
    measurements = PositionUpdates(interval_s=1.0)
    measurements.add(
        fixes((SECOND // 2, 0.0, 0.0), (SECOND, 100.0, 0.0), (SECOND, 0.1, 0.0), (SECOND, 0.1, 0.0))
    )

    assert measurements.update(belief, 0.0) is None
    assert measurements.update(belief, 0.0) is not None
    assert measurements.update(belief, 0.0) is None
    assert asdict(measurements.counts) == {
        "received": 4,
        "accepted": 1,
        "thinned": 1,
        "rejected": 1,
        "late": 1,
    }


@pytest.mark.parametrize("is_second", [False, True])
def test_both_sources_update_at_their_own_times(is_second: bool) -> None:
    belief = start_belief(2 * SECOND, 0.0, 0.0, 0.0, 0.0, 1.0)
    early, due = PositionUpdates(), PositionUpdates()
    early.add(fixes((SECOND, 0.0, 0.0)))
    due.add(fixes((2 * SECOND, 0.1, 0.0)))
    both = BothSources(early, due) if is_second else BothSources(due, early)

    assert both.times_ns() == [SECOND, 2 * SECOND]
    assert both.update(belief, 0.0) is not None
    assert (early.counts.accepted, due.counts.accepted) == (0, 1)
