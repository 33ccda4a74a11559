"""Tests that sign drawings do not depend on OpenCV's version and fonts."""

import hashlib

from crosscue.detectors.signs.templates import drawings


def test_detector_drawings_do_not_depend_on_the_opencv_version() -> None:
    grey = b"".join(one.grey.tobytes() for one in drawings())

    assert hashlib.sha256(grey).hexdigest()[:12] == "43c98c5fd7d6"
