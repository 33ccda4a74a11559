"""Simulate drives with truth from a seed; nothing is downloaded."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, Final

from crosscue.datasets.scenes.drive import SceneFiles, refuse_other_drive, write_scene
from crosscue.datasets.scenes.layout import SCORED, Side
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.replay.errors import UsageError
from crosscue.replay.processes import in_processes
from crosscue.replay.progress import Progress, emit
from crosscue.results import Listing
from crosscue.verb import Option

PUBLISHED_RUNS: Final = 10


@dataclass(frozen=True, slots=True)
class Approaches:
    """Drives to intersections to simulate.

    Attributes:
        layouts: Layouts: A to H, or L0, L1, M0, M1 and so on.
        run: Simulate only this run, from 1.
        runs: Simulate the first N runs (default: 1).
        has_all: Simulate A to H, ten runs each.
        seed: Random seed.
        rate_hz: Camera images per second: 10, 20, 25 or 50.
        width_px: Image width in pixels; height is 9/16.
        traffic: Side of the road on which traffic drives.
    """

    layouts: Annotated[Sequence[str], Option(metavar="LAYOUT", is_positional=True)] = ()
    run: Annotated[int | None, Option(metavar="N")] = None
    runs: Annotated[int | None, Option(metavar="N")] = None
    has_all: bool = False
    seed: int = 0
    rate_hz: Annotated[int, Option("--fps")] = 10
    width_px: Annotated[int, Option("--width")] = 1280
    traffic: Side = "right"

    def scenes(self) -> list[SceneSettings]:
        """Return the settings of every run of every layout.

        Raises:
            UsageError: A value is out of range, or a layout is named twice.
        """
        if self.run is not None and (self.runs is not None or self.has_all):
            raise UsageError("run: cannot be combined with --runs or --all; use one of them")
        last = self.runs if self.runs is not None else PUBLISHED_RUNS if self.has_all else 1
        if last < 1:
            raise UsageError(f"runs: {last}, expected 1 or more")
        layouts = SCORED if self.has_all else self.layouts
        if len(set(layouts)) != len(layouts):
            raise UsageError("simulate: a layout is named twice; name each once")
        camera = camera_of_width(self.width_px)
        try:
            return [
                SceneSettings(
                    layout=layout,
                    run=run,
                    seed=self.seed,
                    rate_hz=self.rate_hz,
                    camera=camera,
                    traffic=self.traffic,
                )
                for layout in layouts
                for run in ([self.run] if self.run is not None else range(1, last + 1))
            ]
        except ValueError as error:
            raise UsageError(f"simulate: {error}") from None


class SimulatedDrives(Listing[SceneFiles]):
    """Simulated drives; its repr is a table."""

    head = ("drive", "log", "images", "seconds")
    is_printed_in_parts: ClassVar = True

    def cells(self, row: SceneFiles) -> tuple[object, ...]:
        """Return the cells of a row."""
        return (row.name, row.log, row.pictures, row.seconds)


def simulate_approach(
    folder: Path | str,
    layout: str = "A",
    run: int = 1,
    seed: int = 0,
    *,
    width_px: int = 1280,
    rate_hz: int = 10,
    overwrite: bool = False,
) -> SceneFiles:
    """Simulate a drive to an intersection, with camera, CAN, Mobileye and truth.

    Args:
        folder: Output folder for ``drive.mcap``, ``vehicle.toml`` and ``truth.json``.
        layout: Layout of the intersection: A to H, or L0, L1, ... for training.
        run: Number of the drive on this layout, from 1.
        seed: Seed of everything that differs between runs.
        width_px: Picture width, a multiple of 16; the height is 9/16 of it.
        rate_hz: Pictures per second: 10, 20, 25 or 50.
        overwrite: Replace an earlier drive.

    Returns:
        Paths of ``log``, ``vehicle`` and ``truth``.

    Raises:
        UsageError: A value is out of range.
        OutputError: The folder already contains a drive, or cannot be written.
    """
    one = Approaches((layout,), run, seed=seed, rate_hz=rate_hz, width_px=width_px)
    return write_scene(Path(folder), one.scenes()[0], overwrite=overwrite)


def simulate_approaches(
    approaches: Approaches, output: Path | str, *, workers: int = 1, overwrite: bool = False
) -> SimulatedDrives:
    """Simulate drives up to intersections: a log with all sensors, and its truth.

    Layouts A to H are those of the published study; L0, L1, ... are random layouts for training.
    The same names and seeds yield the same bytes.

    Examples:
        crosscue simulate A --run 3 -o drives
        crosscue simulate --all -o drives
        crosscue simulate L17 L18 --runs 2 --seed 5 -o training

    Args:
        approaches: The drives to simulate.
        output: Output folder, with one folder per drive.
        workers: Number of drives in parallel.
        overwrite: Replace existing drives.

    Raises:
        UsageError: A value is out of range, a layout is named twice, or a folder has another drive.
        OutputError: A drive already exists, or cannot be written.
    """
    if approaches.has_all == bool(approaches.layouts):
        raise UsageError("simulate: expected layouts (A to H, L0, L1, ..., M0, M1, ...), or --all")
    wanted = approaches.scenes()
    if workers < 1:
        raise UsageError(f"workers: {workers}, expected 1 or more")
    place, made = Path(output), []
    for settings in wanted if overwrite else ():
        refuse_other_drive(place / settings.name, settings)
    make = partial(_write_scene, output=place, overwrite=overwrite)
    for files in in_processes(make, wanted, workers):
        made.append(files)
        emit(files)
        emit(Progress("simulating", len(made), len(wanted), "drives"))
    return SimulatedDrives(made)


def _write_scene(settings: SceneSettings, output: Path, overwrite: bool) -> SceneFiles:
    return write_scene(output / settings.name, settings, overwrite=overwrite)


def simulate_drive(
    folder: Path | str, seed: int = 7, blocks: int = 12, *, overwrite: bool = False
) -> DriveFiles:
    """Simulate a drive through streets without a camera: CAN, gyro, compass and truth.

    Args:
        folder: Output folder for ``drive.mcap``, ``vehicle.toml``, a DBC file and ``truth.json``.
        seed: Seed of all random numbers.
        blocks: Number of street blocks to drive, 120 m each.
        overwrite: Replace an earlier drive.

    Returns:
        Paths of ``log``, ``vehicle`` and ``truth``.

    Raises:
        UsageError: ``blocks`` is below 1.
        OutputError: The folder already contains a drive, or cannot be written.
    """
    if blocks < 1:
        raise UsageError(f"blocks: {blocks}; expected 1 or more")
    settings = DriveSettings(seed=seed, blocks=blocks)
    return write_drive(Path(folder), settings, overwrite=overwrite)
