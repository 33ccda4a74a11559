"""Fixtures and settings of all tests."""

from __future__ import annotations

import gc
import os

# No test reads or fills the user's own cache; those of the cache name a folder.
os.environ["CROSSCUE_DBC_CACHE"] = "off"
# The tests themselves run side by side, one process a core: threads beside them only wait for each
# other, and OpenMP waits by spinning. Tests about threads ask for a number.
os.environ["OMP_WAIT_POLICY"] = "passive"
for library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(library, "1")


def pytest_collection_finish() -> None:
    """Leave what is imported and collected out of every later search for garbage."""
    gc.collect()
    gc.freeze()
