"""Tests do not touch the cache of the user who runs them."""

from pathlib import Path

from crosscue.datasets.real import recordings
from crosscue.detectors.catalog import places
from crosscue.eval.drives.replay import cache_file
from crosscue.replay.remote.logs import default_store


def test_no_cache_of_a_test_is_the_users() -> None:
    detections = cache_file()
    assert detections is not None
    folders = (
        detections,
        places.model_folder(),
        default_store().folder,
        recordings.recording_folder(recordings.recording("pandaset_002")),
    )

    assert [one for one in folders if Path.home() / ".cache" in one.parents] == []
