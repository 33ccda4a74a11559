"""Cut logs are read in part or refused, and a missing camera is blamed on the cut."""

from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import DriveFiles, write_drive
from crosscue.eval import cli
from crosscue.replay.base import report_missing
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from support.accounted import read
from support.coco import annotate
from support.commands import output_of
from support.every_format import EVERY_FORMAT
from support.landmark_files import empty_database
from support.mcap_files import ChunkOf, McapFile, channel, message, schema
from support.refusals import refusal

# Formats with an index at the end of the file, without which no row can be read.
INDEX_AT_THE_END = {"mf4", "video"}
# Formats with separate files for the times of rows, and these files.
TIME_FILES = {
    "kitti-raw": ("oxts/timestamps.txt", "image_02/timestamps.txt"),
    "comma2k19": ("processed_log/IMU/gyro/t", "processed_log/IMU/gyro/value"),
    "video": ("front.txt",),
    "images": ("timestamps.txt",),
}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> DriveFiles:
    folder = tmp_path_factory.mktemp("drive")
    return write_drive(folder, DriveSettings(seed=3, blocks=1, block_m=60.0))


# Formats whose truncation ``info --quick`` cannot detect, and why.
BODY_UNSEEN = {"images": "pictures are not opened", "openpilot": "its video has no index"}


def _largest_file(log: Path) -> Path:
    files = [log] if log.is_file() else [path for path in log.rglob("*") if path.is_file()]
    return max(files, key=lambda path: path.stat().st_size)


@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
def test_quick_info_reports_truncated_log(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = EVERY_FORMAT[name](tmp_path)
    assert cli.run(["info", "--quick", str(log)]) == 0
    largest = _largest_file(log)
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])
    capsys.readouterr()

    status = cli.run(["info", "--quick", str(log)])

    captured = capsys.readouterr()
    if name in BODY_UNSEEN:
        assert status == 0
        assert cli.run(["info", str(log)]) == 3
    elif status == 3:
        assert "losses" in captured.out
    else:
        assert status == 4
        assert name in INDEX_AT_THE_END
        assert captured.err.count("\n") == 1


@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
def test_quick_info_reports_no_loss_that_reading_does_not(name: str, tmp_path: Path) -> None:
    log = EVERY_FORMAT[name](tmp_path)
    largest = _largest_file(log)
    raw = largest.read_bytes()
    for size in range(len(raw), len(raw) // 8, -max(1, len(raw) // 19)):
        largest.write_bytes(raw[:size])
        quick = Ledger(str(log))
        try:
            with open_log(log) as opened:
                report_missing(opened, quick)
        except LogError:
            continue
        assert quick.is_whole or not read(log)[1].is_whole, size
        assert quick.is_whole or size < len(raw)


@pytest.mark.parametrize("name", sorted(EVERY_FORMAT))
@pytest.mark.parametrize("command", ["info", "convert"])
def test_truncated_log_is_read_in_part_or_refused(
    name: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = EVERY_FORMAT[name](tmp_path)
    largest = _largest_file(log)
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])

    status = cli.run([command, str(log), *(["-o", str(tmp_path / "o.mcap")] * (command != "info"))])

    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    assert status in (3, 4), captured.err
    assert (status == 4) == captured.err.startswith("crosscue: ")
    if command == "info":
        assert status == 3 or name in INDEX_AT_THE_END
    elif status == 4:
        assert not (tmp_path / "o.mcap").exists()


def _times(log: Path) -> tuple[dict[str, set[int]], Ledger]:
    times: dict[str, set[int]] = {}
    blocks, ledger = read(log)
    for block in blocks:
        times.setdefault(block.topic, set()).update(block.log_ns.tolist())
    return times, ledger


