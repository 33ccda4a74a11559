"""Features without an observation are reported as not seen, which differs from improbable."""

from __future__ import annotations

import pytest

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import EstimateManifest, SceneSummary
from support.gap_drive import Clock, GreyNumber, replayed, write_drive


@pytest.fixture(scope="module", params=[True, False], ids=["declared labels", "undeclared labels"])
def run(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A drive to a single stop sign, with a detector that declares its labels or does not."""
    folder = tmp_path_factory.mktemp("drive")
    with pytest.MonkeyPatch.context() as patch:
        if request.param:
            patch.setattr(GreyNumber, "labels", ("stop sign",), raising=False)
        return replayed(folder, write_drive(folder, Clock()), "run")


def scene_of(run: RunFolder) -> SceneSummary:
    manifest = run.drive_manifest()
    assert isinstance(manifest, EstimateManifest)
    assert manifest.scene is not None
    return manifest.scene


def test_side_roads_are_not_seen_if_detector_cannot_find_cars(run: RunFolder) -> None:
    scene = scene_of(run)
    (approach,) = scene.approaches

    were_looked_for = "cross_traffic_left" not in scene.not_looked_for
    assert approach.not_seen == (
        ("straight",) if were_looked_for else ("left", "right", "straight")
    )
    assert approach.probabilities["intersection"] > 0.9


def test_only_features_not_seen_keep_prior_in_every_row(run: RunFolder) -> None:
    rows = run.table("belief").to_pydict()
    (approach,) = scene_of(run).approaches

    for feature in ("intersection", "left", "right", "straight"):
        assert (len(set(rows[feature])) == 1) == (feature in approach.not_seen)
