"""Simulate drives with truth from a seed; nothing is downloaded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.interface.show import Listing
from crosscue.replay.base import OutputError, UsageError

if TYPE_CHECKING:
    from crosscue.datasets.scenes.drive import SceneFiles
    from crosscue.datasets.scenes.settings import SceneSettings
    from crosscue.datasets.simulated.log_files import DriveFiles
    from crosscue.replay.base import Bytes


class SimulatedDrives(Listing["SceneFiles"]):
    """Simulated drives; its repr is a table."""

    head = ("drive", "log", "images", "seconds")

    def cells(self, row: SceneFiles) -> tuple[object, ...]:
        """Return the cells of a row."""
        return (row.log.parent.name, row.log, row.pictures, row.seconds)

    def as_dict(self) -> list[dict[str, object]]:
        """Return the JSON output of ``crosscue simulate``."""
        return [
            {
                "name": one.log.parent.name,
                "log": str(one.log),
                "vehicle": str(one.vehicle),
                "truth": str(one.truth),
                "pictures": one.pictures,
                "seconds": one.seconds,
            }
            for one in self
        ]


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
    from crosscue.datasets.scenes.drive import write_scene

    (settings,) = _scenes((layout,), (run,), seed, width_px, rate_hz)
    return write_scene(Path(folder), settings, overwrite=overwrite)


def simulate_approaches(
    folder: Path | str,
    layouts: Sequence[str],
    runs: Sequence[int] = (1,),
    seed: int = 0,
    *,
    width_px: int = 1280,
    rate_hz: int = 10,
    workers: int = 1,
    overwrite: bool = False,
    on_drive: Callable[[SceneFiles, int, int], None] = lambda files, done, of: None,
) -> SimulatedDrives:
    """Simulate every run of every layout; see ``simulate_approach``.

    Args:
        folder: Output folder, with one folder per drive.
        layouts: Layouts of the intersections.
        runs: Numbers of the drives on each layout.
        seed: Seed of everything that differs between runs.
        width_px: Picture width, a multiple of 16; the height is 9/16 of it.
        rate_hz: Pictures per second: 10, 20, 25 or 50.
        workers: Number of drives in parallel.
        overwrite: Replace drives of the same settings.
        on_drive: Called with each drive after it is written, the number of drives done, and their
            total.

    Raises:
        UsageError: A value is out of range, a layout is named twice, or a folder has another drive.
        OutputError: A drive already exists, or cannot be written.
    """
    from crosscue.datasets.scenes.drive import refuse_other_drive
    from crosscue.replay.processes import in_processes

    if workers < 1:
        raise UsageError(f"--workers {workers}: expected 1 or more")
    wanted, place = _scenes(layouts, runs, seed, width_px, rate_hz), Path(folder)
    for settings in wanted if overwrite else ():
        refuse_other_drive(place / settings.name, settings)
    make = partial(_write_scene, output=place, overwrite=overwrite)
    made: list[SceneFiles] = []
    for files in in_processes(make, wanted, workers):
        made.append(files)
        on_drive(files, len(made), len(wanted))
    return SimulatedDrives(made)


def draw_contact_sheet(
    path: Path | str,
    layouts: Sequence[str],
    runs: Sequence[int] = (1,),
    seed: int = 0,
    *,
    width_px: int = 1280,
    rate_hz: int = 10,
    overwrite: bool = False,
) -> tuple[str, ...]:
    """Draw a contact sheet with one picture per simulated drive.

    Args:
        path: JPEG file to write.
        layouts: As in ``simulate_approaches``.
        runs: As in ``simulate_approaches``.
        seed: As in ``simulate_approaches``.
        width_px: As in ``simulate_approaches``.
        rate_hz: As in ``simulate_approaches``.
        overwrite: Replace an existing file.

    Returns:
        Names of the drives.

    Raises:
        UsageError: A value is out of range.
        OutputError: The file exists, or cannot be written.
    """
    from crosscue.datasets.scenes.export.contact_sheet import contact_sheet, sheet_jpeg
    from crosscue.replay.base import write_bytes

    wanted, sheet = _scenes(layouts, runs, seed, width_px, rate_hz), Path(path)
    if sheet.exists() and not overwrite:
        raise OutputError(f"{sheet}: exists; give another name or --overwrite")
    columns = len({(one.run, one.seed) for one in wanted})
    write_bytes(sheet, sheet_jpeg(contact_sheet(wanted, columns)))
    return tuple(one.name for one in wanted)


def _write_scene(settings: SceneSettings, output: Path, overwrite: bool) -> SceneFiles:
    from crosscue.datasets.scenes.drive import write_scene

    return write_scene(output / settings.name, settings, overwrite=overwrite)


def _scenes(
    layouts: Sequence[str], runs: Sequence[int], seed: int, width_px: int, rate_hz: int
) -> list[SceneSettings]:
    """Return the settings of every run of every layout.

    Raises:
        UsageError: A value is out of range, or a layout is named twice.
    """
    from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width

    if len(set(layouts)) != len(layouts):
        raise UsageError("simulate: a layout is named twice; name each once")
    camera = camera_of_width(width_px)
    try:
        return [
            SceneSettings(layout=layout, run=run, seed=seed, rate_hz=rate_hz, camera=camera)
            for layout in layouts
            for run in runs
        ]
    except ValueError as error:
        raise UsageError(f"simulate: {error}") from None


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
    from crosscue.datasets.simulated.drive import DriveSettings
    from crosscue.datasets.simulated.log_files import write_drive

    if blocks < 1:
        raise UsageError(f"blocks: {blocks}; expected 1 or more")
    settings = DriveSettings(seed=seed, blocks=blocks)
    return write_drive(Path(folder), settings, overwrite=overwrite)


def draw_sign(kind: str, height_px: int) -> Bytes:
    """Draw the template of a sign, to compose test pictures.

    Args:
        kind: ``one way left``, ``one way right``, ``do not enter`` or ``no entry``.
        height_px: Height of the sign.

    Returns:
        Grey picture, uint8, shape (H, W).

    Raises:
        UsageError: The sign does not exist, or ``height_px`` is too small.
    """
    from crosscue.detectors.signs.templates import KINDS, MARGIN_PX, draw

    known = next((one for one in KINDS if one == kind), None)
    if known is None:
        raise UsageError(f"kind: expected one of {', '.join(KINDS)}; found {kind!r}")
    try:
        return draw(known, height_px).grey[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
    except ValueError as error:
        raise UsageError(f"draw_sign: {error}") from None
