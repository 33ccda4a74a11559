"""Report of runs: one HTML file without network access or scripts.

All text from logs, truth or settings is escaped. The same runs and scores yield the same bytes.
"""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from crosscue.eval.runs.candidates import CandidateRow, candidate_lines, not_looked_lines
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import DriveManifest, EstimateManifest
from crosscue.eval.runs.moments import span_ns
from crosscue.eval.runs.stored_images import run_camera
from crosscue.eval.runs.tables.log_time import gaps_of
from crosscue.eval.scoring.drives import PooledScores
from crosscue.eval.scoring.runs import RunScored
from crosscue.localization.camera_watch import steps_of, windows_of
from crosscue.replay.files.tree_text import spelled, strict_json
from crosscue.replay.vehicle.cue_table import CUES

from . import scene_figures
from .frame_pictures import draw_pictures
from .html import number, write_page
from .opening import Mistake, Opening, curves_of, opening_of
from .pose_figures import Figure, pose_figures, track_figures

REPORT: Final = "report.html"
TEMPLATE: Final = "page.html.j2"
# Rows of the visual odometry over which its pitch is filtered.
FILTERED: Final = 4
# Max number of approaches with their own chart.
BELIEFS: Final = 12
# Max number of failures with their pictures.
MAX_FRAMES: Final = 6


@dataclass(frozen=True, slots=True)
class _Run:
    name: str
    path: str
    manifest: DriveManifest
    clocks: str
    candidates: Mapping[str, CandidateRow]
    ranged: Mapping[str, CandidateRow]
    skips: Sequence[str]
    pitch: Sequence[str]
    steps: Sequence[str]
    settings: str
    versions: str


@dataclass(frozen=True, slots=True)
class _Figures:
    distances: Markup | None
    beliefs: tuple[Figure, ...]
    beliefs_left_out: int
    reliability: Markup | None
    range: Markup | None
    range_is_traced: bool
    pose: tuple[Figure, ...] = ()


NO_FIGURES: Final = _Figures(None, (), 0, None, None, False)


def write_report(
    folder: Path,
    scored: Sequence[RunScored],
    scores: PooledScores,
    metrics: Mapping[str, Any],
    mistakes: Sequence[Mistake] = (),
    *,
    has_figures: bool = True,
) -> Path:
    """Write ``report.html`` of one run or many.

    Args:
        folder: Output folder; for one run its ``score`` folder.
        scored: All runs, at least one.
        scores: Pooled scores of all runs.
        metrics: Metrics from ``metrics_of``, with additions of the command.
        mistakes: Failures of the runs in the order in which they are shown.
        has_figures: Draw charts; tables and pictures are always written.

    Raises:
        RunError: A run's manifest or tables cannot be read.
        OutputError: A file cannot be written.
    """
    drawn = _drawn(scored, mistakes[:MAX_FRAMES])
    content = _content([one.run for one in scored], metrics) | {
        "sources": sorted({one.truth.truth.source for one in scored}),
        "simulated": sum(map(_is_simulated, scored)),
        "opening": _opening(scored, scores, mistakes),
        "frames": [(one, drawn.get((one.run, one.t_ns), "")) for one in mistakes[:MAX_FRAMES]],
        "figures": _figures(scored, scores) if has_figures else NO_FIGURES,
    }
    write_page(folder / REPORT, TEMPLATE, content)
    return folder / REPORT


def _drawn(
    scored: Sequence[RunScored], mistakes: Sequence[Mistake]
) -> Mapping[tuple[str, int], str]:
    """Return the pictures of mistakes by run and time, with what is true beside what was found."""
    found: dict[tuple[str, int], str] = {}
    for one in scored:
        name = str(one.run.path)
        times = [mistake.t_ns for mistake in mistakes if mistake.run == name]
        if not times or run_camera(one.run) is None:
            continue

        def keep(t_ns: int, picture: bytes, _: bytes, name: str = name) -> None:
            found[name, t_ns] = base64.b64encode(picture).decode()

        draw_pictures(one.run, times, keep, truth=one.truth_path)
    return found


