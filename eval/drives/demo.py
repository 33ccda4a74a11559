"""The demonstration: replay, score and show a simulated or a downloaded drive."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib import util
from pathlib import Path
from typing import Annotated, ClassVar, Final

from crosscue.datasets.simulate import simulate_approach
from crosscue.eval.drives.replay import replay_drive
from crosscue.eval.drives.score import ScoredRun, score_run
from crosscue.eval.pipeline.outcome import MAX_LINES
from crosscue.eval.pipeline.run import Run
from crosscue.eval.recording.view import save_recording
from crosscue.eval.report.opening import judged_sentences
from crosscue.replay.errors import CrosscueError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import terminal_width, wrapped
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option, keywords

REAL: Final = "pandaset_002"
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


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """Drive of a demonstration, and where its files go.

    Attributes:
        output: Folder for drive, run and report (default: demo, or demo-real).
        real: Replay a real drive, downloaded once, instead of simulating one.
        road: Also find the road of the real drive, with road-segmentation-adas-0001 (Apache-2.0,
            0.7 MB, needs openvino), for as much CPU time again as yolox-nano takes.
        source: Folder with the real drive and the weights, to use instead of downloading them.
        width_px: Image width in pixels (default: 1280); height is 9/16.
        overwrite: Replace an existing demo.
    """

    output: Path | str | None = None
    real: bool = False
    road: bool = False
    source: Annotated[Path | str | None, Option("--data", metavar="FOLDER")] = None
    width_px: Annotated[int | None, Option("--width")] = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Refuse settings of the other kind of drive.

        Raises:
            UsageError: Naming the setting.
        """
        if not self.real and self.source is not None:
            raise UsageError("source: applies only to a real drive; add real=True")
        if not self.real and self.road:
            raise UsageError("road: applies only to a real drive; add real=True")
        if self.real and self.width_px is not None:
            raise UsageError("width_px: applies only to a simulated drive; omit it or real=True")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Demo(Result):
    """Result of a demonstration.

    Attributes:
        drive: The replayed drive.
        run: The run.
        scored: Scores of the run.
        recording: Rerun recording of the run, with the true track and ranges.
    """

    drive: KnownDrive = field(metadata=HIDDEN)
    run: Run = field(metadata=HIDDEN)
    scored: ScoredRun = field(metadata=HIDDEN)
    recording: Path

    # Less the lines that tell of the simulation before.
    max_lines: ClassVar = MAX_LINES - 3
    also: ClassVar = {
        **{name: f"drive.{name}" for name in ("log", "vehicle", "truth", "attribution")},
        "run": "run.path",
        "report": "scored.report",
        "metrics": "scored.metrics",
    }

    @property
    def exit_status(self) -> int:
        """Exit status of the replay."""
        return self.run.made.exit_status

    def lines(self) -> Iterator[str]:
        """Yield what was found, the scores and the summary of the replay."""
        whose = "our annotations" if self.drive.attribution else "the truth of the simulation"
        yield f"against {whose}:"
        for sentence in judged_sentences(self.scored.one):
            yield wrapped(sentence, min(terminal_width(), 80), lead="")
        yield ""
        yield repr(self.scored)
        yield ""
        yield repr(self.run.made)

    def closing(self) -> Iterator[str]:
        """Yield the files to open."""
        yield f"\nreport     {self.scored.report.resolve()}"
        yield f"recording  {self.recording.resolve()}"
        yield f"           look at it with: crosscue view {self.run.path}"
        if self.drive.attribution:
            yield f"pictures   {self.drive.attribution}"


