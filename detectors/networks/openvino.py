"""OpenVINO without its telemetry.

Importing OpenVINO (2026.4 and before) makes a client number in the home folder and sends an event
to Google Analytics, from a process of its own; converting a model sends more. Nobody is asked, and
nothing short of a file in the home folder or a variable that says this is a CI machine stops it.
Where its telemetry package cannot be imported, OpenVINO takes a stand-in that sends nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from typing import Any, Final

TELEMETRY: Final = "openvino_telemetry"


def import_openvino() -> Any:
    """The package ``openvino``.

    A telemetry package that a program has imported before stays: that is its own choice.

    Raises:
        ModuleNotFoundError: It is not installed.
    """
    # None in this table is how Python learns that a module cannot be imported.
    sys.modules.setdefault(TELEMETRY, None)  # type: ignore[arg-type]
    return import_module("openvino")