def write_report_without_truth(run: RunFolder, path: Path, threshold: float) -> None:
    """Write the report of a run whose truth is unknown: what was found, where, and how sure.

    Args:
        run: A finished run.
        path: The page.
        threshold: Probability above which a feature is believed.

    Raises:
        RunError: The run's manifest or tables cannot be read.
        OutputError: The file cannot be written.
    """
    nothing: dict[str, Any] = {"not_scored": {}, "frames": 0, "frames_ambiguous": 0}
    metrics: dict[str, Any] = {
        "coverage": nothing,
        "account": {"scoring": {}},
        "cues": {},
        "belief": {},
        "range": {},
        "settings": {},
        "approaches": None,
        "pose": None,
    }
    curves, cues = curves_of(run)
    gaps = gaps_of(run.drive_manifest().timeline)
    charts = tuple(
        Figure(
            scene_figures.draw_belief(curve, cues, threshold, gaps),
            f"{curve.intersection}. Dashed: believed above it.",
        )
        for curve in curves[:BELIEFS]
    )
    logs = run.drive_manifest().logs
    content = _content([run], metrics) | {
        "sources": (),
        "simulated": int(all(log.is_simulated for log in logs)),
        "opening": opening_of(run, threshold),
        "frames": (),
        "figures": replace(
            NO_FIGURES,
            beliefs=charts,
            beliefs_left_out=len(curves[BELIEFS:]),
            pose=track_figures(run, gaps),
        ),
    }
    write_page(path, TEMPLATE, content)


def _opening(
    scored: Sequence[RunScored], scores: PooledScores, mistakes: Sequence[Mistake]
) -> Opening:
    if len(scored) == 1:
        return opening_of(scored[0].run, scores.settings.threshold, scored[0], mistakes)
    of = scores.approaches
    if of is None:
        return Opening(())
    detected, full, false = of.detected, of.full, of.false_features
    detected_m, full_m = number(of.detected_m.value, 1), number(of.full_m.value, 1)
    found = (
        f"{detected.right} of {detected.of} intersections found, {detected_m} m ahead on average"
    )
    whole = f"all their roads in {full.right}, {full_m} m ahead"
    wrong = f"A road that is not there was believed in {false.right} of {false.of}."
    return Opening((f"{found}; {whole}. {wrong}",))


def _is_simulated(one: RunScored) -> bool:
    """Return whether the run's manifest or the truth states that the drive is simulated."""
    logs = one.run.drive_manifest().logs
    return all(log.is_simulated for log in logs) or "simulated" in one.truth.truth.source.lower()


def _content(folders: Sequence[RunFolder], metrics: Mapping[str, Any]) -> dict[str, Any]:
    runs = [_run(one) for one in folders]
    cues = [_cue(name, one) for name, one in metrics["cues"].items()]
    pose = metrics["pose"]
    is_alone = len(folders) == 1
    accounts = [account for run in runs for account in run.manifest.account.reading]
    return {
        "title": runs[0].name if is_alone else f"{len(runs)} drives",
        "runs": runs,
        "failed": metrics["coverage"].get("failed", {}),
        "same_log": metrics["coverage"].get("same_log", ()),
        "dropped": sum(not account.is_whole for account in accounts),
        "coverage": metrics["coverage"],
        "scoring": metrics["account"]["scoring"],
        "settings": metrics["settings"],
        "approaches": metrics["approaches"],
        "cues": [one for one in cues if one["scored"]],
        "cues_all": cues,
        "belief": metrics["belief"],
        "range_scores": metrics["range"],
        "attribution": metrics.get("attribution"),
        "has_scene": bool(metrics["approaches"] or metrics["belief"]),
        "pose": pose if is_alone else None,
        "poses": None if is_alone else pose,
    }


