"""Compare run folders with their truth, and pool their scores."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from crosscue.datasets.truth.truth import FILE, Truth
from crosscue.eval.runs.account import (
    Line,
    ScoredAccount,
    SummedAccount,
    check_account,
    line,
    sum_accounts,
)
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.logs import log_location
from crosscue.eval.runs.manifest import EstimateManifest, LogRow
from crosscue.eval.runs.tables.travelled import odometer_of
from crosscue.eval.scoring.pose.errors import FilterAndSmoother
from crosscue.eval.scoring.scene.ranges import score_smoothed
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import RunError, SchemaError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, spelled, strict_json
from crosscue.replay.files.whole_file import file_sha256, write_text
from crosscue.replay.remote.address import is_remote

from . import intervals
from . import truth as score_truth
from .columns import AMBIGUOUS, NONE, RunTables
from .drives import (
    DEFAULTS,
    DriveJudged,
    PooledScores,
    ScoreSettings,
    as_metrics,
    pool_scores,
    score_drive,
)
from .places import group_places
from .pose import score as score_pose
from .pose.score import PoseScore, ScoredPoses
from .run_tables import in_log_time
from .truth import DriveTruth

# Truth with which a run was scored.
TRUTH_FILE: Final = "score/truth_file.json"
# Tables of a run that are scored.
TABLES: Final = ("frames", "cues", "range", "belief")
# Tolerance for approaches outside the run, because clocks and last pictures differ a little.
SLACK_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True)
class RunScored:
    """One run, compared with its truth.

    Attributes:
        run: Folder of the run.
        truth_path: Path of the truth file.
        truth: The truth.
        judged: Comparison of everything but the pose.
        pose: Scores of the pose; None if it was not scored.
        poses: Poses for figures; None if the pose was not scored.
        why_no_pose: Reason why the pose was not scored; empty if it was.
    """

    run: RunFolder
    truth_path: Path
    truth: DriveTruth
    judged: DriveJudged
    pose: PoseScore | None
    poses: ScoredPoses | None
    why_no_pose: str


class RememberedTruth(NamedTuple):
    """Truth with which a run was scored, and whether it may be that of another file."""

    path: Path
    any_log: bool


class SceneJudged(NamedTuple):
    """Comparison of a run with its truth, without the pose."""

    truth: DriveTruth
    judged: DriveJudged


def find_truth(run: RunFolder, given: Path | None) -> Path:
    """Return the given truth file, the one of the last score, or the one next to (or in) a log.

    Raises:
        UsageError: No truth file is given, and none exists.
        RunError: The manifest cannot be read.
    """
    if given is not None:
        return given / FILE if given.is_dir() else given
    known = _remembered(run)
    if known is not None:
        return known[0].path
    folders: list[str] = []
    for log in run.drive_manifest().logs:
        if is_remote(log.path):
            continue
        path = _place(run, log)
        for folder in (path, path.parent):
            if (folder / FILE).is_file():
                return folder / FILE
            folders.append(str(folder))
    raise UsageError(
        f"{run.path}: no {FILE} next to its logs ({', '.join(folders)}); name it with --truth"
    )


def remember_truth(run: RunFolder, truth_path: Path, *, any_log: bool) -> None:
    """Record with which truth a run was scored, for the commands that look at it afterwards.

    Raises:
        OutputError: The file cannot be written.
    """
    tree = {"path": run.relative(truth_path), "sha256": file_sha256(truth_path), "any_log": any_log}
    write_text(run.file(TRUTH_FILE), strict_json(tree) + "\n")


def remembered_truth(run: RunFolder) -> RememberedTruth | None:
    """Return the truth with which a run was last scored; None if it was not, or the file is gone.

    Raises:
        SchemaError: The truth has changed since.
    """
    found = _remembered(run)
    if found is None:
        return None
    truth, sha256 = found
    if file_sha256(truth.path) != sha256:
        raise SchemaError(
            f"{truth.path}: changed since {run.path} was scored with it; score it again, or name a "
            "truth with --truth"
        )
    return truth


def _remembered(run: RunFolder) -> tuple[RememberedTruth, str] | None:
    """Return the truth of the last score with the hash that it had, if its file is still there."""
    try:
        tree = json_tree(door.read(run.file(TRUTH_FILE)))
        truth = RememberedTruth(run.absolute(tree["path"]), bool(tree["any_log"]))
        sha256 = str(tree["sha256"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return (truth, sha256) if truth.path.is_file() else None


def _place(run: RunFolder, log: LogRow) -> Path:
    """Return the present or former path of a log, whose truth may still be there."""
    try:
        return Path(log_location(run, log))
    except RunError:
        return Path(os.path.normpath(run.absolute(log.path)))


def judge_run(
    run: RunFolder, truth_path: Path, settings: ScoreSettings = DEFAULTS, *, any_log: bool = False
) -> RunScored:
    """Compare a run with its truth; write pose tracks to its ``score`` folder.

    Args:
        run: A finished run.
        truth_path: Its truth.
        settings: Settings of the scores.
        any_log: Accept truth made for another file of the same drive, such as a converted log.

    Raises:
        RunError: A table is damaged, or the run contains merged drives.
        SchemaError: The truth does not fit the run, or there is nothing to score.
    """
    truth, judged = judge_scene(run, truth_path, settings, any_log=any_log)
    why = _why_no_pose(run, truth.truth)
    pose, poses = (None, None) if why else score_pose.measure_pose(run, truth_path)
    nothing = judged.coverage.not_scored
    if why and {"cues", "belief", "range"} <= nothing.keys():
        reasons = "; ".join(dict.fromkeys([*nothing.values(), why]))
        raise SchemaError(f"{truth_path}: nothing of {run.path} can be scored: {reasons}")
    return RunScored(run, truth_path, truth, judged, pose, poses, why)


def judge_scene(
    run: RunFolder, truth_path: Path, settings: ScoreSettings = DEFAULTS, *, any_log: bool = False
) -> SceneJudged:
    """Compare everything but the pose of a run with its truth; nothing is written.

    Raises:
        RunError: A table is damaged, or the run contains merged drives.
        SchemaError: The truth does not fit the run.
    """
    run.drive_manifest()
    truth = score_truth.read_scored_truth(truth_path, spelled(str(run.path)))
    refuse_own_map(run, truth.truth, truth_path)
    if not any_log:
        _check_log(run, truth.truth, truth_path)
    tables = read_run_tables(run)
    _check_times(run, truth.truth, tables, truth_path)
    return SceneJudged(truth, score_drive(tables, truth, settings))


def refuse_own_map(run: RunFolder, truth: Truth, path: Path) -> None:
    """Refuse truth from the map that the run used as a cue.

    Raises:
        UsageError: It is from that map.
    """
    manifest = run.drive_manifest()
    used = manifest.map_sha256 if isinstance(manifest, EstimateManifest) else None
    if used is not None and used == truth.map_sha256:
        raise UsageError(
            f"{path}: its approaches are from the map that {run.path} used as a cue; use another "
            "truth, or replay without road_map in the vehicle file"
        )


def read_run_tables(run: RunFolder) -> RunTables:
    """Read a run's tables; a missing one becomes None.

    Raises:
        RunError: A table is damaged or has other columns.
    """
    timeline = run.drive_manifest().timeline
    found = {name: run.table(name) for name in TABLES if run.file(f"{name}.parquet").exists()}
    return in_log_time(spelled(str(run.path)), found, timeline)


def smoothed_ranges(one: RunScored) -> dict[str, FilterAndSmoother]:
    """Return errors of the range filter and of its smoother, by reference."""
    return score_smoothed(read_run_tables(one.run), one.truth, odometer_of(one.run))


def _check_log(run: RunFolder, truth: Truth, path: Path) -> None:
    reported = set(truth.log_sha256.values())
    logs = run.drive_manifest().logs
    found = {digest for log in logs for digest in log.sha256.values()}
    if reported and logs and not found:
        raise SchemaError(
            f"{path}: identifies its log by hash, but the run has no hash, because it read only "
            "parts of its log; replay the complete log, or use --any-log for the same drive"
        )
    if reported and not reported & found:
        names = ", ".join(log.name for log in logs)
        raise SchemaError(
            f"{path}: belongs to another {truth.log or 'log'} by its hash, not to {names}; "
            "use the truth of that log, or --any-log for another file of the same drive"
        )


def _check_times(run: RunFolder, truth: Truth, tables: RunTables, path: Path) -> None:
    """Refuse truth with an approach completely outside a run of the complete log.

    Truth whose time does not overlap with the run's at all is refused by ``score_drive``.
    """
    selection = run.drive_manifest().selection
    span = tables.span_ns()
    is_whole = selection.start_ns is None and selection.end_ns is None
    if span is None or not is_whole or truth.start_ns > span[1] or truth.end_ns <= span[0]:
        return
    for one in truth.approaches:
        if one.start_ns > span[1] + SLACK_NS or one.enter_ns < span[0] - SLACK_NS:
            raise SchemaError(
                f"{path}: approach {one.id} from {one.start_ns} to {one.enter_ns} ns is outside "
                f"the log, of which {run.path} has {span[0]} to {span[1]} ns; correct the truth"
            )


def _why_no_pose(run: RunFolder, truth: Truth) -> str:
    if truth.pose is None:
        return "the truth has no track (pose: missing)"
    if not run.file("pose.parquet").exists():
        return "the run has no pose"
    return "" if run.table("pose", ["t_ns"]).num_rows else "the run's pose has no row"


def pooled_scores(scored: Sequence[RunScored], settings: ScoreSettings = DEFAULTS) -> PooledScores:
    """Return the pooled scores of runs."""
    return pool_scores([one.judged for one in scored], settings)


def metrics_of(scored: Sequence[RunScored], scores: PooledScores) -> dict[str, Any]:
    """Return the content of ``metrics.json``: pooled scores, with the pose.

    The pose of a single run is included completely; for several runs, means over drives and the
    pose of each are included.
    """
    tree = as_metrics(scores)
    tree["account"] = account_of_scores(scored).as_json()
    named = {spelled(str(one.run.path)): one for one in scored if one.pose is not None}
    poses = {name: one.pose for name, one in named.items() if one.pose is not None}
    if not poses:
        tree["coverage"]["not_scored"]["pose"] = scored[0].why_no_pose
    if len(scored) == 1:
        (only,) = scored
        tree["truth"] = only.truth.truth.model_dump(mode="json")
        tree["pose"] = None if only.pose is None else asdict(only.pose)
    else:
        tree["coverage"]["same_log"] = same_logs(scored)
        tree["pose"] = _poses(poses, places_of_drives(tuple(named.values())))
    return tree


def places_of_drives(scored: Sequence[RunScored]) -> Int64s:
    """Return the number of each drive's place, shape (N,)."""
    return group_places([one.truth.places.get(NONE, str(one.run.path)) for one in scored])


