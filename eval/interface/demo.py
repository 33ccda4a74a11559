"""The demonstration: replay, score and show a simulated or a downloaded drive in one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.datasets.simulate import simulate_approach
from crosscue.eval.drives.replay import replay_drive
from crosscue.eval.drives.score import ScoredRun, score_run
from crosscue.eval.pipeline.run import Run
from crosscue.eval.recording.view import save_recording
from crosscue.replay.errors import CrosscueError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.whole_file import write_text

REAL: Final = "pandaset_002"
MODEL: Final = "yolox-nano"
FOLLOWED: Final = """
# Cars are tracked on the road over several frames. The published method uses pairs of frames.
[cars]
kind = "tracks"
"""


@dataclass(frozen=True, slots=True)
class KnownDrive:
    """A drive with the files needed to replay and score it.

    Attributes:
        log: The recording.
        vehicle: The vehicle file.
        truth: The truth file.
        attribution: Credit to print wherever the pictures are shown; empty if simulated.
        detectors: Names of detectors; None for those of the vehicle file.
    """

    log: Path
    vehicle: Path
    truth: Path
    attribution: str = ""
    detectors: tuple[str, ...] | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Demo:
    """Result of a demonstration; its repr is the output of ``crosscue demo``.

    Attributes:
        drive: The replayed drive.
        run: The run.
        scored: Scores of the run.
        recording: Rerun recording of the run, with the true track and ranges.
    """

    drive: KnownDrive
    run: Run
    scored: ScoredRun
    recording: Path

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue demo``."""
        return {
            "log": str(self.drive.log),
            "vehicle": str(self.drive.vehicle),
            "truth": str(self.drive.truth),
            "attribution": self.drive.attribution,
            "run": str(self.run.path),
            "report": str(self.scored.report),
            "recording": str(self.recording),
            "metrics": self.scored.metrics,
        }

    def __repr__(self) -> str:
        lines = [repr(self.scored), "", f"report     {self.scored.report.resolve()}"]
        lines.append(f"recording  {self.recording.resolve()}")
        lines.append(
            f"           look at it with: crosscue view {self.run.path} --truth {self.drive.truth}"
        )
        if self.drive.attribution:
            lines.append(f"pictures   {self.drive.attribution}")
        return "\n".join(lines)


def fetch_drive(
    source: Path | str | None = None,
    *,
    on_fetch: Callable[[str, int, int], None] = lambda file, done, of: None,
) -> KnownDrive:
    """Download PandaSet's sequence 002 and the network yolox-nano once, and verify them.

    Recording and weights are kept in the user's cache. They are copied from ``source`` or from
    ``$CROSSCUE_DATA``, or else downloaded from their publishers (25 MB).

    Args:
        source: Folder with the recording and the weights, to be used without a network.
        on_fetch: Called with a file's name, the number of bytes present, and their total.

    Raises:
        CrosscueError: A file cannot be obtained; the message lists all required files.
        UsageError: ``source`` has no recording, or another one.
    """
    from crosscue.datasets.real import recordings
    from crosscue.detectors.catalog.entries import entry
    from crosscue.detectors.catalog.fetch import fetch_weights

    known, card = recordings.recording(REAL), entry(MODEL)
    given = None if source is None else Path(source)
    try:
        log = recordings.fetch_recording(known, given, on_fetch)
        fetch_weights(MODEL, None if given is None else _below(given, card.weights), on_fetch)
    except UsageError:
        raise
    except CrosscueError as error:
        size = sum(file.size_bytes for file in card.files) / 1e6
        raise type(error)(
            f"needed: {known.needs()}; model {MODEL}: {size:.1f} MB, {card.licence}; {error}"
        ) from None
    return KnownDrive(log, known.vehicle, known.truth, known.attribution)


def demo(
    folder: Path | str | None = None,
    *,
    real: bool = False,
    source: Path | str | None = None,
    layout: str = "C",
    run: int = 1,
    seed: int = 0,
    width_px: int = 1280,
    overwrite: bool = False,
    on_fetch: Callable[[str, int, int], None] = lambda file, done, of: None,
    on_drive: Callable[[KnownDrive], None] = lambda drive: None,
) -> Demo:
    """Replay a drive to an intersection, score it, and write a report and a recording.

    Args:
        folder: Output folder of the run and of a simulated drive; default: ``demo``, or
            ``demo-real``.
        real: Use the drive of ``fetch_drive`` instead of simulating one.
        source: As in ``fetch_drive``.
        layout: Layout of the simulated drive, as in ``simulate_approach``.
        run: Run of the simulated drive, as in ``simulate_approach``.
        seed: Seed of the simulated drive, as in ``simulate_approach``.
        width_px: Width of the simulated pictures, as in ``simulate_approach``.
        overwrite: Replace an earlier demonstration.
        on_fetch: As in ``fetch_drive``.
        on_drive: Called with the drive before it is replayed.

    Raises:
        CrosscueError: Recording or weights are missing and cannot be fetched.
        UsageError: ``source`` without ``real``.
        RunError: The folder has other contents.
    """
    place = Path(folder or ("demo-real" if real else "demo"))
    if real:
        drive = fetch_drive(source, on_fetch=on_fetch)
    elif source is None:
        drive = _simulated(place, layout, run, seed, width_px, overwrite)
    else:
        raise UsageError("demo: source applies only to the real drive; add real=True")
    on_drive(drive)
    return _shown(drive, place, overwrite)


def _simulated(
    folder: Path, layout: str, run: int, seed: int, width_px: int, overwrite: bool
) -> KnownDrive:
    """Simulate a drive in ``folder/drive``, to be replayed with the embedded networks.

    Its vehicle file tracks cars on the road, because most published pairs are wrong there.
    """
    from crosscue.detectors.registry import EMBEDDED

    files = simulate_approach(
        folder / "drive", layout, run, seed, width_px=width_px, overwrite=overwrite
    )
    write_text(files.vehicle, door.read(files.vehicle).decode() + FOLLOWED)
    return KnownDrive(files.log, files.vehicle, files.truth, "", tuple(EMBEDDED.split(",")))


def _shown(
    drive: KnownDrive,
    folder: Path,
    overwrite: bool,
) -> Demo:
    """Replay and score a drive in ``folder/run``; arguments as in ``replay_drive``."""
    run = replay_drive(
        drive.log,
        folder / "run",
        drive.vehicle,
        drive.detectors,
        overwrite=overwrite,
    )
    scored = score_run(run, drive.truth)
    return Demo(drive, run, scored, save_recording(run, truth=drive.truth))


def _below(folder: Path, name: str) -> Path | None:
    """Return the file's path in a folder or its ``weights``; None if it is in neither."""
    found = [*sorted(folder.glob(name)), *sorted(folder.glob(f"weights/*/{name}"))]
    return found[0] if found else None