def _run(run: RunFolder) -> _Run:
    manifest = run.drive_manifest()
    reported = manifest.with_files(run.relative).as_json()
    scene = manifest.scene if isinstance(manifest, EstimateManifest) else None
    candidates, ranged = ({}, {}) if scene is None else (scene.candidates, scene.ranged)
    not_looked_for = {} if scene is None else scene.not_looked_for
    pitch, steps = _pitch(run)
    return _Run(
        name=_name(run),
        path=spelled(str(run.path)),
        manifest=manifest,
        clocks=strict_json(reported["clocks"]),
        candidates=candidates,
        ranged=ranged,
        skips=[*candidate_lines(candidates, ranged), *not_looked_lines(not_looked_for)],
        pitch=pitch,
        steps=steps,
        settings=strict_json(reported["settings"]),
        versions=strict_json({"versions": reported["versions"], "logs": reported["logs"]}),
    )


def _pitch(run: RunFolder) -> tuple[list[str], list[str]]:
    """Return the camera's pitch in every ten seconds, and its steps, where pictures show them."""
    table = run.filled("visual_odometry", ["t_ns", "pitch_rad", "is_standing"])
    if table is None:
        return [], []
    # The pitch is filtered, so that only every few rows are another measurement.
    rows = [row for row in table.to_pylist() if not row["is_standing"]][::FILTERED]
    t_ns = np.array([row["t_ns"] for row in rows], np.int64)
    pitch = np.array([row["pitch_rad"] for row in rows], np.float64)
    start_ns = span_ns(run)[0]
    windows = [
        f"{(one.start_ns - start_ns) * 1e-9:.0f} to {(one.end_ns - start_ns) * 1e-9:.0f} s: {one}"
        for one in windows_of("pitch", t_ns, pitch)
    ]
    steps = [
        f"{one} at {(one.t_ns - start_ns) * 1e-9:.0f} s" for one in steps_of("pitch", t_ns, pitch)
    ]
    return windows, steps


def _name(run: RunFolder) -> str:
    """Return the folder's name, or its parent's if the folder has a generic name."""
    path = run.path.resolve()
    return spelled("/".join(path.parts[-2:]) if path.name.startswith("run") else path.name)


def _cue(name: str, score: Mapping[str, Any]) -> dict[str, Any]:
    """Return a cue's scores with the values published in the dissertation."""
    published = CUES.get(name)
    is_bound = published is not None and published.precision_is_lower_bound
    bound = "at least " if is_bound else ""
    leading = score["readings"][score["reading"]]
    return {
        **score,
        "name": name,
        "frames": leading["frames"],
        "left_out": leading["left_out"],
        "published": "-" if published is None else f"{bound}{published.precision:.2f}",
    }


def _figures(scored: Sequence[RunScored], scores: PooledScores) -> _Figures:
    threshold = scores.settings.threshold
    curves = [
        (one, curve)
        for one in scored
        if one.judged.approaches is not None
        for curve in one.judged.approaches.curves
    ]
    gaps = {one.judged.coverage.drive: gaps_of(one.run.drive_manifest().timeline) for one in scored}
    ranges = [part for one in scored for part in one.judged.ranges]
    tracks = sum(len(set(part.approach.tolist())) for part in ranges)
    results = [] if scores.approaches is None else scores.approaches.results
    return _Figures(
        distances=scene_figures.draw_distances(results) if results else None,
        beliefs=tuple(
            Figure(
                scene_figures.draw_belief(
                    curve, one.judged.cues, threshold, gaps[one.judged.coverage.drive]
                ),
                _report_text(one, curve.intersection),
            )
            for one, curve in curves[:BELIEFS]
        ),
        beliefs_left_out=max(len(curves) - BELIEFS, 0),
        reliability=scene_figures.draw_reliability(scores.belief) if scores.belief else None,
        range=scene_figures.draw_range(ranges, scores.range, gaps) if scores.range else None,
        range_is_traced=tracks <= scene_figures.TRACES,
        pose=() if len(scored) > 1 or scored[0].poses is None else pose_figures(scored[0].poses),
    )


def _report_text(one: RunScored, intersection: str) -> str:
    return f"{_name(one.run)}: approach to {intersection}. Dashed: established above it."
