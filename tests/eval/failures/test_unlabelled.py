"""Moments that look wrong without truth: what the run claims against what else it knows."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

import crosscue
from crosscue.eval.failures.record import Failure
from crosscue.eval.failures.unlabelled import suspects
from crosscue.eval.runs.folder import RunFolder
from support.commands import output_of
from support.refusals import refusal
from support.scene_run import detections, poses
from support.scoring import at, belief_table, cue_table, frame_table, range_table, run_folder

FRAMES = 50


def _found(first: int, end: int) -> dict[int, int]:
    """Return the counts of a cue that is found in a half-open range of frames."""
    return {frame: int(first <= frame < end) for frame in range(FRAMES)}


def _run(folder: Path, *given: Any, **more: Any) -> list[Failure]:
    return suspects(_folder(folder, *given, **more))


def _folder(
    folder: Path,
    cues: Mapping[str, Mapping[int, int]],
    speed_mps: Sequence[float] = (10.0,) * FRAMES,
    belief: Mapping[str, Mapping[int, float]] | None = None,
    **more: pa.Table,
) -> RunFolder:
    counts, track = cue_table(cues), poses(FRAMES)
    speed = track.schema.get_field_index("speed_mps")
    # Cues of a run are numbered by its own approaches.
    number = pa.array([7] * len(counts), pa.int64())
    tables = {
        "frames": frame_table(FRAMES),
        "cues": counts.set_column(1, "approach", number),
        "belief": belief_table({"intersection": {10: 0.95}} if belief is None else belief),
        "range": range_table(8, 45),
        "pose": track.set_column(speed, track.schema.field(speed), pa.array(speed_mps)),
        **more,
    }
    return run_folder(folder / "run", tables)


def _kinds(found: Sequence[Failure]) -> list[tuple[str, str]]:
    return [(one.what, one.cause) for one in found]


def test_sign_without_slowing_is_suspect(tmp_path: Path) -> None:
    braking = [10.0] * 20 + [4.0] * 30
    sign = {"stop_sign": _found(10, 30)}

    (one,) = _run(tmp_path / "a", sign)

    assert (one.kind, one.what, one.cause) == ("suspect", "stop_sign", "the car did not slow down")
    assert (one.frames, one.approach, one.t_ns) == (20, 7, at(20))
    assert _run(tmp_path / "b", sign, braking) == []


def test_stop_without_a_reason_is_suspect(tmp_path: Path) -> None:
    stopping = [10.0] * 10 + [0.0] * 30 + [5.0] * 10

    (one,) = _run(tmp_path / "a", {}, stopping)

    assert (one.what, one.cause) == ("stop", "stopped, and nothing explains it")
    assert (one.start_ns, one.end_ns) == (at(10), at(39))
    assert _run(tmp_path / "b", {"stop_sign": _found(2, 8)}, stopping) == []


def test_cue_against_the_final_belief_is_suspect(tmp_path: Path) -> None:
    cues = {"road_left": _found(5, 10)}

    (one,) = _run(tmp_path / "a", cues, belief={"left": {20: 0.03125}})

    assert (one.what, one.cause) == ("road_left", "the belief ends against it")
    assert one.severity == pytest.approx(5.0)
    assert _run(tmp_path / "b", cues, belief={"left": {20: 0.95}}) == []


BRIEF = "for a frame or two only"


@pytest.mark.parametrize(
    ("cues", "speed_mps", "found"),
    [
        (
            {"stop_sign": (5, 40), "traffic_light": (12, 17)},
            [10.0] * 20 + [1.0] * 30,
            [("traffic_light", "stop sign excludes it")],
        ),
        (
            {"cross_traffic_left": (20, 21), "road_right": (30, 31)},
            [10.0] * FRAMES,
            [("cross_traffic_left", BRIEF)],
        ),
        # A sign ranks above a car.
        (
            {"cross_traffic_left": (20, 21), "one_way_left": (30, 31)},
            [10.0] * FRAMES,
            [("one_way_left", BRIEF), ("cross_traffic_left", BRIEF)],
        ),
    ],
)
def test_cue_that_another_excludes_or_that_is_brief_is_suspect(
    cues: dict[str, tuple[int, int]],
    speed_mps: list[float],
    found: list[tuple[str, str]],
    tmp_path: Path,
) -> None:
    counts = {name: _found(*part) for name, part in cues.items()}

    assert _kinds(_run(tmp_path, counts, speed_mps)) == found


def test_road_that_a_sign_closes_contradicts_nothing(tmp_path: Path) -> None:
    """The road to the left is seen, and the belief ends at 0 because of the sign."""
    cues = {"road_left": _found(10, 20), "one_way_right": _found(10, 40)}
    belief = {"intersection": {10: 0.95}, "left": {10: 0.5, 40: 0.0}}

    assert ("road_left", "the belief ends against it") not in _kinds(
        _run(tmp_path / "closed", cues, belief=belief)
    )
    assert "road_left" not in {one.what for one in _run(tmp_path / "again", cues)}
    del cues["one_way_right"]
    assert ("road_left", "the belief ends against it") in _kinds(
        _run(tmp_path / "open", cues, belief=belief)
    )


def test_box_that_one_of_two_detectors_has_is_suspect(tmp_path: Path) -> None:
    one = detections().to_pylist()
    cars = [row for row in one if row["label"] == "car"]
    others = [dict(row, detector="second") for row in cars[:30]]
    table = pa.Table.from_pylist([*cars, *others], schema=detections().schema)

    found = _run(tmp_path, {}, detections=table)

    assert _kinds(found) == [("car", "detectors disagree")]
    assert (found[0].start_ns, found[0].frames) == (at(30), 20)


def test_command_ranks_moments_without_truth(tmp_path: Path) -> None:
    run = _folder(tmp_path, {"stop_sign": _found(10, 30)}).path

    assert "expected one of them" in refusal(
        2, "failures", run, "--unlabelled", "--truth", tmp_path
    )
    found = crosscue.failures(run, unlabelled=True)
    assert [(one.kind, one.what, one.at_s) for one in found.failures] == [
        ("suspect", "stop_sign", 2.0)
    ]
    assert "the car did not slow down" in output_of("failures", run, "--unlabelled")
