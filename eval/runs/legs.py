"""What a run says of the roads of an intersection, frame by frame, as text for its pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping

from crosscue.fusion.factor_graph import graph_of
from crosscue.replay.colours import FEATURES

from .folder import RunFolder
from .manifest import EstimateManifest, SceneSummary

NO_CUE = "no cue shows it"


def leg_texts(run: RunFolder) -> Mapping[int, tuple[str, ...]]:
    """Return for each frame of an approach its beliefs, and the roads not seen, with the reasons.

    A road is not seen while its probability is the prior, which no cue has changed.

    Args:
        run: A finished run, or a part of one.

    Returns:
        One line for the beliefs, and one for each reason, by time of the frame.

    Raises:
        RunError: A table or the manifest is damaged.
    """
    manifest, table = run.drive_manifest(), run.filled("belief")
    if table is None or not isinstance(manifest, EstimateManifest) or manifest.scene is None:
        return {}
    features = graph_of(manifest.settings.fusion).features
    shown = FEATURES.keys() & {*table.column_names}
    priors = {one.name: one.prior for one in features if one.name in shown}
    whys = {name: why_not_seen(manifest.scene, name) for name in priors}
    found = {}
    for row in table.select(["t_ns", *priors]).to_pylist():
        believed, unseen = [], dict[str, list[str]]()
        for name, prior in priors.items():
            if name != "intersection" and math.isclose(row[name], prior):
                unseen.setdefault(whys[name], []).append(name)
            else:
                believed.append(f"{name} {row[name]:.2f}")
        lines = [f"{', '.join(names)} not seen: {why}" for why, names in unseen.items()]
        found[row["t_ns"]] = (", ".join(believed), *lines)
    return found


def why_not_seen(scene: SceneSummary, feature: str) -> str:
    """Return the reason why the road cue of a leg says nothing, where no cue shows the leg."""
    cue = f"road_{feature}"
    row = scene.candidates.get(cue)
    if row is not None and row.skipped:
        why = max(row.skipped, key=lambda one: row.skipped[one])
        return why.removeprefix("not seen: ")
    return scene.not_looked_for.get(cue, NO_CUE)