def fetch_drive(source: Path | str | None = None, *, with_road: bool = False) -> KnownDrive:
    """Download PandaSet's sequence 002 and the network yolox-nano once, and verify them.

    Recording and weights are kept in the user's cache. They are copied from ``source`` or from
    ``$CROSSCUE_DATA``, or else downloaded from their publishers (25 MB).

    Args:
        source: Folder with the recording and the weights, to be used without a network.
        with_road: Also fetch the catalog's road network, for the drive's detectors.

    Raises:
        CrosscueError: A file cannot be obtained; the message lists all required files.
        UsageError: ``source`` has no recording, or another one; or openvino is missing, which the
            road network needs.
    """
    from crosscue.datasets.real import recordings
    from crosscue.detectors.catalog.entries import entry
    from crosscue.detectors.catalog.fetch import fetch_weights
    from crosscue.detectors.catalog.known_models import OBJECTS, ROAD, model

    def show(file: str, done: int, of: int) -> None:
        emit(Progress(file, done / 1e6, of / 1e6, "MB"))

    if with_road and util.find_spec("openvino") is None:
        raise UsageError("road: needs the package openvino: pip install openvino")
    known, names = recordings.recording(REAL), (OBJECTS, *((ROAD,) if with_road else ()))
    given = None if source is None else Path(source)
    try:
        log = recordings.fetch_recording(known, given, show)
        for name in names:
            weights = None if given is None else _below(given, entry(name).weights)
            # The road network has two files.
            is_folder = weights is not None and len(entry(name).files) > 1
            fetch_weights(name, weights.parent if weights and is_folder else weights, show)
    except UsageError:
        raise
    except CrosscueError as error:
        models = [model(name) for name in names]
        needs = [f"model {one.name}: {one.size_mb:.1f} MB, {one.card.licence}" for one in models]
        raise type(error)(f"needed: {'; '.join([known.needs(), *needs])}; {error}") from None
    detectors = names if with_road else None
    return KnownDrive(log, known.vehicle, known.truth, known.attribution, detectors)


@keywords(DemoSettings, 0)
def demo(settings: DemoSettings) -> Demo:
    """Simulate or fetch a small drive; replay, score and show it.

    By default, the drive is simulated on this machine from a seed, and nothing is downloaded. This
    takes a few minutes on two cores, mostly for rendering and for the networks. With --real, the
    drive is 8 s of San Francisco: PandaSet's sequence 002 (Scale AI and Hesai, CC BY 4.0, 20.8 MB),
    annotated by crosscue's authors, with the network yolox-nano (3.7 MB, Apache-2.0). Both are
    downloaded once and verified.

    Examples:
        crosscue demo -o demo
        crosscue demo --real --road
        crosscue demo --real --data FOLDER       on a machine without network

    Args:
        settings: Which drive.

    Raises:
        CrosscueError: Recording or weights are missing and cannot be fetched.
        UsageError: A setting does not apply to the drive.
        RunError: The folder has other contents.
    """
    folder = Path(settings.output or ("demo-real" if settings.real else "demo"))
    drive = (
        fetch_drive(settings.source, with_road=settings.road)
        if settings.real
        else _simulated(folder, settings)
    )
    run = replay_drive(
        drive.log,
        folder / "run",
        drive.vehicle,
        drive.detectors,
        overwrite=settings.overwrite,
    )
    scored = score_run(run, drive.truth)
    return Demo(drive, run, scored, save_recording(run, truth=drive.truth))


def _simulated(folder: Path, settings: DemoSettings) -> KnownDrive:
    """Simulate a drive in ``folder/drive``, to be replayed with the embedded networks.

    Its vehicle file tracks cars on the road, because most published pairs are wrong there.
    """
    from crosscue.detectors.registry import EMBEDDED

    emit("simulating a drive up to intersection C ...")
    files = simulate_approach(
        folder / "drive",
        "C",
        width_px=1280 if settings.width_px is None else settings.width_px,
        overwrite=settings.overwrite,
    )
    emit(f"  {files.log}\n")
    write_text(files.vehicle, door.read(files.vehicle).decode() + FOLLOWED)
    return KnownDrive(files.log, files.vehicle, files.truth, "", tuple(EMBEDDED.split(",")))


def _below(folder: Path, name: str) -> Path | None:
    """Return the file's path in a folder or its ``weights``; None if it is in neither."""
    found = [*sorted(folder.glob(name)), *sorted(folder.glob(f"weights/*/{name}"))]
    return found[0] if found else None
