"""A run: made from a drive, read back as tables, estimated again, scored, compared, shown."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from crosscue.eval.interface.logs.log import Log, opened
from crosscue.eval.interface.show import listing
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.eval.runs.manifest import Manifest, json_schema
from crosscue.replay.base import DEFAULT_LIMITS, Limits, OutputError, RunError, UsageError
from crosscue.replay.vehicle.pose import GnssUse
from crosscue.replay.vehicle.vehicle import Vehicle, load, vehicle_given

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.detectors.base import Choice
    from crosscue.eval.catalog.compare import Comparison
    from crosscue.eval.pipeline.outcome import DetectOutcome, Outcome
    from crosscue.eval.report.score_runs import Scored

VEHICLE: Final = "vehicle.toml"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Run:
    """A run folder; ``replay_drive`` makes one, ``open_run`` reads one.

    Its tables are read when asked for, their checksums verified: ``run["belief"]``, or
    ``run.belief`` for those that every replay has.

    Attributes:
        folder: Where its files are.
        outcome: What the replay or estimate that made it counted; None for a run read from disk.
    """

    folder: RunFolder
    outcome: Outcome | DetectOutcome | None = None

    @property
    def path(self) -> Path:
        """Its folder."""
        return self.folder.path

    @property
    def made(self) -> Outcome | DetectOutcome:
        """What the replay, detection or estimate that made it counted.

        Raises:
            UsageError: The run was read from disk.
        """
        if self.outcome is None:
            raise UsageError(f"{self.path}: read from disk; its manifest holds what was counted")
        return self.outcome

    @property
    def manifest(self) -> Manifest:
        """Its logs, versions and settings, and the account of every row."""
        return self.folder.manifest()

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of its tables."""
        return tuple(sorted(path.stem for path in self.path.glob("*.parquet")))

    def __getitem__(self, table: str) -> pa.Table:
        if table not in self.tables:
            raise RunError(f"{self.path}: no table {table!r}; there are: {', '.join(self.tables)}")
        return self.folder.table(table)

    @property
    def belief(self) -> pa.Table:
        """Probability of every feature over time."""
        return self["belief"]

    @property
    def cues(self) -> pa.Table:
        """Count of every cue in every frame."""
        return self["cues"]

    @property
    def detections(self) -> pa.Table:
        """Every object that detectors found."""
        return self["detections"]

    @property
    def pose(self) -> pa.Table:
        """Position, heading and their covariance over time."""
        return self["pose"]

    def __repr__(self) -> str:
        rows = []
        for name in self.tables:
            columns = self.folder.schema(name).names
            rows.append((name, ", ".join(columns), self._rows(name)))
        return f"{self.path}\n{listing(('table', 'columns', 'rows'), rows, 2)}"

    def _rows(self, name: str) -> int:
        import pyarrow.parquet as pq

        return int(pq.read_metadata(self.folder.file(f"{name}.parquet")).num_rows)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ScoredRun:
    """A run beside its truth; printed as ``crosscue score`` prints it.

    Attributes:
        scored: What was measured.
        metrics: Every metric by name, as in ``metrics.json``.
        report: The page that shows them.
    """

    scored: Scored
    metrics: Mapping[str, Any]
    report: Path

    @property
    def headline(self) -> str:
        """Its folder and most important numbers in one line."""
        from crosscue.eval.report.summary import headline
        from crosscue.eval.scoring.metric_values import metric_values

        return headline(str(self.scored.one.run.path), metric_values(self.metrics))

    @property
    def cues(self) -> pa.Table:
        """Precision and recall of each cue with 95 % intervals, judged as its row says."""
        import pyarrow as pa

        from crosscue.eval.scoring.runs import scores_of

        rows = []
        for name, cue in scores_of([self.scored.one]).cues.items():
            row: dict[str, object] = {"cue": name}
            for what, share in (("precision", cue.precision), ("recall", cue.recall)):
                row |= {
                    what: None if share is None else share.value,
                    f"{what}_low": None if share is None else share.low,
                    f"{what}_high": None if share is None else share.high,
                    f"{what}_of": 0 if share is None else share.of,
                }
            rows.append(row)
        return pa.Table.from_pylist(rows)

    @property
    def curves(self) -> pa.Table:
        """Probability of each feature against true distance, a row for each step."""
        from crosscue.eval.scoring.runs import curve_table

        return curve_table([self.scored.one.judged])

    @property
    def true_track(self) -> pa.Table:
        """The truth's positions over time, in the columns t_ns, x_m, y_m, z_m.

        Raises:
            SchemaError: The truth has none.
        """
        import pyarrow as pa

        from crosscue.eval.scoring.pose.score import load_truth

        _, track = load_truth(self.scored.one.truth_path)
        columns = {f"{axis}_m": track.xyz_m[:, i] for i, axis in enumerate("xyz")}
        return pa.table({"t_ns": track.t_ns, **columns})

    def __repr__(self) -> str:
        from crosscue.eval.report.summary import pose_summary, summary
        from crosscue.eval.scoring.runs import scores_of

        one = self.scored.one
        lines = [summary(scores_of([one]), one.why_no_pose)]
        if one.pose is not None:
            lines += ["", pose_summary(one.pose)]
        return "\n".join(lines)


