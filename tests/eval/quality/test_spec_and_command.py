"""``crosscue check LOG`` as a command: verdict, specification, JUnit, and folders of data sets."""

import json
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.quality.checks import CHECKS
from crosscue.eval.quality.spec import read_spec, spec_faults, write_spec
from crosscue.eval.quality.verdict import LogCheck
from crosscue.replay.columns import Block, CanFrames, Messages, Table
from crosscue.replay.errors import UnknownFormatError, UsageError
from crosscue.replay.logs.log_summary import LogSummary, copies, summarise_log
from crosscue.replay.losses import losses_heard
from support.commands import output_of
from support.kitti_drive import kitti_odometry_drive
from support.quality_logs import Drive, Streams, log_of, streams_of


def summary_of(streams: Streams) -> LogSummary:
    return summarise_log(log_of(streams))


def faults(spec: Path, streams: Streams) -> set[str]:
    return {name for name, why in spec_faults(read_spec(spec), [summary_of(streams)]) if why}


def test_spec_of_a_good_log_holds_for_it_and_for_another_drive(tmp_path: Path) -> None:
    write_spec(tmp_path / "s.toml", [summary_of(streams_of(Drive()))])

    assert faults(tmp_path / "s.toml", streams_of(Drive())) == set()
    assert faults(tmp_path / "s.toml", streams_of(Drive(seed=3, turn_rad=-1.0))) == set()


