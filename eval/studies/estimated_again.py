"""Estimate a run's tables again, with other settings or without a cue, for scoring."""

from __future__ import annotations

from crosscue.eval.pipeline.scene.variants import scene_tables
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.scoring.columns import RunTables
from crosscue.eval.scoring.run_tables import in_log_time
from crosscue.eval.studies.attribution import EstimateWithout
from crosscue.replay.vehicle.vehicle import Vehicle


def estimate_of(run: RunFolder, vehicle: Vehicle | None = None) -> EstimateWithout:
    """Return a function that estimates from a run's detections and pose, without pictures.

    Args:
        run: Run with a finished detect stage.
        vehicle: Other settings; default: those of the run.

    Raises (when called):
        RunError: No detector ran on the run's camera.
    """

    def estimate(cues: frozenset[str], /) -> RunTables:
        timeline = run.drive_manifest().timeline
        again = scene_tables(run, vehicle, cues)
        tables = {name: again[name] for name in ("cues", "range", "belief")}
        frames = run.table("frames", ["t_ns", "segment", "log_t_ns"])
        return in_log_time(str(run.path), {"frames": frames, **tables}, timeline)

    return estimate
