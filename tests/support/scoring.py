"""A small made-up drive with scores known by hand: one approach, ten frames per second."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from crosscue.datasets.truth.truth import Approach, CueTruth, Features, Truth, save
from crosscue.eval.runs.folder import RunFolder, create, write_manifest
from crosscue.eval.runs.manifest import LogRow
from crosscue.eval.scoring.columns import RunTables
from crosscue.eval.scoring.run_tables import run_tables
from crosscue.eval.scoring.truth import DriveTruth, TrueRanges
from crosscue.replay.files.identity import log_identity
from crosscue.replay.files.log_identity import Identity
from crosscue.replay.files.whole_file import write_text

from .manifests import estimated

STEP_NS: Final = 100_000_000
# Frame at which the car enters; it starts 40 m away and drives 10 m/s, 1 m per frame.
ENTER: Final = 40


def at(frame: int) -> int:
    return 1_000_000_000 + frame * STEP_NS


def approach(**changes: Any) -> Approach:
    """A T junction with a stop sign and roads to the left and right."""
    content: dict[str, Any] = {
        "id": 0,
        "intersection": "A",
        "start_ns": at(0),
        "enter_ns": at(ENTER),
        "control": "stop_sign",
        "features": Features(left=True, right=True, straight=False),
        "conditions": ("rain",),
        "length_m": 10.0,
    }
    return Approach.model_validate(content | changes)


def span(cue: str, first: int, end: int, present: bool = True, **more: Any) -> CueTruth:
    """Truth of a cue in a half-open range of frames."""
    content = {"cue": cue, "present": present, "start_ns": at(first), "end_ns": at(end)}
    return CueTruth.model_validate(content | more)


def truth(
    cues: Sequence[CueTruth] = (),
    approaches: Sequence[Approach] | None = None,
    drive: str = "made up",
    end: int = 60,
) -> DriveTruth:
    """Truth of the made-up drive, with ranges during its approaches only."""
    approaches = [approach()] if approaches is None else approaches
    reported = Truth(
        version=1,
        start_ns=at(0),
        end_ns=at(end),
        cues=tuple(cues),
        approaches=tuple(approaches),
        source="made up",
    )
    return DriveTruth(drive, reported, true_ranges(approaches))


def true_ranges(approaches: Sequence[Approach]) -> TrueRanges:
    """Ranges that decrease by one metre per frame until the car enters."""
    rows = [
        (t, one.id, (one.enter_ns - t) / STEP_NS)
        for one in approaches
        for t in range(one.start_ns, one.enter_ns, STEP_NS)
    ]
    start = np.array([row[2] for row in rows], np.float64)
    return TrueRanges(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows], np.int64),
        start,
        start + 10.0,
    )


def _table(types: Mapping[str, str], rows: Sequence[Sequence[object]]) -> pa.Table:
    schema = pa.schema([(name, pa.type_for_alias(kind)) for name, kind in types.items()])
    return pa.Table.from_pylist([dict(zip(types, row, strict=True)) for row in rows], schema)


def cue_table(found: Mapping[str, Mapping[int, int]]) -> pa.Table:
    """Cues table from counts by cue and frame."""
    rows = [
        (at(frame), cue, count) for cue, frames in found.items() for frame, count in frames.items()
    ]
    types = {"t_ns": "int64", "approach": "int64", "cue": "string", "count": "int64"}
    return _table(types, [(t_ns, None, cue, count) for t_ns, cue, count in rows])


def frame_table(frames: int) -> pa.Table:
    return pa.table({"t_ns": pa.array([at(frame) for frame in range(frames)], pa.int64())})


def belief_table(
    features: Mapping[str, Mapping[int, float]], number: int = 7, frames: Sequence[int] = range(50)
) -> pa.Table:
    """Belief table in which each feature is 0.5 until it changes to values at given frames."""
    columns: dict[str, Any] = {
        "t_ns": pa.array([at(frame) for frame in frames], pa.int64()),
        "approach": pa.array([number] * len(frames), pa.int64()),
    }
    for name, changes in features.items():
        values, now = [], 0.5
        for frame in frames:
            now = changes.get(frame, now)
            values.append(now)
        columns[name] = pa.array(values, pa.float64())
    roads = [
        columns[name].to_pylist() for name in ("intersection", "left", "right") if name in columns
    ]
    is_established = [any(v[i] > 0.9 for v in roads) for i in range(len(frames))]
    columns["established"] = pa.array(
        [any(is_established[: i + 1]) for i in range(len(frames))], pa.bool_()
    )
    return pa.table(columns)


def range_table(
    first: int,
    last: int,
    error_m: float = 0.0,
    var_m2: float = 1.0,
    number: int = 7,
    reference: str = "start",
) -> pa.Table:
    """Range table of one row per frame with a constant error."""
    frames = range(first, last)
    offset = 0.0 if reference == "start" else 10.0
    types = {"t_ns": "int64", "approach": "int64", "reference": "string"}
    types |= dict.fromkeys(("range_m", "var_m2", "measured_m"), "float64")
    rows = [
        (at(frame), number, reference, ENTER - frame + offset + error_m, var_m2, None)
        for frame in frames
    ]
    return _table(types, rows)


def tables(
    cues: Mapping[str, Mapping[int, int]] | None = None,
    belief: pa.Table | None = None,
    ranges: pa.Table | None = None,
    frames: int | None = None,
) -> RunTables:
    found = {
        "frames": None if frames is None else frame_table(frames),
        "cues": None if cues is None else cue_table(cues),
        "belief": belief,
        "range": ranges,
    }
    return run_tables("made up", {name: one for name, one in found.items() if one is not None})


BELIEF: Final[Mapping[str, Mapping[int, float]]] = {
    "intersection": {10: 0.95},
    "left": {20: 0.97},
    "right": {25: 0.92},
    "straight": {30: 0.2},
}
CUES: Final[Mapping[str, Mapping[int, int]]] = {
    "stop_sign": {frame: int(frame >= 10) for frame in range(40)},
    "road_left": {frame: int(frame == 35) for frame in range(50)},
}


def good_tables() -> RunTables:
    return tables(CUES, belief_table(BELIEF), range_table(8, 45, 0.5), frames=50)


def good_truth(drive: str = "made up") -> DriveTruth:
    """Truth of that run: the sign is visible from frame 5 on, the road to the left always."""
    return truth(
        [
            span("stop_sign", 0, 5, present=False),
            span("stop_sign", 5, 40, count=1, visible=1.0),
            span("road_left", 0, 40),
        ],
        drive=drive,
    )


def log_row(log: Path, run: RunFolder, sha256: str = "00", *cameras: str) -> LogRow:
    """Manifest row of a log; a missing log gets a made-up identity."""
    found = log_identity(log) if log.exists() else Identity(log.name, 0, "0" * 64)
    return LogRow(
        name=log.name,
        path=run.relative(log),
        format="mcap",
        cameras=cameras,
        identity=found,
        sha256={log.name: sha256},
    )


def run_folder(
    path: Path, found: Mapping[str, pa.Table] | None = None, **manifest: Any
) -> RunFolder:
    """Write a finished run folder, by default with tables of the made-up drive."""
    run = create(path, overwrite=False)
    if found is None:
        found = {
            "frames": frame_table(50),
            "cues": cue_table(CUES),
            "belief": belief_table(BELIEF),
            "range": range_table(8, 45, 0.5),
        }
    for name, table in found.items():
        pq.write_table(table, run.file(f"{name}.parquet"), write_page_checksum=True)
    logs = (log_row(path.parent / "drive.mcap", run),)
    write_manifest(run, estimated(**{"logs": logs, **manifest}))
    return run


def truth_folder(path: Path, drive_truth: DriveTruth | None = None, place: str = "") -> Path:
    """Write the truth of the made-up drive, and return the path of ``truth.json``."""
    path.mkdir(parents=True, exist_ok=True)
    one = good_truth() if drive_truth is None else drive_truth
    reported = one.truth
    if one.ranges is not None:
        rows = zip(
            one.ranges.t_ns, one.ranges.approach, one.ranges.start_m, one.ranges.end_m, strict=True
        )
        lines = ["t_ns,approach,start_m,end_m", *(f"{t},{a},{s},{e}" for t, a, s, e in rows), ""]
        write_text(path / "ranges.csv", "\n".join(lines))
        reported = reported.model_copy(update={"ranges": "ranges.csv"})
    return save(reported.model_copy(update={"place": place}), path)