def test_spec_finds_missing_topic_half_rate_gap_and_delay(tmp_path: Path) -> None:
    write_spec(tmp_path / "s.toml", [summary_of(streams_of(Drive()))])
    streams = streams_of(Drive())
    del streams["gnss"]
    streams["wheels"] = streams["wheels"].take(np.arange(0, len(streams["wheels"].t_s), 2))
    camera = streams["camera"]
    streams["camera"] = camera.take(np.flatnonzero((camera.t_s < 5.0) | (camera.t_s > 7.0)))
    gyro = streams["gyro"]
    assert gyro.header_s is not None
    streams["gyro"] = type(gyro)(gyro.t_s, gyro.columns, header_s=gyro.header_s - 0.3)

    assert faults(tmp_path / "s.toml", streams) == {
        "gnss: there",
        "wheels: min_rate_hz",
        "camera: max_gap_s",
        "gyro: max_delay_s",
    }


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("version = 2\n[topics]\n", "version"),
        ('version = 1\n[topics."/a"]\nmin_rate = 1.0\n', "min_rate: no such key"),
        ('version = 1\n[topics."/a"]\nmin_rate_hz = -1.0\n', "min_rate_hz"),
        ("version = [", "not TOML"),
    ],
)
def test_invalid_spec_is_refused_with_its_place(tmp_path: Path, text: str, why: str) -> None:
    (tmp_path / "s.toml").write_text(text)

    with pytest.raises(UsageError, match=why):
        read_spec(tmp_path / "s.toml")


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A sequence of the data set, two levels down."""
    return kitti_odometry_drive(tmp_path / "set" / "download")


def test_verdict_spec_and_junit_of_a_data_set_two_levels_down(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec, junit = tmp_path / "s.toml", tmp_path / "check.xml"
    folder = str(tmp_path / "set")

    cli.run(["check", folder, "--for", "cues", "--spec", str(spec), "--init"])
    assert f"written: {spec}" in capsys.readouterr().out
    assert cli.run(["check", folder, "--spec", str(spec), "--init"]) == 1
    status = cli.run(
        ["check", folder, "--for", "cues", "--spec", str(spec), "--junit", str(junit), "--json"]
    )

    (row,) = json.loads(capsys.readouterr().out)["files"]
    assert row["exit_status"] == status
    assert {one["purpose"] for one in row["result"]["purposes"]} == {"cues"}
    assert not any(why for _, why in row["result"]["spec"])
    cases = ET.parse(junit).getroot().findall(".//testcase")
    assert len(cases) == len(CHECKS) + len(row["result"]["spec"])


def test_info_open_vehicle_init_and_truth_descend_to_the_only_log(
    kitti: Path, tmp_path: Path
) -> None:
    folder = str(tmp_path / "set")

    with crosscue.open(folder) as log:
        assert "odometry" in log.topics
        assert log.paths == (str(kitti),)
    # A long path is broken at the width of the terminal.
    assert str(kitti) in output_of("info", folder, "--quick").replace("\n", "")
    output_of("vehicle", "init", folder)
    output_of("truth", folder, "-o", tmp_path / "truth")


def test_several_logs_below_a_folder_are_named(kitti: Path, tmp_path: Path) -> None:
    kitti_odometry_drive(tmp_path / "set" / "other")

    with pytest.raises(UnknownFormatError, match="did you mean one of") as error:
        crosscue.open(tmp_path / "set")

    assert str(kitti) in str(error.value)


def test_exit_status_is_that_of_the_verdict(kitti: Path) -> None:
    for purpose in ("pose", "cues", "range", "landmarks"):
        (row,) = crosscue.check(kitti, purposes=[purpose])
        assert isinstance(row.result, LogCheck)
        expected = {"good": 0, "limited": 3, "not possible": 1}
        assert row.exit_status == expected[row.result.verdict]


def test_purpose_that_does_not_exist_is_refused(kitti: Path) -> None:
    with pytest.raises(UsageError, match="purposes: fun, joy: expected pose"):
        crosscue.check(kitti, purposes=["fun", "joy"])  # type: ignore[list-item]
    with pytest.raises(UsageError, match="init: needs a file"):
        crosscue.check(kitti, init=True)


def test_exact_copies_are_counted_in_every_kind_of_rows() -> None:
    t_ns = np.array([1, 1, 2, 2, 3], np.int64)
    table = Table({"x": np.array([5.0, 5.0, np.nan, np.nan, np.nan])})
    assert copies(Block("a", t_ns, table)) == 2
    changed = Table({"x": np.array([5.0, 6.0, 7.0, 7.0, 7.0])})
    assert copies(Block("a", t_ns, changed)) == 1
    raw = np.frombuffer(b"aabbc", np.uint8)
    at = np.arange(5, dtype=np.int64)
    assert copies(Block("a", t_ns, Messages(raw, at, at + 1))) == 2
    ids = np.array([7, 7, 8, 9, 9], np.uint32)
    flags, lengths = np.zeros(5, np.bool_), np.full(5, 8, np.uint8)
    frames = CanFrames(ids, flags, lengths * 0, lengths, np.zeros((5, 8), np.uint8), flags)
    assert copies(Block("a", t_ns, frames)) == 1
    # A recorder may store a copy later; then the sensor's stamp shows it.
    header_ns = np.array([4, 4, 5, 6, 7], np.int64)
    same = Table({"x": np.ones(5)})
    assert copies(Block("a", np.arange(5, dtype=np.int64), same, header_ns=header_ns)) == 1


def test_info_names_exact_copies() -> None:
    streams = streams_of(Drive(seconds=4.0))
    wheels = streams["wheels"]
    streams["wheels"] = wheels.take(np.repeat(np.arange(len(wheels.t_s)), 2))

    (sentence,) = [one for one in summary_of(streams).findings if "exact cop" in one]

    assert sentence.startswith(f"wheels: {len(wheels.t_s)} exact copies")


def test_lost_rows_of_a_used_topic_are_found(kitti: Path) -> None:
    lines = (kitti.parent.parent / "poses" / "04.txt").read_text().splitlines()
    lines[3] = "not a matrix"
    (kitti.parent.parent / "poses" / "04.txt").write_text("\n".join(lines))

    with losses_heard():
        (row,) = crosscue.check(kitti, purposes=["pose"])

    assert isinstance(row.result, LogCheck)
    (finding,) = [one for one in row.result.findings if one.check == "damage"]
    assert finding.text.startswith("odometry: 1 of")
    assert row.exit_status in (1, 3)


def test_info_shows_the_delay_that_the_vehicle_file_states(
    kitti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "car.toml").write_text("version = 1\n[camera]\ndelay_s = 0.025\n")

    cli.run(["info", str(kitti), "--vehicle", str(tmp_path / "car.toml")])

    assert "pictures   stamped +25 ms late (camera.delay_s)" in capsys.readouterr().out
