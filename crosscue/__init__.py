"""Replay a recorded drive, score every cue and the pose, and see it in Rerun.

The six packages ``replay``, ``detectors``, ``fusion``, ``localization``, ``datasets`` and ``eval``
lie at the top of the repository and are linked here, so that only ``crosscue`` is ever installed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

_LINKED: Final = ("replay", "detectors", "fusion", "localization", "datasets", "eval")


def _broken_links(folder: Path) -> list[str]:
    """Names of linked packages that are no folders here."""
    return [name for name in _LINKED if not (folder / name).is_dir()]


if _missing := _broken_links(Path(__file__).parent):
    raise ImportError(
        f"crosscue/{_missing[0]} is not a folder: this checkout has no symbolic links (a Windows "
        "checkout, or a zip download unpacked without them); expected links to the folders beside "
        "crosscue/; try 'git config core.symlinks true' and 'git checkout -- crosscue', or "
        "'pip install' a wheel"
    )
