"""The public interface: names, drives, runs, records of commands, and settings of training."""

import json
import re
import warnings
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

import crosscue
from crosscue.datasets.simulated.drive import DriveSettings, dbc_path
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.detectors.signs.templates import draw_sign
from crosscue.eval.logs.log import _views
from crosscue.eval.training.mask_rcnn import MaskRcnnTrainingSettings
from crosscue.eval.training.road import RoadTrainingSettings
from crosscue.replay import errors as replay_errors
from crosscue.replay.columns import Messages
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.vehicle.vehicle import parse
from support.commands import output_of
from support.every_format import EVERY_FORMAT
from support.pandaset_drive import pandaset_drive


def test_version_equals_output_of_the_command() -> None:
    assert output_of("--version") == f"crosscue {crosscue.__version__}\n"
    assert re.fullmatch(r"\d+\.\d+.*", crosscue.__version__)


@pytest.mark.parametrize("name", crosscue.__all__)
def test_public_name_exists_and_is_documented(name: str) -> None:
    found = getattr(crosscue, name)

    assert (found.__doc__ or "").strip()
    assert name in dir(crosscue)


def test_public_names_are_few() -> None:
    assert len(crosscue.__all__) <= 80


def test_errors_are_in_one_module() -> None:
    ours = {name for name, one in vars(crosscue.errors).items() if isinstance(one, type)}

    assert ours == {
        name
        for name, one in vars(replay_errors).items()
        if isinstance(one, type) and issubclass(one, Exception)
    }


def test_vehicle_draft_has_published_intrinsics_and_commented_sections(tmp_path: Path) -> None:
    text = crosscue.draft_vehicle(pandaset_drive(tmp_path / "002", 4)).text

    assert "focal_px = 1970  # published with the data set\ncenter_px = [970.5, 483]" in text
    # The generated pictures are tiny.
    assert "# pitch and yaw not estimated: camera.center_px = (970.5, 483): outside the im" in text
    for section in ("mobileye", "regions", "ranges", "detectors.yolox-nano", "cues", "cars"):
        assert f"# [{section}]" in text
    # Every commented line is valid in a vehicle file when uncommented.
    lines = [line.removeprefix("# ") for line in text.splitlines()]
    kept = [line for line in lines if re.match(r"\[[\w.-]+\]( +#|$)|\w+ = ", line)]
    parse("\n".join(line for line in kept if 'kind = "curve"' not in line), "uncommented")


@pytest.mark.slow
def test_databases_for_a_log_without_a_bus_are_refused_with_the_types_that_are_there(
    tmp_path: Path,
) -> None:
    drive = pandaset_drive(tmp_path / "002", 4)

    with pytest.raises(EmptyResultError) as caught:
        crosscue.draft_vehicle(drive, [dbc_path()])

    text = str(caught.value)
    assert text.startswith(f"{drive}: no CAN bus for simulated_car.dbc; there are: ")
    assert "front_camera (crosscue/Images)" in text
    assert "can_msgs/msg/Frame" in text


def test_vehicle_draft_uses_intrinsics_of_calibration_message(tmp_path: Path) -> None:
    files = crosscue.simulate_approach(tmp_path, "L0", width_px=64)
    known = crosscue.load_vehicle(files.vehicle).camera

    drafted = crosscue.draft_vehicle(files.log).vehicle.camera

    assert drafted.focal_px == pytest.approx(known.focal_px)
    assert drafted.center_px == pytest.approx(known.center_px)


def test_vehicle_draft_keeps_specified_mounting(tmp_path: Path) -> None:
    log = pandaset_drive(tmp_path / "002", 4)

    camera = crosscue.draft_vehicle(
        log, camera_x_m=1.7, camera_height_m=1.4, camera_pitch_deg=2.0, camera_yaw_deg=-1.0
    ).vehicle.camera

    assert (camera.x_m, camera.z_m) == (1.7, 1.4)
    assert camera.pitch_rad == pytest.approx(0.0349, abs=1e-4)
    assert camera.yaw_rad == pytest.approx(-0.01745, abs=1e-4)
    with pytest.raises(crosscue.UsageError, match=r"^camera_height_m: -1, expected 0.1 to 10$"):
        crosscue.draft_vehicle(log, camera_height_m=-1.0)
    # Four tiny pictures have no vanishing point: a comment reports it, and the default is kept.
    text = crosscue.draft_vehicle(log).text
    assert "# pitch and yaw not estimated" in text
    assert "# pitch_rad = 0.0" in text


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    return write_drive(tmp_path_factory.mktemp("drive"), DriveSettings(seed=3, blocks=1))


