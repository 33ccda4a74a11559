"""Simulated drives with truth, made on this machine from a seed; nothing is downloaded."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.replay.base import UsageError

if TYPE_CHECKING:
    from crosscue.datasets.scenes.drive import SceneFiles
    from crosscue.datasets.simulated.log_files import DriveFiles
    from crosscue.replay.base import Bytes


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
    """Simulate a drive up to an intersection, with camera, CAN, Mobileye and truth.

    Args:
        folder: Gets ``drive.mcap``, ``vehicle.toml`` and ``truth.json``.
        layout: Which intersection: A to H, or L0, L1, ... to learn from.
        run: Which drive up to it, from 1.
        seed: Of what differs from run to run.
        width_px: Of a picture, a multiple of 16; it is 9/16 high.
        rate_hz: Pictures a second: 10, 20, 25 or 50.
        overwrite: Replace an earlier drive.

    Returns:
        Paths of ``log``, ``vehicle`` and ``truth``.

    Raises:
        UsageError: A value out of range.
        OutputError: The folder holds a drive already, or cannot be written.
    """
    from crosscue.datasets.scenes.drive import SceneSettings, write_scene
    from crosscue.datasets.scenes.rendering.camera import Camera

    if not 64 <= width_px <= 3840 or width_px % 16:
        raise UsageError(f"width_px: {width_px}; expected a multiple of 16 from 64 to 3840")
    camera = Camera(width_px=width_px, height_px=width_px * 9 // 16)
    try:
        settings = SceneSettings(layout, run, seed, rate_hz, camera)
    except ValueError as error:
        raise UsageError(f"simulate_approach: {error}") from None
    return write_scene(Path(folder), settings, overwrite=overwrite)


def simulate_drive(
    folder: Path | str, seed: int = 7, blocks: int = 12, *, overwrite: bool = False
) -> DriveFiles:
    """Simulate a drive through streets without a camera: CAN, gyro, compass and truth.

    Args:
        folder: Gets ``drive.mcap``, ``vehicle.toml``, a DBC file and ``truth.json``.
        seed: Everything random comes from it.
        blocks: Street blocks driven, 120 m each.
        overwrite: Replace an earlier drive.

    Returns:
        Paths of ``log``, ``vehicle`` and ``truth``.

    Raises:
        OutputError: The folder holds a drive already, or cannot be written.
    """
    from crosscue.datasets.simulated.drive import DriveSettings
    from crosscue.datasets.simulated.log_files import write_drive

    if blocks < 1:
        raise UsageError(f"blocks: {blocks}; expected 1 or more")
    settings = DriveSettings(seed=seed, blocks=blocks)
    return write_drive(Path(folder), settings, overwrite=overwrite)


def draw_sign(kind: str, height_px: int) -> Bytes:
    """A sign as the detector knows it, grey, uint8 of shape (H, W), to make test pictures of.

    Args:
        kind: ``one way left``, ``one way right``, ``do not enter`` or ``no entry``.
        height_px: Of the sign.

    Raises:
        UsageError: No such sign, or too low.
    """
    from crosscue.detectors.signs.templates import KINDS, MARGIN_PX, draw

    known = next((one for one in KINDS if one == kind), None)
    if known is None:
        raise UsageError(f"kind: {kind!r}; there are: {', '.join(KINDS)}")
    try:
        return draw(known, height_px).grey[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
    except ValueError as error:
        raise UsageError(f"draw_sign: {error}") from None
