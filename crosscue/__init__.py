"""Replay a recorded drive, score every cue and the pose, and view it in Rerun.

The stub ``__init__.pyi`` lists the public interface, whose changes are recorded in the changelog.
Each name is imported when it is first used, so ``import crosscue`` is fast.

The six packages ``replay``, ``detectors``, ``fusion``, ``localization``, ``datasets`` and ``eval``
are at the top of the repository and are linked here, so that only ``crosscue`` is installed.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Final

_LINKED: Final = ("replay", "detectors", "fusion", "localization", "datasets", "eval")


def _broken_links(folder: Path) -> list[str]:
    """Return the names of linked packages that are not folders here."""
    return [name for name in _LINKED if not (folder / name).is_dir()]


if _missing := _broken_links(Path(__file__).parent):
    raise ImportError(
        f"crosscue/{_missing[0]} is not a folder: this checkout has no symbolic links (a Windows "
        "checkout, or a zip download unpacked without them); expected links to the folders next to "
        "crosscue/; try 'git config core.symlinks true' and 'git checkout -- crosscue', or "
        "'pip install' a wheel"
    )


def _public() -> dict[str, str]:
    """Return the module of each public name, from the stub next to this file."""
    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    found = re.findall(r"^from (\S+) import \(?\s*(\w+)", stub, re.MULTILINE)
    return {name: module for module, name in found}


_MODULES: Final = _public()
__all__ = [*_MODULES]


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name == "__version__":
        found = import_module("crosscue.replay.versions").installed("crosscue")
    elif name in _MODULES:
        is_module = _MODULES[name] == "crosscue"
        module = import_module(f"crosscue.{name}" if is_module else _MODULES[name])
        found = module if is_module else getattr(module, name)
    else:
        raise AttributeError(f"module 'crosscue' has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