@pytest.mark.parametrize(
    ("name", "file"), [(name, file) for name in TIME_FILES for file in TIME_FILES[name]]
)
def test_rows_without_time_stamp_are_dropped(name: str, file: str, tmp_path: Path) -> None:
    log = EVERY_FORMAT[name](tmp_path)
    if name == "images":
        (log / file).write_text("".join(f"{0.1 * i:.3f}\n" for i in range(12)))
    complete, _ = _times(log)
    path = log / file if log.is_dir() else log.with_name(file)
    raw = path.read_bytes()
    seen = set[str]()
    for size in range(len(raw) // 2, len(raw), max(1, len(raw) // 60)):
        path.write_bytes(raw[:size])
        cut, ledger = _times(log)

        for topic, times in complete.items():
            assert cut[topic] <= times, (size, topic)
            account = ledger.topic(topic)
            assert account.used + account.dropped.total() == len(times), (size, topic)
            seen.update(account.dropped)
    assert seen

    path.write_bytes(raw[: len(raw) // 2])
    message = " ".join(output_of("info", log, status=3).split())
    assert any(reason in message for reason in seen)


@pytest.mark.parametrize(
    "flags",
    [
        "replay -o {out} --vehicle {car}",
        "replay -o {out} --vehicle {car} --topics /can",
        "replay -o {out} --vehicle {car} --to 5",
        "decode -o {out} --topics /can",
        "convert -o {out}.mcap --topics /can",
        "fit compass --vehicle {car}",
        "fit odometry --vehicle {car}",
    ],
)
def test_log_truncated_before_first_topic_is_unreadable_not_wrong_usage(
    drive: DriveFiles, flags: str, tmp_path: Path
) -> None:
    log = tmp_path / "cut.mcap"
    log.write_bytes(drive.log.read_bytes()[:500])
    command, _, rest = flags.partition(" -")
    argv = f"-{rest}".format(out=tmp_path / "out", car=drive.vehicle).split()

    err = refusal(4, *command.split(), log, *argv)
    assert err.startswith(f"crosscue: {log}: ")


@pytest.mark.parametrize(
    "flags", ["replay -o {out} --vehicle {car}", "decode -o {out}", "convert -o {out}.mcap"]
)
def test_commands_suggest_salvage_for_damaged_log(
    drive: DriveFiles, flags: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "damaged.mcap"
    log.write_bytes(drive.log.read_bytes()[: drive.log.stat().st_size * 3 // 4])
    command, _, rest = flags.partition(" -")
    argv = f"-{rest}".format(out=tmp_path / "out", car=drive.vehicle).split()

    assert cli.run([command, str(log), *argv]) == 3
    message = " ".join("".join(capsys.readouterr()).split())
    assert "crosscue convert" in message
    assert "--salvage" in message


START_NS = 1_700_000_000_000_000_000
# Commands that need a camera, with arguments.
NEEDS_CAMERA = {
    "truth import": "{coco} --log {log} -o {out}.json --vehicle {car}",
    "fit signs": "{drive} --label stop_sign",
    "landmarks add": "{out}.db {log} --poses {truth} --vehicle {car}",
    "replay": "{log} -o {out} --vehicle {car} --detectors support.gap_drive:build",
    "detect": "{log} -o {out} --vehicle {car} --detectors support.gap_drive:build",
}


def _drive(folder: Path, is_cut: bool, camera: str) -> dict[str, Path]:
    folder.mkdir()
    rows = [message(1, START_NS + k * 10**7, b'{"speed_mps": 1}') for k in range(300)]
    named = [schema(1, "a", "jsonschema", b"{}"), channel(1, 1, "/a", "json")]
    coded = McapFile([ChunkOf([*named, *rows[:100]]), ChunkOf(rows[100:])]).coded()
    (folder / "a.mcap").write_bytes(coded[: len(coded) * 2 // 3] if is_cut else coded)
    (folder / "vehicle.toml").write_text(f"version = 1\n{camera}")
    annotate(folder, START_NS)
    return {
        "drive": folder,
        "log": folder / "a.mcap",
        "car": folder / "vehicle.toml",
        "truth": folder / "truth.json",
        "coco": folder / "objects.json",
        "db": empty_database(folder.parent / "known.db"),
        "out": folder.parent / "out",
    }


ANY, NAMED = "", '[topics]\ncamera = "/camera"\n'


@pytest.mark.parametrize("is_cut", [False, True])
@pytest.mark.parametrize("camera", [ANY, NAMED], ids=["any", "named"])
@pytest.mark.parametrize("command", NEEDS_CAMERA)
def test_camera_missing_from_log_is_blamed_on_its_truncation_alone(
    command: str, is_cut: bool, camera: str, tmp_path: Path
) -> None:
    names = _drive(tmp_path / "drive", is_cut, camera)
    words = [word.replace("_sign", " sign") for word in NEEDS_CAMERA[command].split()]

    error = refusal(
        4 if is_cut else (1, 2), *command.split(), *(word.format(**names) for word in words)
    )

    assert ("camera = '/camera': no such topic" if camera else "no camera") in error
    assert ("the file is cut" in error) == is_cut
