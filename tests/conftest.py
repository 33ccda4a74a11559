"""Fixtures and settings of all tests."""

import atexit
import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from support.range_server import Served, serving

# Tests and their commands do not read or fill the user's cache; tests of a cache name a folder.
CACHE = tempfile.mkdtemp(prefix="crosscue-tests-")
atexit.register(shutil.rmtree, CACHE, ignore_errors=True)
os.environ.setdefault("MPLCONFIGDIR", str(Path.home() / ".cache" / "matplotlib"))
os.environ["XDG_CACHE_HOME"] = CACHE
os.environ["CROSSCUE_DBC_CACHE"] = "off"
# Tests run in parallel, one process per core. Further threads would only wait for each other, and
# OpenMP waits by spinning. Tests of threads set a number.
os.environ["OMP_WAIT_POLICY"] = "passive"
for library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(library, "1")

# An example of a law may take any time. Every run draws the same ones, so that a gate is red for
# a change and not by chance. CROSSCUE_FRESH_EXAMPLES=1 draws others.
settings.register_profile(
    "laws",
    settings.default,
    deadline=None,
    derandomize="CROSSCUE_FRESH_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
settings.load_profile("laws")


def pytest_collection_finish() -> None:
    """Exclude imported modules and collected tests from later garbage collections."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def web(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    """Start a web server; complete logs are stored in ``tmp_path/store``."""
    pytest.importorskip("aiohttp", reason="aiohttp, by which fsspec reads from the web, is missing")
    monkeypatch.setenv("CROSSCUE_STORE", str(tmp_path / "store"))
    with serving() as served:
        yield served
