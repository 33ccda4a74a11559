"""Frames of a bus are decoded to tables; only frames of one image are joined."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from math import cos, radians, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.columns import ERROR, LENGTH_UNKNOWN, REMOTE, Block, CanFrames, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.layout import VARIANTS
from crosscue.replay.mobileye.settings import MobileyeSettings
from support.mobileye_frames import MS, frames, join, random_drive, status, triple, values

ORIGIN_MOUNTING = DevicePosition()
DEVICE_FRAME = MobileyeSettings(mounting=ORIGIN_MOUNTING)


def decode(
    blocks: Block | list[Block], how: MobileyeSettings = DEVICE_FRAME
) -> tuple[dict[str, Table], Ledger]:
    """Return all tables of a log and its ledger, after checking that the ledger adds up."""
    blocks = [blocks] if isinstance(blocks, Block) else blocks
    ledger = Ledger("log")
    decoder = MobileyeDecoder("can1", ledger, how)
    decoded_blocks: list[Block] = []
    for block in blocks:
        ledger.find("can1", len(block))
        decoded_blocks += decoder(block)
    decoded_blocks += decoder.flush()
    tables: dict[str, list[Table]] = {}
    for block in decoded_blocks:
        assert isinstance(block.rows, Table)
        tables.setdefault(block.topic.removeprefix("can1/mobileye/"), []).append(block.rows)
    complete = {name: stack(parts) for name, parts in tables.items()}
    assert ledger.topic("can1").used == frames_in(complete)
    return complete, ledger


def stack(parts: list[Table]) -> Table:
    names = list(parts[0].columns)
    assert all(list(part.columns) == names for part in parts)
    return Table({name: np.concatenate([part[name] for part in parts]) for name in names})


def frames_in(tables: dict[str, Table]) -> int:
    """Return the number of frames from which the rows were decoded."""
    weight = {"obstacles": 3, "lanes": 2, "next_lanes": 2}
    return sum(weight.get(name, 1) * len(table) for name, table in tables.items())


def skipped(ledger: Ledger) -> Counter[str]:
    return ledger.topic("can1").skipped


def test_complete_burst_yields_one_row_per_obstacle() -> None:
    sent = [status(2, 40), *triple(0, 7), *triple(1, 9)]
    tables, ledger = decode(frames(sent))

    obstacles = tables["obstacles"]
    assert obstacles["obstacle_id"].tolist() == [7, 9]
    assert obstacles["slot"].tolist() == [0, 1]
    assert obstacles["x_m"].tolist() == [24.0, 24.0]
    assert obstacles["replaced"].tolist() == [True, True]
    assert tables["status"]["count"].tolist() == [2]
    assert not skipped(ledger)
    assert ledger.is_whole


def test_order_of_frames_within_a_burst_does_not_matter() -> None:
    complete = [*triple(0, 7), *triple(1, 9)]
    straight, _ = decode(frames([status(2, 0), *complete]))
    mixed, ledger = decode(frames([status(2, 0), *complete[::-1]]))

    for name in straight["obstacles"].columns:
        np.testing.assert_array_equal(straight["obstacles"][name], mixed["obstacles"][name])
    assert not skipped(ledger)


def test_parts_of_different_slots_are_not_joined() -> None:
    sent = [status(2, 0), triple(0, 7)[0], triple(1, 9)[1], triple(0, 7)[2], status(0, 66)]
    tables, ledger = decode(frames(sent, [0, MS, 2 * MS, 3 * MS, 66 * MS]))

    assert "obstacles" not in tables
    assert skipped(ledger)["incomplete obstacle: A, B or C is missing"] == 3
    assert ledger.topic("can1").dropped.total() == 3


def test_obstacle_split_by_status_frame_is_not_joined() -> None:
    a, b, c = triple(0, 7)
    sent = [status(1, 0), a, status(1, 66), b, c, status(0, 132)]
    tables, ledger = decode(frames(sent, [0, MS, 66 * MS, 67 * MS, 68 * MS, 132 * MS]))

    assert "obstacles" not in tables
    assert skipped(ledger)["incomplete obstacle: A, B or C is missing"] == 3
    assert [d.t_ns for d in ledger.details if not d.is_dropped] == [MS, 67 * MS]
    assert ledger.topic("can1").dropped.total() == 3


def test_truncated_burst_keeps_complete_obstacles_and_reports_others() -> None:
    sent = [status(3, 0), *triple(0, 7), *triple(1, 9)[:2], status(0, 66)]
    times = [0, *range(MS, 6 * MS, MS), 66 * MS]
    tables, ledger = decode(frames(sent, times))

    assert tables["obstacles"]["obstacle_id"].tolist() == [7]
    assert skipped(ledger)["incomplete obstacle: A, B or C is missing"] == 2
    drops = list(ledger.drops())
    assert [(d.count, d.t_ns, d.detail) for d in drops] == [(4, 0, "burst 0")]


def test_log_that_ends_within_a_burst_is_not_damaged() -> None:
    tables, ledger = decode(frames([status(2, 0), *triple(0, 7), triple(1, 9)[0]]))

    assert tables["obstacles"]["obstacle_id"].tolist() == [7]
    assert skipped(ledger)["incomplete obstacle at the end of the log"] == 1
    assert ledger.is_whole
    assert any("ends within an image's burst" in n for n in ledger.notices)


def test_missing_status_frame_does_not_mix_two_images() -> None:
    """Slot 0 is repeated with other content: frames from there on belong to another image."""
    sent = [status(2, 0), *triple(0, 7), *triple(0, 8), *triple(1, 9), status(0, 99)]
    tables, ledger = decode(frames(sent, [*range(0, 10 * MS, MS), 99 * MS]))

    assert tables["obstacles"]["obstacle_id"].tolist() == [7]
    assert skipped(ledger)["slot sent twice: the status frame in between is missing"] == 6


def test_frames_long_after_status_frame_are_skipped() -> None:
    """B and C of one image, the status frame of the next and its A are lost."""
    a, b, c = triple(0, 7)
    sent = [status(1, 0), a, b, c]
    tables, ledger = decode(frames(sent, [0, MS, 67 * MS, 68 * MS]))

    assert "obstacles" not in tables
    assert skipped(ledger)["too long after its status frame"] == 2


def test_repeated_burst_is_used_once() -> None:
    burst = [status(1, 10), *triple(0, 7)]
    tables, ledger = decode(frames([*burst, *burst]))

    assert tables["obstacles"]["obstacle_id"].tolist() == [7]
    assert len(tables["status"]) == 1
    assert skipped(ledger) == {"repeated status frame": 1, "repeated frame": 3}


def test_same_counter_after_a_wrap_is_a_new_image() -> None:
    tables, ledger = decode(frames([status(0, 10), status(0, 10)], [0, 256 * MS]))

    assert len(tables["status"]) == 2
    assert not skipped(ledger)


def test_slots_beyond_the_count_are_skipped() -> None:
    tables, ledger = decode(frames([status(1, 0), *triple(0, 7), *triple(1, 9)]))

    assert tables["obstacles"]["obstacle_id"].tolist() == [7]
    assert skipped(ledger)["slot beyond the count of its status frame"] == 3


def test_obstacles_before_first_status_frame_are_skipped() -> None:
    tables, ledger = decode(frames([*triple(0, 7), status(1, 0), *triple(0, 8)]))

    assert tables["obstacles"]["obstacle_id"].tolist() == [8]
    assert skipped(ledger)["obstacle before the first status frame"] == 3


def test_thirteen_slots_do_not_overlap_vehicle_signals() -> None:
    sent = [status(13, 0), *(f for slot in range(13) for f in triple(slot, slot + 1))]
    sent.append((0x760, "0100480000000000"))
    tables, ledger = decode(frames(sent))

    assert tables["obstacles"]["slot"].tolist() == list(range(13))
    assert values(tables["vehicle"], "speed_mps") == pytest.approx([20.0])
    assert not skipped(ledger)


def test_ids_above_ten_slots_are_not_obstacles() -> None:
    how = MobileyeSettings(slots=10, mounting=ORIGIN_MOUNTING)
    sent = [status(11, 0), *(f for slot in range(11) for f in triple(slot, slot + 1))]
    tables, ledger = decode(frames([*sent, status(0, 66)], [0] * 34 + [66 * MS]), how)

    assert len(tables["obstacles"]) == 10
    assert skipped(ledger)["id not in the Mobileye table"] == 3
    assert ledger.is_whole
    assert any("announces 11 obstacles; there are 10 slots" in n for n in ledger.notices)


def test_frames_without_mobileye_data_are_skipped_by_reason() -> None:
    good = frames([status(0, 0)])
    odd = [
        frames([status(0, 0)], kind=REMOTE),
        frames([status(0, 0)], kind=ERROR),
        frames([status(0, 0)], is_extended=True),
        frames([status(0, 0)], is_fd=True),
        frames([(0x123, "00")]),
        frames([(0x739, "00" * 7)]),
        frames([(0x766, "00" * 4)]),
    ]
    tables, ledger = decode([good, *odd])

    assert len(tables["status"]) == 1
    assert skipped(ledger) == {
        "remote frame": 1,
        "error frame": 1,
        "extended identifier, not a Mobileye's": 1,
        "CAN FD frame, not a Mobileye's": 1,
        "id not in the Mobileye table": 1,
        "length that its Mobileye message does not have": 2,
    }
    assert ledger.details[-1].detail == "0x766 (1)"


def test_unknown_ids_are_not_counted_on_shared_bus() -> None:
    ledger = Ledger("log")
    decoder = MobileyeDecoder("can1", ledger, MobileyeSettings(is_shared_bus=True))
    decoder(frames([(0x123, "00"), (0x739, "00")]))

    assert skipped(ledger) == {"length that its Mobileye message does not have": 1}


def test_rows_that_are_not_can_frames_are_refused() -> None:
    decoder = MobileyeDecoder("can1", Ledger("log"))
    with pytest.raises(ValueError, match="can1: expected CanFrames, got Table"):
        decoder(Block("can1", np.zeros(0, dtype=np.int64), Table({})))


def test_missing_mounting_calibration_is_a_notice() -> None:
    ledger = Ledger("log")
    MobileyeDecoder("can1", ledger)
    assert any("calibrate x_m and y_m" in n for n in ledger.notices)


def test_obstacle_positions_are_relative_to_rear_axle() -> None:
    """The device is 3 m ahead, rotated left by 90 degrees; the obstacle is 24 m ahead of it."""
    sent = [status(1, 0), (0x739, "0180014002003003"), *triple(0, 1)[1:]]
    turned = MobileyeSettings(mounting=DevicePosition(3.0, 0.5, radians(90)))
    tables, _ = decode(frames(sent), turned)

    assert values(tables["obstacles"], "x_m") == pytest.approx([3.0 + 28.0])
    assert values(tables["obstacles"], "y_m") == pytest.approx([0.5 + 24.0])


LEFT_LANE = [(0x766, "A13EFE0A80FF7F0A"), (0x767, "0D80801E")]
RIGHT_LANE = [(0x768, "A13801FF7FFF7F0A"), (0x769, "0D80801E")]


def test_lanes_are_left_positive_after_decoding() -> None:
    """On the bus, both C0 are positive to the right: -1.758 m left, +1.219 m right."""
    tables, ledger = decode(frames([status(0, 0), *LEFT_LANE, *RIGHT_LANE]))

    lanes = tables["lanes"]
    assert lanes["side"].tolist() == [1, -1]
    assert values(lanes, "c0_m") == pytest.approx([1.7578125, -1.21875])
    assert values(lanes, "c1")[0] == pytest.approx(-14 / 1024)
    assert values(lanes, "c2_per_m")[0] == pytest.approx(-11 / 1024000)
    assert lanes["quality"].tolist() == [2, 2]
    assert not skipped(ledger)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.03])
def test_lane_is_transformed_to_vehicle_frame(yaw_rad: float) -> None:
    mounting = DevicePosition(1.7, -0.2, yaw_rad)
    in_device_frame, _ = decode(frames([status(0, 0), *LEFT_LANE]))
    in_vehicle_frame, _ = decode(
        frames([status(0, 0), *LEFT_LANE]), MobileyeSettings(mounting=mounting)
    )

    for x_m in (0.0, 10.0, 30.0):
        y_m = cubic(in_device_frame["lanes"], x_m)
        x_vehicle_m = 1.7 + cos(yaw_rad) * x_m - sin(yaw_rad) * y_m
        y_vehicle_m = -0.2 + sin(yaw_rad) * x_m + cos(yaw_rad) * y_m
        assert cubic(in_vehicle_frame["lanes"], x_vehicle_m) == pytest.approx(y_vehicle_m, abs=1e-5)
    end_m = values(in_vehicle_frame["lanes"], "x_end_m")[0]
    range_m = values(in_device_frame["lanes"], "view_range_m")[0]
    assert end_m == pytest.approx(1.7 + range_m, abs=0.2)


def cubic(lanes: Table, x_m: float) -> float:
    c = [float(values(lanes, name)[0]) for name in ("c0_m", "c1", "c2_per_m", "c3_per_m2")]
    return c[0] + c[1] * x_m + c[2] * x_m**2 + c[3] * x_m**3


def test_lane_without_marking_has_nan_coefficients() -> None:
    default = [(0x766, "0220FEFF7FFF7F00"), (0x767, "FF7F0080")]
    tables, _ = decode(frames([status(0, 0), *default]))

    assert tables["lanes"]["has_marking"].tolist() == [False]
    assert np.isnan(values(tables["lanes"], "c0_m")).all()
    assert np.isnan(values(tables["lanes"], "x_end_m")).all()


def test_next_lanes_alternate_left_and_right_outwards() -> None:
    sent = [
        frame
        for k in range(8)
        for frame in ((0x76C + 2 * k, LEFT_LANE[0][1]), (0x76D + 2 * k, LEFT_LANE[1][1]))
    ]
    tables, _ = decode(frames([status(0, 0), *sent]))

    assert tables["next_lanes"]["side"].tolist() == [1, -1] * 4
    assert tables["next_lanes"]["index"].tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_halves_of_different_lanes_or_images_are_not_joined() -> None:
    a, b = LEFT_LANE
    sent = [status(0, 0), a, status(0, 66), b, RIGHT_LANE[0], b]
    tables, ledger = decode(frames(sent, [0, MS, 66 * MS, 67 * MS, 68 * MS, 69 * MS]))

    assert "lanes" not in tables
    assert skipped(ledger) == {"lane A without its B": 2, "lane B without its A": 2}


def test_lane_details_layout_follows_status_frame() -> None:
    details = (0x737, "0040200C00000000")
    classic, _ = decode(frames([status(0, 0), details]))
    newer, _ = decode(frames([status(0, 0, length=7), details]))
    early, ledger = decode(frames([details, status(0, 0)]))

    assert values(classic["lane_details"], "c2_per_m")[0] == pytest.approx(0x4000 * 3.81e-6)
    assert classic["lane_details"]["guard_rail_left"].tolist() == [-1]
    assert np.isnan(values(newer["lane_details"], "c2_per_m")).all()
    assert newer["lane_details"]["guard_rail_left"].tolist() == [1]
    assert newer["lane_details"]["lane_count"].tolist() == [0]
    assert np.isnan(values(early["lane_details"], "c1")).all()
    assert any("before the first status frame" in n for n in ledger.notices)


def test_configured_revision_skips_status_frames_of_other_revision() -> None:
    how = MobileyeSettings(revision="classic", mounting=ORIGIN_MOUNTING)
    tables, ledger = decode(frames([status(0, 0, length=7)]), how)

    assert tables == {}
    assert skipped(ledger) == {"length that its Mobileye message does not have": 1}


def test_both_revisions_on_one_bus_are_a_notice() -> None:
    blocks = [frames([status(0, 0)]), frames([status(0, 66, length=7)], [66 * MS])]
    tables, ledger = decode(blocks)

    assert [VARIANTS[k] for k in tables["status"]["layout"]] == ["classic", "2.32"]
    assert any("status frames of both revisions" in n for n in ledger.notices)


def test_unknown_protocol_version_is_a_notice() -> None:
    _, ledger = decode(frames([status(0, 0, tail="00F209")]))
    assert any("protocol version 9" in n for n in ledger.notices)


def test_fields_that_depend_on_unknown_length_are_missing() -> None:
    block = frames([status(1, 0), *triple(0, 7)])
    assert isinstance(block.rows, CanFrames)
    block.rows.length[:] = LENGTH_UNKNOWN
    unknown, _ = decode(block)
    reported, _ = decode(block, MobileyeSettings(revision="2.32", mounting=ORIGIN_MOUNTING))

    assert len(unknown["obstacles"]) == 1
    assert unknown["status"]["failsafe"].tolist() == [-1]
    assert reported["status"]["failsafe"].tolist() == [0]


LDW_PAYLOAD = "0000000001000000"
TSR_PAYLOAD = "0000000101000000"
EXTENDED_PAYLOAD = "0000000011000000"


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ([LDW_PAYLOAD], [-1]),
        ([LDW_PAYLOAD, TSR_PAYLOAD, LDW_PAYLOAD], [-1, 0, 0]),
        ([EXTENDED_PAYLOAD, LDW_PAYLOAD], [1, 1]),
        ([TSR_PAYLOAD, EXTENDED_PAYLOAD, LDW_PAYLOAD], [0, -1, -1]),
    ],
)
def test_warning_family_is_inferred_from_unambiguous_bits(
    sent: list[str], expected: list[int]
) -> None:
    tables, ledger = decode(frames([(0x700, text) for text in sent]))

    assert tables["warnings"]["ldw_on"].tolist() == expected
    assert any("0x700" in n for n in ledger.notices) == (-1 in expected)


def test_configured_warning_family_is_used() -> None:
    how = MobileyeSettings(family="tsr", mounting=ORIGIN_MOUNTING)
    tables, ledger = decode(frames([(0x700, LDW_PAYLOAD)]), how)

    assert tables["warnings"]["ldw_on"].tolist() == [0]
    assert ledger.notices == []


def test_obstacles_and_status_have_image_time() -> None:
    sent = [status(1, 0), *triple(0, 7), status(1, 66), *triple(0, 8)]
    times = [1000 * MS, *(1000 * MS + k * MS for k in (1, 2, 3)), 1071 * MS]
    tables, _ = decode(frames(sent, [*times, *(1071 * MS + k * MS for k in (1, 2, 3))]))

    near_ns = 100_000
    assert tables["status"]["t_ns"].tolist() == pytest.approx([1000 * MS, 1066 * MS], abs=near_ns)
    assert tables["status"]["latency_ns"].tolist() == pytest.approx([0, 5 * MS], abs=near_ns)
    assert tables["obstacles"]["t_ns"].tolist() == tables["status"]["t_ns"].tolist()
    assert tables["obstacles"]["status_log_ns"].tolist() == [1000 * MS, 1071 * MS]


@pytest.mark.slow
@given(seed=st.integers(0, 10_000), cuts=st.lists(st.integers(0, 400), max_size=6))
@settings(max_examples=25, deadline=None)
def test_tables_do_not_depend_on_block_division(seed: int, cuts: list[int]) -> None:
    """This also holds for a damaged log, in which frames are missing or repeated."""
    rng = np.random.default_rng(seed)
    drive = random_drive(8, rng)
    index = np.sort(rng.choice(len(drive), size=len(drive), replace=True))
    drive = drive.take(index)
    complete, ledger = decode(drive)
    places = sorted({min(c, len(drive)) for c in cuts})
    parts = [drive.take(np.s_[a:b]) for a, b in pairwise([0, *places, len(drive)])]
    from_parts, ledger_of_parts = decode(parts)

    assert complete.keys() == from_parts.keys()
    for name, table in complete.items():
        for column in table.columns:
            np.testing.assert_array_equal(table[column], from_parts[name][column])
    assert skipped(ledger) == skipped(ledger_of_parts)
    assert ledger.topic("can1").dropped == ledger_of_parts.topic("can1").dropped


@pytest.mark.slow
@given(seed=st.integers(0, 10_000))
@settings(max_examples=25, deadline=None)
def test_lost_frames_never_add_a_row(seed: int) -> None:
    rng = np.random.default_rng(seed)
    drive = random_drive(10, rng)
    complete, _ = decode(drive)
    remaining, ledger = decode(drive.take(rng.random(len(drive)) > 0.2))

    all_obstacles = rows_of(complete.get("obstacles"))
    assert rows_of(remaining.get("obstacles")) <= all_obstacles
    assert rows_of(remaining.get("lanes")) <= rows_of(complete.get("lanes"))
    if len(rows_of(remaining.get("obstacles"))) < len(all_obstacles):
        assert skipped(ledger) or ledger.topic("can1").dropped


@given(seed=st.integers(0, 100_000))
@settings(max_examples=40, deadline=None)
def test_arbitrary_frames_are_accounted_for(seed: int) -> None:
    """Random payloads, lengths, kinds and times with ids of the table and others."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 400))
    ids = rng.choice([0x738, *range(0x739, 0x760), *range(0x766, 0x77C), *range(0x700, 0x731)], n)
    lengths = rng.choice([2, 3, 4, 6, 7, 8, 8, 8, 8], n)
    data = rng.integers(0, 256, (n, 8)) * (np.arange(8) < lengths[:, None])
    steps = rng.choice([0, MS, 70 * MS, -(10**9)], n, p=[0.3, 0.6, 0.08, 0.02])
    rows = CanFrames(
        np.where(rng.random(n) < 0.05, 0x123, ids).astype(np.uint32),
        rng.random(n) < 0.02,
        rng.choice([0, 0, 0, 0, 0, 0, 1, 2], n).astype(np.uint8),
        lengths.astype(np.uint8),
        data.astype(np.uint8),
        rng.random(n) < 0.02,
    )
    cut = n // 2
    block = Block("can1", 10**18 + np.cumsum(steps), rows)
    decode([block.take(np.s_[:cut]), block.take(np.s_[cut:])])  # checks that the ledger adds up


def rows_of(table: Table | None) -> set[tuple[str, ...]]:
    """Return the rows as text, without burst numbers and image times."""
    if table is None:
        return set()
    skip = ("burst", "t_ns")
    names = [name for name in table.columns if name not in skip]
    return set(zip(*([str(v) for v in table[name]] for name in names), strict=True))


def test_empty_blocks_yield_no_tables() -> None:
    tables, ledger = decode([frames([]), join([frames([]), frames([])])])
    assert tables == {}
    assert ledger.notices == []