def account_of_scores(scored: Sequence[RunScored]) -> ScoredAccount | SummedAccount:
    """Return the account of one run, or the sum of several, with scoring as the last stage."""
    if len(scored) == 1:
        (only,) = scored
        of = only.run.drive_manifest().account
        found = ScoredAccount(
            reading=of.reading,
            detecting=of.detecting,
            estimating=of.estimating,
            is_whole=of.is_whole,
            scoring=scoring_of(only),
        )
        check_account(found)
        return found
    return sum_accounts(account_of_scores([one]) for one in scored)


def scoring_of(one: RunScored) -> dict[str, Line]:
    """Return numbers of scored and unscored frames by cue, and of true poses, by reason."""
    found = {
        f"cue {cue.cue}": line(
            cue.frames, cue.frames - sum(cue.left_out["object"].values()), cue.left_out["object"]
        )
        for cue in one.judged.cues
    }
    if one.pose is not None:
        of = one.pose.coverage
        found["poses"] = line(
            of.truth_poses,
            of.scored,
            {
                "before the first estimate": of.before_estimate,
                "after the last estimate": of.after_estimate,
                "no estimate near enough": of.in_gap,
                AMBIGUOUS: of.ambiguous,
            },
        )
    return found


def same_logs(scored: Sequence[RunScored]) -> list[tuple[str, str]]:
    """Return pairs of runs of the same log, whose drive counts twice when pooled."""
    first: dict[str, str] = {}
    pairs: list[tuple[str, str]] = []
    for one in scored:
        name = spelled(str(one.run.path))
        logs = one.run.drive_manifest().logs
        for digest in {digest for log in logs for digest in _digests(log)}:
            if first.setdefault(digest, name) != name:
                pairs.append((first[digest], name))
    return sorted(set(pairs))


def _digests(log: LogRow) -> Iterator[str]:
    """Yield the identifiers of a log: hashes of its files, and its identity."""
    yield from log.sha256.values()
    yield log.identity.digest


def _poses(poses: Mapping[str, PoseScore], places: Int64s) -> dict[str, Any]:
    rmse = np.array([one.ape["none"].translation_m.rmse for one in poses.values()], np.float64)
    nees = {
        name: np.array([getattr(one, name).mean for one in poses.values()], np.float64)
        for name in ("nees_xy", "nees_xyh")
    }
    return {
        "drives": len(poses),
        "ape_rmse_m": asdict(intervals.mean(rmse, places)),
        **{name: asdict(intervals.mean(values, places)) for name, values in nees.items()},
        "lost": sum(one.lost_at_m is not None for one in poses.values()),
        "by_drive": {name: asdict(one) for name, one in poses.items()},
    }
