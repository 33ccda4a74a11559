"""Finished runs below one folder: two made-up drives, each with two settings."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

import pyarrow.parquet as pq

from crosscue.eval.runs.folder import RunFolder, create, write_manifest
from crosscue.eval.runs.manifest import ApproachRow, LogRow, SceneSummary
from crosscue.eval.scoring.by_drive import DriveMetric, by_drive_table
from crosscue.replay.files.log_identity import Identity
from crosscue.replay.vehicle.fusion import Fusion
from crosscue.replay.vehicle.vehicle import Vehicle

from .manifests import estimate_manifest, estimated
from .scoring import run_folder

# Threshold ``fusion.established`` of the runs in each folder.
ESTABLISHED: Final = {"a": 0.9, "b": 0.3}


def approach_row(number: int, detected_m: float | None) -> ApproachRow:
    return ApproachRow(
        number=number,
        start_ns=1_000_000_000,
        end_ns=5_900_000_000,
        detected_ns=None if detected_m is None else 2_000_000_000,
        detected_m=detected_m,
        reference="start",
        probabilities={"intersection": 0.95, "left": 0.97},
        not_seen=("straight",),
    )


def scene(*approaches: ApproachRow) -> SceneSummary:
    return SceneSummary(
        frames=50,
        positive={},
        counts={},
        without_odometry=0,
        approaches=approaches,
        candidates={},
        not_looked_for={},
        ranged={},
    )


def add_run(path: Path, drive: str, established: float = 0.9, **changes: Any) -> RunFolder:
    """Write one run of a drive, with cues, belief and range."""
    path.parent.mkdir(parents=True, exist_ok=True)
    log = LogRow(
        name=f"{drive}.mcap",
        path=f"../../{drive}.mcap",
        format="mcap",
        cameras=(),
        identity=Identity(f"{drive}.mcap", 1, drive[0].encode().hex() * 32),
        sha256={},
    )
    content: dict[str, Any] = {
        "logs": (log,),
        "settings": Vehicle(version=1, name="car", fusion=Fusion(established=established)),
        "scene": scene(approach_row(7, 30.0)),
    }
    return run_folder(path, **(content | changes))


def scored_run(path: Path, parts: Iterable[DriveMetric], **changes: Any) -> RunFolder:
    """Write a run with nothing but the metrics of its drive."""
    run = create(path, overwrite=False)
    write_manifest(run, estimated(**changes))
    run.file("score").mkdir()
    pq.write_table(by_drive_table(iter(parts)), run.file("score/by_drive.parquet"))
    return run


def runs_below(folder: Path) -> Path:
    """Write runs ``a/monday``, ``a/tuesday``, ``b/monday`` and ``b/tuesday`` below a folder."""
    for name, established in ESTABLISHED.items():
        for drive in ("monday", "tuesday"):
            add_run(folder / name / drive, drive, established)
    return folder


def change(run: RunFolder, **changes: Any) -> None:
    write_manifest(run, estimate_manifest(run).model_copy(update=changes))
