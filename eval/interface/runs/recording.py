"""Write a run as a Rerun recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.eval.pipeline.run import Run, run_given
from crosscue.eval.runs.moments import TableFolder, approach_spans, moment_ns
from crosscue.replay.base import UsageError

if TYPE_CHECKING:
    from crosscue.eval.recording.part import Part


BEFORE_NS: Final = 2_000_000_000
BEHIND_NS: Final = 4_000_000_000
"""Time recorded after a moment."""


def save_recording(
    run: Run | Path | str,
    output: Path | str | None = None,
    truth: Path | str | None = None,
    *,
    at: float | str | None = None,
    approach: int | None = None,
    only: Sequence[str] = (),
) -> Path:
    """Write a run as a Rerun recording.

    Args:
        run: A finished run.
        output: File to write, whose name ends in ``.rrd``; default: ``drive.rrd`` in the run.
        truth: Truth file, to also draw the true track and ranges.
        at: Record only from 2 s before this moment to 4 s after it, and mark it: seconds from the
            run's first frame, or nanoseconds as ``17...ns``.
        approach: Record only this approach, by its number in ``belief.parquet``.
        only: Record only some of ``cameras``, ``ahead``, ``belief``, ``ranges``, ``cues``, ``map``,
            ``pose``, ``notes``; default: all.

    Returns:
        The recording; ``rerun PATH`` opens it.

    Raises:
        UsageError: The file has another suffix, or the run does not have the moment, approach or
            view.
        RunError: The log with the pictures is missing.
    """
    from crosscue.eval.recording import save
    from crosscue.eval.scoring.pose.score import truth_track
    from crosscue.eval.scoring.truth import load as load_truth

    folder = run_given(run).folder
    path = folder.file("drive.rrd") if output is None else Path(output)
    if path.suffix != ".rrd":
        raise UsageError(f"{path}: expected a name that ends in .rrd")
    part = _part(folder, at, approach, only)
    track = ranges = None
    if truth is not None:
        known = load_truth(Path(truth), str(folder.path))
        ranges = known.ranges
        if known.truth.pose is not None and folder.file("pose.parquet").exists():
            track = truth_track(Path(truth), folder)
    save(folder, path, track, ranges, part)
    return path


def _part(
    run: TableFolder, at: float | str | None, approach: int | None, only: Sequence[str]
) -> Part:
    """Return the part of the run to record."""
    from crosscue.eval.recording.part import Part

    views = frozenset(only)
    if at is not None and approach is not None:
        raise UsageError("--at, --approach: expected one of them")
    if at is not None:
        t_ns = moment_ns(run, at if isinstance(at, str) else repr(float(at)))
        return Part(t_ns - BEFORE_NS, t_ns + BEHIND_NS, t_ns, views)
    if approach is not None:
        spans = approach_spans(run)
        if approach not in spans:
            there = ", ".join(map(str, spans)) or "none"
            raise UsageError(f"--approach {approach}: not in {run.path}; it has: {there}")
        return Part(*spans[approach], None, views)
    return Part(only=views)
