"""A run as a Rerun recording."""

from __future__ import annotations

from pathlib import Path

from crosscue.eval.interface.runs.run import Run, run_given
from crosscue.replay.base import UsageError


def save_recording(
    run: Run | Path | str, output: Path | str | None = None, truth: Path | str | None = None
) -> Path:
    """Write a run as a Rerun recording.

    Args:
        run: A finished run.
        output: Name that ends in ``.rrd``; ``drive.rrd`` in the run, if left out.
        truth: Draw the true track and ranges, too.

    Returns:
        The recording; ``rerun PATH`` opens it.

    Raises:
        UsageError: Another suffix.
        RunError: The log with the pictures is gone.
    """
    from crosscue.eval.recording import save
    from crosscue.eval.scoring.pose.score import truth_track
    from crosscue.eval.scoring.truth import load as load_truth

    folder = run_given(run).folder
    path = folder.file("drive.rrd") if output is None else Path(output)
    if path.suffix != ".rrd":
        raise UsageError(f"{path}: expected a name that ends in .rrd")
    track = ranges = None
    if truth is not None:
        known = load_truth(Path(truth), str(folder.path))
        ranges = known.ranges
        if known.truth.pose is not None and folder.file("pose.parquet").exists():
            track = truth_track(Path(truth), folder)
    save(folder, path, track, ranges)
    return path
