"""Run folders of made-up drives with the tables that the fit of messages reads."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from crosscue.datasets.truth.truth import Approach, Features, Truth, save
from crosscue.eval.pipeline.scene.stage import scene_columns
from crosscue.eval.runs.folder import RunFolder, create, write_manifest
from crosscue.eval.runs.tables.columns import OF_RUN, arrow_schema
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.fusion.approaches import Approaches, Step
from crosscue.fusion.evidence import FrameEvidence
from crosscue.fusion.factor_graph import graph_of
from crosscue.replay.vehicle.fusion import Fusion
from crosscue.replay.vehicle.vehicle import Vehicle

from .fusion import NONE_SEEN, SECOND_NS, sign
from .manifests import estimated

FRAME_NS = SECOND_NS // 10


def made_up_drive(rng: np.random.Generator, *, left: bool, signed: bool) -> list[FrameEvidence]:
    """Evidence of sixty metres up to an intersection, with a noisy cue of the road to the left.

    Without a sign, a road to the right keeps the approach open.
    """
    out = []
    for i in range(60):
        ahead_m = 60.0 - i
        counts = {
            **NONE_SEEN,
            "stop_sign": int(signed),
            "road_left": int(rng.random() < (0.6 if left else 0.1)),
            "road_right": int(not signed),
        }
        signs = (sign(ahead_m + float(rng.normal(0.0, 1.0))),) if signed else ()
        out.append(FrameEvidence(i * FRAME_NS, 1.0, 1e-4, signs, counts))
    return out


def write_run(
    folder: Path, evidence: Iterable[FrameEvidence], vehicle: Vehicle | None = None
) -> RunFolder:
    """Write a finished run with the given evidence."""
    vehicle = vehicle or Vehicle(version=1, fusion=Fusion(kind="source"))
    run = create(folder, overwrite=False)
    loop = Approaches(graph_of(vehicle.fusion), vehicle.fusion, vehicle.range_filter)
    taken = list(evidence)
    steps = [loop(one) for one in taken]
    _write_steps(run, steps)
    columns = OF_RUN["measurements"]
    with TableSink(run, "measurements", arrow_schema(columns)) as sink:
        empty: dict[str, list[object]] = {name: [None] * len(taken) for name in columns}
        sink.write(
            empty
            | {
                "kind": ["odometry"] * len(taken),
                "start_ns": [one.t_ns - FRAME_NS for one in taken],
                "t_ns": [one.t_ns for one in taken],
                "distance_m": [one.travelled_m for one in taken],
                "turn_rad": [0.0] * len(taken),
                "distance_var_m2": [one.travelled_var_m2 for one in taken],
            }
        )
    write_manifest(run, estimated(settings=vehicle))
    return run


def write_drives(folder: Path, roads: Iterable[bool | None]) -> tuple[list[Path], list[Path]]:
    """Write runs and truths of drives with and without a road to the left, or an intersection."""
    rng, runs, truths = np.random.default_rng(4), [], []
    for i, left in enumerate(roads):
        evidence = made_up_drive(rng, left=bool(left), signed=left is not None)
        run, truth = write_run(folder / f"run{i}", evidence).path, folder / f"truth{i}"
        frames = pa.table({"t_ns": [one.t_ns for one in evidence]})
        pq.write_table(frames, run / "frames.parquet", write_page_checksum=True)
        runs.append(run)
        truths.append(write_empty_truth(truth) if left is None else write_truth(truth, left=left))
    return runs, truths


def _write_steps(run: RunFolder, steps: list[Step]) -> None:
    cues = [(s.t_ns, s.approach, cue, n) for s in steps for cue, n in s.counts.items()]
    ranges = [
        (s.t_ns, s.approach, str(row.reference), row.range_m, row.var_m2, row.measured_m)
        for s in steps
        for row in s.ranges
    ]
    beliefs = [
        (s.t_ns, s.approach, *s.probabilities.values(), s.established)
        for s in steps
        if s.approach is not None
    ]
    for name, rows in (("cues", cues), ("range", ranges), ("belief", beliefs)):
        schema = arrow_schema(scene_columns()[name])
        with TableSink(run, name, schema) as sink:
            if rows:
                sink.write(dict(zip(schema.names, zip(*rows, strict=True), strict=True)))


def write_truth(folder: Path, *, left: bool | None, enter_ns: int = 59 * FRAME_NS) -> Path:
    """Write the truth of a drive that consists of one approach."""
    folder.mkdir()
    one = Approach(
        id=0,
        intersection=folder.name,
        start_ns=0,
        enter_ns=enter_ns,
        control="none",
        features=Features(left=left, right=True, straight=True),
    )
    return save(Truth(version=1, start_ns=0, end_ns=10**12, approaches=(one,)), folder)


def write_empty_truth(folder: Path, end_ns: int = 10**12) -> Path:
    """Write the truth of a drive without an intersection."""
    folder.mkdir()
    return save(Truth(version=1, start_ns=0, end_ns=end_ns), folder)
