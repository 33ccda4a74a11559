"""Properties of approaches that hold for any evidence."""

import itertools
import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.fusion.approaches import Approaches, Step
from crosscue.fusion.evidence import FrameEvidence, SignRange
from crosscue.fusion.factor_graph import graph_of
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.fusion import Calibrated, Fusion, RangeFilter, Rates
from support.fusion import SECOND_NS, other_side

SOURCE = Fusion()
CALIBRATED = Fusion(
    kind="calibrated",
    calibrated=Calibrated(
        rates=tuple(
            Rates(cue=name, feature=feature, near=near, if_there=0.6, if_not=0.1)
            for name, cue in SOURCE.cues.items()
            for feature in cue.supports
            for near in (False, True)
        )
    ),
)
KINDS = pytest.mark.parametrize("fusion", [SOURCE, CALIBRATED], ids=["source", "calibrated"])
FEW_EXAMPLES = settings(max_examples=40, deadline=None)

number = st.floats(-20.0, 20.0) | st.sampled_from([math.nan, math.inf, -math.inf, 1e300, 0.0])
signs = st.builds(SignRange, st.sampled_from(Reference), number | st.floats(0.0, 160.0), number)
evidence = st.builds(
    FrameEvidence,
    st.integers(0, 400).map(lambda i: i * SECOND_NS // 10),
    st.none() | number,
    number,
    st.lists(signs, max_size=3).map(tuple),
    st.dictionaries(st.sampled_from([*CUES]), st.integers(0, 4)),
    is_new_picture=st.booleans(),
    turned_rad=st.none() | number,
)
drives = st.lists(evidence, max_size=40)
in_order = drives.map(lambda some: sorted(some, key=lambda one: one.t_ns))


def run(drive: list[FrameEvidence], fusion: Fusion) -> tuple[list[Step], Approaches]:
    loop = Approaches(graph_of(fusion), fusion, RangeFilter())
    return [loop(one) for one in drive], loop


@KINDS
@FEW_EXAMPLES
@given(drives)
def test_probabilities_and_ranges_are_always_valid(
    fusion: Fusion, drive: list[FrameEvidence]
) -> None:
    for step in run(drive, fusion)[0]:
        assert all(0.0 < p < 1.0 for p in step.probabilities.values())
        assert all(math.isfinite(row.range_m) and row.var_m2 > 0.0 for row in step.ranges)
        assert bool(step.probabilities) == (step.approach is not None)


@KINDS
@FEW_EXAMPLES
@given(drives)
def test_every_frame_and_approach_is_accounted_for(
    fusion: Fusion, drive: list[FrameEvidence]
) -> None:
    steps, loop = run(drive, fusion)
    loop.finish()
    counts = loop.counts

    closed = sum(n for what, n in counts.items() if what.startswith("approaches closed"))
    assert closed == counts["approaches opened"]
    refused = sum(n for what, n in counts.items() if what.startswith("evidence refused"))
    latest = list(itertools.accumulate((one.t_ns for one in drive), max))
    assert len(drive) - refused == len(set(latest))
    numbers = [step.approach for step in steps if step.approach is not None]
    assert sorted(set(numbers)) == list(range(1, counts["approaches opened"] + 1))
    assert numbers == sorted(numbers)


@KINDS
@FEW_EXAMPLES
@given(in_order)
def test_shifting_all_timestamps_does_not_change_results(
    fusion: Fusion, drive: list[FrameEvidence]
) -> None:
    later = [replace(one, t_ns=one.t_ns + 1_700_000_000 * SECOND_NS) for one in drive]

    now, then = run(drive, fusion)[0], run(later, fusion)[0]

    assert [replace(step, t_ns=0) for step in now] == [replace(step, t_ns=0) for step in then]


def mirrored(one: FrameEvidence) -> FrameEvidence:
    counts = {other_side(cue): n for cue, n in one.counts.items()}
    turned_rad = None if one.turned_rad is None else -one.turned_rad
    return replace(one, counts=counts, turned_rad=turned_rad)


@KINDS
@FEW_EXAMPLES
@given(in_order)
def test_mirrored_drive_swaps_left_and_right(fusion: Fusion, drive: list[FrameEvidence]) -> None:
    steps = run(drive, fusion)[0]
    in_mirror = run([mirrored(one) for one in drive], fusion)[0]

    for step, other in zip(steps, in_mirror, strict=True):
        assert step.approach == other.approach
        assert step.ranges == other.ranges
        swapped = {other_side(name): p for name, p in step.probabilities.items()}
        assert swapped == pytest.approx(dict(other.probabilities), rel=1e-9)


@KINDS
@FEW_EXAMPLES
@given(in_order)
def test_duplicate_frames_do_not_change_results(fusion: Fusion, drive: list[FrameEvidence]) -> None:
    single = list({one.t_ns: one for one in drive}.values())
    doubled = [one for one in single for _ in range(2)]

    assert run(doubled, fusion)[0][::2] == run(single, fusion)[0]
