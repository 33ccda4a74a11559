"""Repetition of a run's scene in memory with other settings or without a cue."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from crosscue.eval.pipeline.replay import observe
from crosscue.eval.pipeline.scene.stage import (
    SceneTables,
    features_of,
    gives_reasons,
    scene_columns,
)
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.tables.columns import arrow_schema
from crosscue.eval.runs.tables.labelled import with_labels
from crosscue.replay.errors import RunError
from crosscue.replay.vehicle.vehicle import Vehicle

if TYPE_CHECKING:
    import pyarrow as pa


def scene_tables(
    run: RunFolder, vehicle: Vehicle | None = None, without: frozenset[str] = frozenset()
) -> dict[str, pa.Table]:
    """Return the tables ``cues``, ``range`` and ``belief`` of a repeated run.

    Args:
        run: A run with a finished detect stage and a pose.
        vehicle: Settings; default: those of the run.
        without: Cues to leave out, as if they had not been evaluated.

    Raises:
        RunError: No detector has examined the run's camera.
    """
    import pyarrow as pa

    manifest = run.drive_manifest()
    detected = manifest.detected
    if detected is None:
        raise RunError(f"{run.path}: no detector ran on its camera; replay with detectors")
    settings = manifest.settings if vehicle is None else vehicle
    features, reasons = features_of(settings), gives_reasons(settings)
    columns = scene_columns(features, gives_reasons=reasons)
    wanted = {name: arrow_schema(each) for name, each in columns.items()}
    parts: dict[str, list[pa.Table]] = {
        name: [schema.empty_table()] for name, schema in wanted.items()
    }

    def keep(name: str, rows: dict[str, list[Any]]) -> None:
        parts[name].append(pa.table(rows, schema=wanted[name]))

    drive = Drive((), settings, segments=manifest.timeline)
    tables = SceneTables(keep, features, reasons)
    observe(drive, run, detected, tables, without)
    tables.flush()
    clock = drive.segments.clock(detected.camera_log)
    return {
        name: with_labels(pa.concat_tables(some), drive.segments, clock)
        for name, some in parts.items()
    }
