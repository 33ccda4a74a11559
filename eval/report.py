"""The report of a scored run: one HTML file that needs no network and runs no script."""

from __future__ import annotations

import base64
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Final

from crosscue.datasets.truth import Truth
from crosscue.replay.run_folder import RunFolder, strict_json, write_text

from .score_pose import PoseScore

FIGURES: Final = {
    "pose_plan.png": "True and estimated track, with the 2-sigma ellipse at twelve moments.",
    "pose_error.png": "Distance from the truth, and what the filter claims.",
    "pose_heading.png": "Heading error, and what the filter claims.",
    "pose_nees.png": "Squared error in units of the claimed covariance; the band holds 95 % of it "
    "where claims are honest.",
    "pose_major_axis.png": "Length of the 2-sigma ellipse against distance travelled.",
}


@dataclass(frozen=True, slots=True)
class _Figure:
    base64: str
    caption: str


def write_report(run: RunFolder, truth: Truth, pose: PoseScore) -> Path:
    """Write ``score/report.html``; its path comes back.

    Raises:
        RunError: The run's manifest cannot be read.
        OutputError: It cannot be written.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    source = files("crosscue.eval").joinpath("report.html.j2").read_text(encoding="utf-8")
    manifest = run.manifest()
    scored = asdict(pose)
    page = environment.from_string(source).render(
        run=run.path.name,
        logs=manifest["logs"],
        truth=truth,
        simulated="simulated" in truth.source.lower(),
        pose=scored,
        plain=scored["ape"]["none"],
        yaw=scored["ape"]["yaw"],
        accounts=manifest["accounts"],
        notices=manifest["notices"],
        figures=list(_figures(run.file("score"))),
        clocks=strict_json(manifest["clocks"]),
        settings=strict_json(manifest["settings"]),
        versions=strict_json({"versions": manifest["versions"], "logs": manifest["logs"]}),
    )
    path = run.file("score") / "report.html"
    write_text(path, page)
    return path


def _figures(folder: Path) -> list[_Figure]:
    return [
        _Figure(base64.b64encode((folder / name).read_bytes()).decode(), caption)
        for name, caption in FIGURES.items()
        if (folder / name).exists()
    ]
