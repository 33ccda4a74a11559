"""Versions of installed packages, found or not."""

from __future__ import annotations

import numpy as np

from crosscue.replay.base import installed


def test_a_version_is_that_of_what_is_installed() -> None:
    assert installed("numpy") == np.__version__


def test_a_package_that_cannot_be_looked_up_is_unknown() -> None:
    assert installed("no-such-package-of-ours") == "unknown"