def load_vehicle(path: Path | str) -> Vehicle:
    """Read and check a vehicle file.

    Raises:
        VehicleError: It is missing, or a value does not fit; the message names the field.
    """
    return load(Path(path))


def open_run(
    path: Path | str,
    logs: Path | str | None = None,
    *,
    without_images: bool = False,
    limits: Limits = DEFAULT_LIMITS,
) -> Run:
    """Open a finished run.

    Args:
        path: Its folder.
        logs: Where its logs have moved to, if they have.
        without_images: Show it without the images in its logs, which may be gone.
        limits: What its logs are read with.

    Raises:
        RunError: It is no run, damaged, of another version, or holds many drives merged.
    """
    from crosscue.eval.batch.merge import open_one

    moved = None if logs is None else Path(logs)
    folder = open_one(Path(path), moved, without_images=without_images, limits=limits)
    return Run(folder)


def replay_drive(
    log: Log | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    detectors: Sequence[str] | None = None,
    *,
    gnss: GnssUse | None = None,
    start: Path | str | None = None,
    landmarks: Path | str | None = None,
    cache: Path | str | None = None,
    draw: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    on_frames: Callable[[int, int | None], None] = lambda done, of: None,
    on_time: Callable[[float, float], None] = lambda done_s, of_s: None,
) -> Run:
    """Replay a drive: run detectors over its camera, estimate pose, cues, ranges and belief.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the run.
        vehicle: The vehicle file; None for the ``vehicle.toml`` beside the log, if there is one.
        detectors: Names, model cards or ``module:factory``; None for the vehicle file's, and an
            empty list for pose alone.
        gnss: What GNSS is for: ``start``, ``truth`` or ``off``; None for the vehicle file's
            ``gnss.use``.
        start: The first pose: ``X,Y,HEADING`` in metres and degrees, or a truth file with a track.
        landmarks: Database that frames are compared with.
        cache: File in which results of detectors are kept; see ``default_cache``.
        draw: Up to so many pictures are written with what was found.
        overwrite: Replace an earlier run.
        resume: Keep detections of an earlier start that would be the same.
        on_frames: Called with the number of frames that are done, and of how many.
        on_time: Called with the seconds of log that are done, and of how many.

    Raises:
        VehicleError: The vehicle file does not fit the log.
        RunError: The folder holds something else.
        EmptyResultError: Nothing comes of it; the folder is as it was.
    """
    from crosscue.eval.fit.first_pose import with_start
    from crosscue.eval.pipeline.landmarks import matcher_for, open_for
    from crosscue.eval.pipeline.replay import Detecting
    from crosscue.eval.pipeline.replay import replay_drive as replay_into

    with opened(log) as drive, ExitStack() as stack:
        settings = with_start(
            drive.logs,
            vehicle_of(drive, vehicle),
            drive.selection,
            gnss,
            None if start is None else str(start),
        )
        detecting = Detecting(
            choices_for(settings, detectors), _path(cache), draw, resume, on_frames
        )
        database = None
        if landmarks is not None:
            matcher = matcher_for(settings)
            database = stack.enter_context(open_for(Path(landmarks), matcher))
        folder = create(Path(output), overwrite=overwrite or resume)
        outcome = replay_into(
            drive.logs,
            settings,
            folder,
            drive.selection,
            on_time,
            database,
            detecting,
            overwrite=overwrite,
        )
    return Run(folder, outcome)


