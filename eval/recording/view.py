"""Write a run as a Rerun recording, or show it."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from crosscue.eval.pipeline.run import PicturedRun, Run, run_given
from crosscue.eval.recording import save_rrd
from crosscue.eval.recording.part import RecordingSpan
from crosscue.eval.runs.moments import approach_spans, moment_ns
from crosscue.eval.runs.tables.parquet import TableFolder
from crosscue.eval.scoring.truth import read_scored_truth as load_truth
from crosscue.replay.errors import CrosscueError, OutputError, UsageError
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option, keywords

BEFORE_NS: Final = 2_000_000_000
# Time recorded after a moment.
BEHIND_NS: Final = 4_000_000_000


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
        truth: Truth file, to also draw the true track, ranges and labelled boxes (default:
            that of the last score).
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
    from crosscue.eval.scoring.pose.score import truth_track
    from crosscue.eval.scoring.runs import remembered_truth

    folder = run_given(run).folder
    path = folder.file("drive.rrd") if output is None else Path(output)
    if path.suffix != ".rrd":
        raise UsageError(f"{path}: expected a name that ends in .rrd")
    part = _part(folder, at, approach, only)
    track = ranges = None
    scored = remembered_truth(folder) if truth is None else None
    truth = truth if scored is None else scored.path
    if truth is not None:
        known = load_truth(Path(truth), str(folder.path))
        ranges = known.ranges
        if known.truth.pose is not None and folder.file("pose.parquet").exists():
            track = truth_track(Path(truth), folder)
    save_rrd(folder, path, track, ranges, part, None if truth is None else Path(truth))
    return path


def _part(
    run: TableFolder, at: float | str | None, approach: int | None, only: Sequence[str]
) -> RecordingSpan:
    """Return the part of the run to record."""
    views = frozenset(only)
    if at is not None and approach is not None:
        raise UsageError("at, approach: expected one of them")
    if at is not None:
        t_ns = moment_ns(run, at if isinstance(at, str) else repr(float(at)))
        return RecordingSpan(t_ns - BEFORE_NS, t_ns + BEHIND_NS, t_ns, views)
    if approach is not None:
        spans = approach_spans(run)
        if approach not in spans:
            there = ", ".join(map(str, spans)) or "none"
            raise UsageError(f"approach: {approach}, not in {run.path}; it has: {there}")
        return RecordingSpan(*spans[approach], None, views)
    return RecordingSpan(only=views)


@dataclass(frozen=True, slots=True, repr=False)
class Recording(Result):
    """A recording that was written or shown.

    Attributes:
        recording: The file.
        is_shown: True if the viewer was opened instead of printing the file's name.
        is_whole: True if nothing was dropped in the run.
    """

    recording: Path
    is_shown: bool = field(metadata=HIDDEN)
    is_whole: bool = field(metadata=HIDDEN)

    def lines(self) -> Iterator[str]:
        """Yield the name of the file, unless it was shown."""
        if not self.is_shown:
            yield str(self.recording)


def recording_file(text: str) -> Path:
    """Return the file of a recording.

    Raises:
        UsageError: Its name does not end in ``.rrd``.
    """
    if not text.endswith(".rrd"):
        raise UsageError(f"{text}: expected a name that ends in .rrd")
    return Path(text)


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewSettings:
    """Settings of a view.

    Attributes:
        output: Write the recording without opening the viewer.
        web: Serve the viewer on 127.0.0.1 for a browser.
        at: Seconds from the run's first frame, or a time (17...ns).
        approach: Number of an approach in belief.parquet.
        only: Comma-separated views, such as cameras,belief.
        truth: Truth file, to also draw what is true (default: that of the last score).
        overwrite: Replace an existing recording.
    """

    output: Annotated[Path | None, Option(metavar="X.rrd", convert=recording_file, group="how")] = (
        None
    )
    web: Annotated[bool, Option(group="how")] = False
    at: Annotated[str | None, Option(metavar="T", group="part")] = None
    approach: Annotated[int | None, Option(group="part")] = None
    only: Annotated[str, Option(metavar="VIEWS")] = ""
    truth: Path | None = None
    overwrite: bool = False


@keywords(ViewSettings)
def view(run: PicturedRun, settings: ViewSettings) -> Recording:
    """Show a run in Rerun.

    Without an output file, the viewer is opened. --at records 6 s, from 2 s before a moment, and
    marks the moment on the time line. (A recording cannot set Rerun's cursor, so the viewer starts
    at the beginning.) --approach records one approach. --only records some of the views: cameras,
    ahead, belief, ranges, cues, map, pose, notes. The recording contains only what is shown.

    Examples:
        crosscue view runs/drive                    open Rerun's viewer
        crosscue view runs/drive --at 12.3          at 12.3 s from the first frame
        crosscue view runs/drive --approach 1 --only cameras,belief
        crosscue view runs/drive -o drive.rrd       write the recording, open nothing
        crosscue view runs/drive --web              serve the viewer to a browser on this machine

    Args:
        run: Run folder.
        settings: What to show, and where.
    """
    output = settings.output
    if output is not None and output.exists() and not settings.overwrite:
        raise OutputError(f"{output}: exists; give another name or --overwrite")
    made = run_given(run)
    views = [name for name in settings.only.split(",") if name]
    path = save_recording(
        made, output, settings.truth, at=settings.at, approach=settings.approach, only=views
    )
    if output is None:
        _open(path, settings.web)
    return Recording(path, output is None, made.manifest.account.is_whole)


def _open(path: Path, web: bool) -> None:
    # Rerun's Python API listens on every address; only its command can be bound to localhost.
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(path)]
    if web:
        command.append("--serve-web")
    environment = {**os.environ, "RERUN_ANALYTICS": "0"}
    try:
        viewer = subprocess.Popen(command, env=environment, process_group=0)
    except OSError as error:
        raise CrosscueError(f"rerun: cannot be started ({error.strerror}); open {path}") from None
    try:
        status = viewer.wait()
    finally:
        # Rerun's command starts the viewer as a child process, which could outlive it.
        with suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait()
    if status:
        raise CrosscueError(f"rerun: ended with status {status}; open {path} with another viewer")
