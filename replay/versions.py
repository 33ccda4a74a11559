"""Versions of what is installed, for manifests, model cards and ``crosscue --version``."""

from __future__ import annotations

import platform


def installed(package: str) -> str:
    """The version of ``package``, or "unknown" where its metadata is missing or not readable."""
    from importlib.metadata import version  # 20 ms, which ``crosscue --help`` need not wait for

    try:
        return version(package)
    except ImportError:
        return "unknown"


def versions() -> dict[str, str]:
    """Of crosscue, Python and the libraries that results depend on."""
    libraries = ("crosscue", "numpy", "numba", "cantools", "rosbags", "mcap", "pyarrow")
    return {"python": platform.python_version(), **{name: installed(name) for name in libraries}}