def test_topics_are_printed_as_a_table(drive: DriveFiles) -> None:
    with crosscue.open(drive.log) as log:
        head, *lines = repr(log.topics).splitlines()

        assert head.split() == ["topic", "type", "encoding", "count"]
        assert [line.split()[0] for line in lines] == list(log.topics)
        assert "/can" in log.topics
        assert log["/can"].type_name in repr(log["/can"])


@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
def test_each_format_yields_tables_or_frames(name: str, tmp_path: Path) -> None:
    rows = 0
    with (
        warnings.catch_warnings(record=True) as warned,
        crosscue.open(EVERY_FORMAT[name](tmp_path)) as log,
    ):
        warnings.simplefilter("always", crosscue.LossWarning)
        for topic in log.topics.values():
            if "mage" in topic.type_name:
                rows += sum(frame.rgb.shape[2] == 3 for frame in topic.frames())
                continue
            table = topic.table()
            (reported,) = json.loads(table.schema.metadata[b"crosscue"]).values()
            assert len(table) == reported["used"] == sum(map(len, topic.batches()))
            assert table.column_names[0] == "log_t_ns"
            rows += len(table)
    assert rows or warned


@pytest.mark.parametrize("sizes", [(0, 1, 4, 11, 12, 13, 40), (13, 20), (12,), ()])
def test_pictures_of_any_size_are_views_of_their_bytes(sizes: tuple[int, ...]) -> None:
    buffer = np.arange(100, dtype=np.uint8)
    start = np.arange(len(sizes), dtype=np.int64) * 7 + 3
    messages = Messages(buffer, start, start + np.array(sizes, np.int64))

    views = _views(messages)

    assert views.to_pylist() == [
        buffer[i : i + n].tobytes() for i, n in zip(start, sizes, strict=True)
    ]


@pytest.mark.filterwarnings("ignore::crosscue.LossWarning")
@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
def test_batches_of_a_log_are_the_tables_of_its_topics(name: str, tmp_path: Path) -> None:
    with crosscue.open(EVERY_FORMAT[name](tmp_path)) as log:
        batches: dict[str, list[pa.RecordBatch]] = {}
        for topic, batch in log.batches():
            batches.setdefault(topic, []).append(batch)
        for topic, parts in batches.items():
            found = pa.Table.from_batches(parts)
            if "coding" in found.column_names:
                assert len(found) == sum(1 for _ in log[topic].frames())
            else:
                assert found.equals(log[topic].table())


def test_time_spans_are_half_open_and_intersect(drive: DriveFiles) -> None:
    with crosscue.open(drive.log) as log:
        name = next(n for n in log.topics if n != "/can")
        recorded = log[name].table()["log_t_ns"].to_numpy()
        zero = min(log[one].table()["log_t_ns"].to_numpy().min() for one in log.topics)
        selected = log[name].table(start_s=1, end_s=2)["log_t_ns"].to_numpy()
        parts = log.part(end_s=2)[name].table(start_s=1)["log_t_ns"].to_numpy()

        inside = (recorded >= zero + 1_000_000_000) & (recorded < zero + 2_000_000_000)
        np.testing.assert_array_equal(selected, recorded[inside])
        np.testing.assert_array_equal(parts, selected)
        with pytest.raises(crosscue.UsageError, match="not after start_s"):
            log.part(start_s=2, end_s=2)
        with pytest.raises(crosscue.UsageError, match="seconds after"):
            log.part(start_s=float("nan"))