def detect_drive(
    log: Log | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    detectors: Sequence[str] | None = None,
    *,
    cache: Path | str | None = None,
    draw: int = 0,
    overwrite: bool = False,
    on_frames: Callable[[int, int | None], None] = lambda done, of: None,
) -> Run:
    """Run detectors over a drive's camera, and nothing else; as ``replay_drive``."""
    from crosscue.detectors.registry import known
    from crosscue.eval.pipeline.detect import detect_drive as detect_into

    with opened(log) as drive:
        settings = vehicle_of(drive, vehicle)
        choices = choices_for(settings, detectors)
        if not choices:
            raise UsageError(f"--detectors: none named; there are: {', '.join(known({}))}")
        folder = create(Path(output), overwrite=overwrite)
        outcome = detect_into(
            drive.logs, settings, folder, drive.selection, choices, _path(cache), draw, on_frames
        )
    return Run(folder, outcome)


def estimate_run(
    run: Run | Path | str,
    vehicle: Vehicle | Path | str | None = None,
    output: Path | str | None = None,
    *,
    on_time: Callable[[float, float], None] = lambda done_s, of_s: None,
) -> Run:
    """Estimate again from what detectors found before; no picture is opened.

    Args:
        run: A finished run.
        vehicle: Other settings; the run's own, if left out. A first pose that the run took from
            GNSS or a truth file stays, unless the settings have one.
        output: A new folder beside the run; if left out, the run's tables are replaced.
        on_time: Called with the seconds of log that are done, and of how many.

    Raises:
        RunError: The run is damaged, or its log is gone.
        OutputError: The new folder exists.
    """
    from crosscue.eval.fit.first_pose import with_start_of
    from crosscue.eval.pipeline.reestimate import estimate_run as estimate_in

    folder = _run(run).folder
    if output is not None:
        folder = _copied(folder, Path(output))
    settings = None
    if vehicle is not None:
        settings = with_start_of(folder.drive_manifest().settings, vehicle_given(vehicle))
    return Run(folder, estimate_in(folder, settings, on_time))


def score_run(
    run: Run | Path | str,
    truth: Path | str | None = None,
    *,
    threshold: float = 0.9,
    detection: Literal["confirmed", "published"] = "confirmed",
    rpe_m: Sequence[float] = (10.0, 100.0),
    any_log: bool = False,
    has_figures: bool = True,
) -> ScoredRun:
    """Score a run against its truth; metrics, figures and report go into ``RUN/score``.

    Args:
        run: A finished run.
        truth: Its truth; None for the ``truth.json`` beside its log.
        threshold: A feature is detected above this probability.
        detection: ``confirmed`` by three frames and a right range, or as ``published``: the first
            frame counts, with any range.
        rpe_m: Distances of the relative pose error.
        any_log: Take a truth that names the hash of another file: the same drive, converted.
        has_figures: Draw figures, for which matplotlib is imported.

    Raises:
        SchemaError: The truth does not fit the run.
        UsageError: No truth is given and none lies beside the log.
    """
    from crosscue.eval.report.score_runs import ScoreWork
    from crosscue.eval.scoring.drives import ScoreSettings

    of = _run(run)
    try:
        settings = ScoreSettings(threshold=threshold, detection=detection)
    except ValueError as error:
        raise UsageError(f"score: {error}") from None
    work = ScoreWork(
        _path(truth),
        settings,
        tuple(rpe_m),
        any_log=any_log,
        logs=of.folder.logs,
        limits=of.folder.limits,
        has_figures=has_figures,
    )
    scored = work(of.path)
    return ScoredRun(scored, scored.metrics, scored.report)


