"""Import OpenVINO without its telemetry.

Importing OpenVINO (up to 2026.4) creates a client number in the home folder and sends an event to
Google Analytics from a separate process; converting a model sends more. This happens without
consent, and only a file in the home folder or an environment variable of CI machines prevents it.
If the telemetry package cannot be imported, OpenVINO uses a stub that sends nothing.
"""

import sys
from importlib import import_module
from typing import Any, Final

TELEMETRY: Final = "openvino_telemetry"


def import_openvino() -> Any:
    """Import the package ``openvino``.

    A telemetry package that the program has already imported remains in use.

    Raises:
        ModuleNotFoundError: The package is not installed.
    """
    # An entry None makes the import of the module fail.
    sys.modules.setdefault(TELEMETRY, None)  # type: ignore[arg-type]
    return import_module("openvino")