def test_signals_are_tables_by_message_with_units(drive: DriveFiles) -> None:
    dbc = next(drive.vehicle.parent.glob("*.dbc"))
    with crosscue.open(drive.log) as log:
        signals = log.signals(dbc)
        frames = log["/can"].table()

        assert "message" in repr(signals).splitlines()[0]
        name = next(iter(signals))
        units = {field.name: field.metadata for field in signals[name].schema}
        assert any(one and one.get(b"unit") for one in units.values())
        assert len(frames) >= max(map(len, signals.values()))
        assert [*log.signals(dbc, messages=[name])] == [name]
        with pytest.raises(crosscue.UsageError, match="messages"):
            log.signals(dbc, messages=["NOT_THERE"])
        with pytest.raises(crosscue.errors.MissingTopicError, match="did you mean"):
            signals[name + "x"]


def test_losses_raise_warning_and_are_recorded_in_table_metadata(
    tmp_path: Path, drive: DriveFiles
) -> None:
    cut = tmp_path / "cut.mcap"
    recorded = drive.log.read_bytes()
    cut.write_bytes(recorded[: len(recorded) // 2])

    with crosscue.open(cut) as log, pytest.warns(crosscue.LossWarning) as caught:
        table = log["/can"].table()

    # At the user's line, and about nothing that the user did not read.
    assert {Path(one.filename).name for one in caught} == {Path(__file__).name}
    about = [str(one.message).removeprefix(f"{cut}: ") for one in caught]
    assert all(text.startswith(("/can: ", "unknown topics: ")) for text in about)

    reported = json.loads(table.schema.metadata[b"crosscue"])[str(cut)]
    assert reported["used"] == len(table)
    lost = (reported, reported["unattributed"])
    assert any(one["dropped"] or one["dropped_unknown"] for one in lost)


@pytest.mark.parametrize(
    ("paths", "error"),
    [
        ((), crosscue.UsageError),
        (("gone.mcap",), crosscue.LogError),
        (("x.unknown",), crosscue.errors.UnknownFormatError),
    ],
)
def test_unreadable_paths_raise_crosscue_errors(
    paths: tuple[str, ...], error: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("x.unknown").write_bytes(b"?")

    with pytest.raises(error):
        crosscue.open(*paths)


@pytest.fixture(scope="module")
def longer_drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    return crosscue.simulate_drive(tmp_path_factory.mktemp("longer_drive") / "d", seed=3, blocks=2)


@pytest.fixture(scope="module")
def run(longer_drive: DriveFiles, tmp_path_factory: pytest.TempPathFactory) -> crosscue.Run:
    """Replay the longer_drive with the vehicle file next to its log."""
    return crosscue.replay_drive(longer_drive.log, tmp_path_factory.mktemp("runs") / "run")


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


def test_run_is_scored_and_printed(longer_drive: DriveFiles, run: crosscue.Run) -> None:
    scored = crosscue.score_run(run, longer_drive.truth, has_figures=False)

    assert "APE" in repr(scored)
    assert scored.report.is_file()
    assert scored.metrics["pose"]
    assert scored.true_track.column_names == ["t_ns", "x_m", "y_m", "z_m"]
    assert isinstance(scored.cues, pa.Table)
    assert isinstance(scored.curves, pa.Table)
    with pytest.raises(crosscue.UsageError, match="threshold"):
        crosscue.score_run(run, longer_drive.truth, threshold=2.0)


def test_estimate_with_other_settings_is_written_to_another_folder(
    run: crosscue.Run, longer_drive: DriveFiles
) -> None:
    before = {path.name: path.read_bytes() for path in run.path.glob("*.parquet")}
    vehicle = crosscue.load_vehicle(longer_drive.vehicle)
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


def test_invalid_training_settings_are_refused_before_writing(tmp_path: Path) -> None:
    road = RoadTrainingSettings(layouts=["L1"], width_px=130)
    masks = MaskRcnnTrainingSettings(data="gone", images="gone", window_px=(65, 64))

    with pytest.raises(crosscue.UsageError, match="multiple of 16"):
        crosscue.train_road(road, tmp_path / "a.safetensors")
    with pytest.raises(crosscue.UsageError, match="multiples of 32"):
        crosscue.train_mask_rcnn(masks, tmp_path / "a.safetensors")
    with pytest.raises(crosscue.UsageError, match="expected --test-layouts"):
        crosscue.train_road(RoadTrainingSettings(), measure="embedded")
    with pytest.raises(crosscue.UsageError, match="only for scoring"):
        crosscue.render_training_frames(tmp_path / "c", ["A"])
    assert not [*tmp_path.iterdir()]