def run_schema() -> dict[str, Any]:
    """The JSON Schema of a run's ``manifest.json``, for editors and other tools."""
    return json_schema()


def compare_runs(
    first: Run | Path | str, second: Run | Path | str, tolerances: Sequence[str] = ()
) -> Comparison:
    """What changed from one run to another: settings, tables, metrics, and what is worse.

    Args:
        first: The run to compare with.
        second: The run to judge.
        tolerances: How much worse metrics may be: ``0.01``, ``2%`` or ``PATTERN=0.01``.
    """
    from crosscue.eval.catalog import compare

    allowed = [compare.read_tolerance(text) for text in tolerances]
    paths = [one.path if isinstance(one, Run) else Path(one) for one in (first, second)]
    before, after = (compare.open_scored(path) for path in paths)
    return compare.compare_runs(before, after, allowed)


def save_recording(
    run: Run | Path | str, output: Path | str | None = None, truth: Path | str | None = None
) -> Path:
    """Write a run as a Rerun recording.

    Args:
        run: A finished run.
        output: Name that ends in ``.rrd``; ``drive.rrd`` in the run, if left out.
        truth: Draw the true track and ranges, too.

    Returns:
        The recording; ``rerun PATH`` opens it.

    Raises:
        UsageError: Another suffix.
        RunError: The log with the pictures is gone.
    """
    from crosscue.eval.recording import save
    from crosscue.eval.scoring.pose.score import truth_track
    from crosscue.eval.scoring.truth import load as load_truth

    folder = _run(run).folder
    path = folder.file("drive.rrd") if output is None else Path(output)
    if path.suffix != ".rrd":
        raise UsageError(f"{path}: expected a name that ends in .rrd")
    track = ranges = None
    if truth is not None:
        known = load_truth(Path(truth), str(folder.path))
        ranges = known.ranges
        if known.truth.pose is not None and folder.file("pose.parquet").exists():
            track = truth_track(Path(truth), folder)
    save(folder, path, track, ranges)
    return path


def choices_for(vehicle: Vehicle, detectors: Sequence[str] | None) -> tuple[Choice, ...]:
    """The detectors asked for; none where neither caller nor vehicle file names any."""
    from crosscue.detectors.registry import chosen
    from crosscue.eval.pipeline.detect import choices_of

    sections = choices_of(vehicle)
    names = [*sections] if detectors is None else [*detectors]
    return chosen(",".join(names), sections) if names else ()


def vehicle_of(log: Log, given: Vehicle | Path | str | None) -> Vehicle:
    """The settings given, or those of the ``vehicle.toml`` beside the log, or none."""
    if given is not None:
        return vehicle_given(given)
    for one in log.logs:
        beside = (one.path if one.path.is_dir() else one.path.parent) / VEHICLE
        if beside.is_file():
            return load(beside)
    return Vehicle(version=1)


def _run(run: Run | Path | str) -> Run:
    return run if isinstance(run, Run) else open_run(run)


def _path(given: Path | str | None) -> Path | None:
    return None if given is None else Path(given)


def _copied(folder: RunFolder, output: Path) -> RunFolder:
    """The run in a new place, for other estimates beside it."""
    if output.resolve().parent != folder.path.resolve().parent:
        # Its manifest holds where its logs are, as seen from the folder.
        raise UsageError(f"{output}: expected a folder beside the run, {folder.path}")
    if output.exists():
        raise OutputError(f"{output}: exists; give another folder")
    shutil.copytree(folder.path, output, ignore=shutil.ignore_patterns("score", ".*"))
    return RunFolder(output, folder.logs, folder.without_images, folder.limits)
