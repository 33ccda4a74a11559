"""Runs in the public interface: replay, print, estimate again, score and compare."""

import pyarrow as pa
import pytest

import crosscue
from crosscue.datasets.simulated.log_files import DriveFiles
from crosscue.detectors.signs.templates import draw_sign


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    return crosscue.simulate_drive(tmp_path_factory.mktemp("drive") / "d", seed=3, blocks=2)


@pytest.fixture(scope="module")
def run(drive: DriveFiles, tmp_path_factory: pytest.TempPathFactory) -> crosscue.Run:
    """Replay the drive with the vehicle file next to its log."""
    return crosscue.replay_drive(drive.log, tmp_path_factory.mktemp("runs") / "run")


def test_run_exposes_its_tables_and_notices(run: crosscue.Run) -> None:
    assert isinstance(run.pose, pa.Table)
    assert len(run.pose) > 100
    assert run.pose == run["pose"]
    assert "pose" in run.tables
    head, *lines = repr(run).splitlines()[1:]
    assert head.split() == ["table", "columns", "rows"]
    notes = [f"note: {text}" for text in run.folder.drive_manifest().notices]
    assert notes
    assert [line.split()[0] for line in lines[: -len(notes)]] == list(run.tables)
    assert lines[-len(notes) :] == notes
    with pytest.raises(crosscue.errors.RunError, match="there are: "):
        run["nonsense"]


def test_manifest_is_printed_with_one_field_per_line(run: crosscue.Run) -> None:
    head, *lines = repr(run.manifest).splitlines()

    assert head == "EstimateManifest"
    assert [line.split()[0] for line in lines] == [*type(run.manifest).model_fields]
    assert max(map(len, lines)) < 130


def test_run_is_scored_and_printed(drive: DriveFiles, run: crosscue.Run) -> None:
    scored = crosscue.score_run(run, drive.truth, has_figures=False)

    assert "APE" in repr(scored)
    assert scored.report.is_file()
    assert scored.metrics["pose"]
    assert scored.true_track.column_names == ["t_ns", "x_m", "y_m", "z_m"]
    assert isinstance(scored.cues, pa.Table)
    assert isinstance(scored.curves, pa.Table)
    with pytest.raises(crosscue.UsageError, match="threshold"):
        crosscue.score_run(run, drive.truth, threshold=2.0)


def test_estimate_with_other_settings_is_written_to_another_folder(
    run: crosscue.Run, drive: DriveFiles
) -> None:
    before = {path.name: path.read_bytes() for path in run.path.glob("*.parquet")}
    vehicle = crosscue.load_vehicle(drive.vehicle)
    odometry = vehicle.odometry.model_copy(update={"wheel_scale": 1.1})

    other = crosscue.estimate_run(
        run, vehicle.model_copy(update={"odometry": odometry}), run.path.with_name("other")
    )

    assert {path.name: path.read_bytes() for path in run.path.glob("*.parquet")} == before
    assert crosscue.compare_runs(run, run.path).tables_same == len(before)
    longer = other.pose["travelled_m"][-1].as_py() / run.pose["travelled_m"][-1].as_py()
    assert longer == pytest.approx(1.1, rel=1e-3)
    with pytest.raises(crosscue.errors.OutputError, match="exists"):
        crosscue.estimate_run(run, vehicle, other.path)
    with pytest.raises(crosscue.UsageError, match="next to the run"):
        crosscue.estimate_run(run, vehicle, run.path / "inside")


def test_known_sign_is_drawn_and_unknown_sign_refused() -> None:
    assert draw_sign("one way left", 48).ndim == 2
    with pytest.raises(crosscue.UsageError, match="one way left"):
        draw_sign("one way up", 48)
