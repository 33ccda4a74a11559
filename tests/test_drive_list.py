"""Which drives a command line means."""

import uuid
from importlib import import_module
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.eval.drive_list import DriveInput, drives_of
from crosscue.replay.errors import CrosscueError, LogError, UsageError


def _touch(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return folder


def _simulated(folder: Path, *names: str) -> Path:
    """As ``crosscue simulate`` writes."""
    for name in names:
        _touch(folder / name, "drive.mcap", "vehicle.toml", "truth.json", "objects.json", "car.dbc")
    return folder


def _names(drives: tuple[DriveInput, ...]) -> list[str]:
    return [one.name for one in drives]


def test_logs_named_one_by_one_are_one_drive(tmp_path: Path) -> None:
    _touch(tmp_path, "camera.mcap", "can.blf", "vehicle.toml")
    logs = (str(tmp_path / "camera.mcap"), str(tmp_path / "can.blf"))

    found = drives_of(logs)

    assert not found.is_many
    assert found.drives == (DriveInput("camera", logs),)


def test_one_log_is_one_drive(tmp_path: Path) -> None:
    _touch(tmp_path, "a.b.mcap")
    log = str(tmp_path / "a.b.mcap")

    assert drives_of([log]).drives == (DriveInput("a.b", (log,)),)
    assert not drives_of([log]).is_many
    assert drives_of([log], each=True).is_many


def test_a_drive_folder_brings_its_vehicle_and_truth(tmp_path: Path) -> None:
    folder = _simulated(tmp_path, "A-01") / "A-01"

    found = drives_of([str(folder)])

    assert not found.is_many
    assert found.drives == (
        DriveInput("A-01", (str(folder / "drive.mcap"),), folder / "vehicle.toml",
                   folder / "truth.json"),
    )  # fmt: skip


def test_a_folder_of_drives_is_many(tmp_path: Path) -> None:
    _simulated(tmp_path, "B-02", "A-01")
    _touch(tmp_path, "notes.txt", "runs/A-01/manifest.json", "runs/A-01/pictures/1.jpg")

    found = drives_of([str(tmp_path)])

    assert found.is_many
    assert _names(found.drives) == ["A-01", "B-02"]
    assert found.drives[0].vehicle == tmp_path / "A-01" / "vehicle.toml"


def test_bags_side_by_side_are_drives_of_their_own(tmp_path: Path) -> None:
    _touch(tmp_path, "mon.bag", "tue.bag")

    assert _names(drives_of([str(tmp_path)]).drives) == ["mon", "tue"]


def test_a_folder_that_may_be_one_drive_or_many_is_refused(tmp_path: Path) -> None:
    _touch(tmp_path, "camera.bag", "can.blf")

    with pytest.raises(UsageError, match=r"several formats \(blf, rosbag1\): one drive or many"):
        drives_of([str(tmp_path)])

    _touch(tmp_path, "vehicle.toml")
    assert len(drives_of([str(tmp_path)]).drives[0].logs) == 2


def test_splits_of_one_bag_are_one_drive_unless_each(tmp_path: Path) -> None:
    _touch(tmp_path, "bag_0.mcap", "bag_1.mcap")

    assert drives_of([str(tmp_path)]).drives[0].logs == (str(tmp_path),)
    assert _names(drives_of([str(tmp_path)], each=True).drives) == ["bag_0", "bag_1"]


def test_data_sets_in_folders_of_folders(tmp_path: Path) -> None:
    for route, segment in (("one", "40"), ("one", "41"), ("two", "40")):
        (tmp_path / route / segment / "processed_log").mkdir(parents=True)

    found = drives_of([str(tmp_path)])

    assert _names(found.drives) == ["one__40", "one__41", "two__40"]


def test_a_pattern_that_the_shell_left_alone(tmp_path: Path) -> None:
    _simulated(tmp_path, "A-01", "A-02", "B-01")

    files = drives_of([f"{tmp_path}/A-*/drive.mcap"])
    folders = drives_of([f"{tmp_path}/A-*"])
    deep = drives_of([f"{tmp_path}/**/drive.mcap"])

    assert files.is_many
    assert _names(files.drives) == ["A-01__drive", "A-02__drive"]
    assert files.drives[0].truth == tmp_path / "A-01" / "truth.json"
    assert _names(folders.drives) == ["A-01", "A-02"]
    assert [one.logs for one in folders.drives] == [one.logs for one in files.drives]
    assert len(deep.drives) == 3


def test_a_list_names_drives_line_by_line(tmp_path: Path) -> None:
    _touch(tmp_path, "a b.mcap", "can.blf", "c.bag")
    _simulated(tmp_path / "sim", "A-01", "A-02")
    text = "# day one\n'a b.mcap' can.blf\n\nc.bag  # alone\nsim\ns3://bucket/x.mcap\n"
    (tmp_path / "drives.txt").write_text(text)

    found = drives_of([f"@{tmp_path / 'drives.txt'}"])

    assert found.is_many
    assert _names(found.drives) == ["a_b", "c", "A-01", "A-02", "x"]
    assert found.drives[0].logs == (str(tmp_path / "a b.mcap"), str(tmp_path / "can.blf"))
    assert found.drives[4].logs == ("s3://bucket/x.mcap",)


def test_each_makes_every_argument_a_drive_and_names_differ(tmp_path: Path) -> None:
    _touch(tmp_path, "x/drive.mcap", "y/drive.mcap", "z/x/drive.mcap")
    logs = [str(tmp_path / place / "drive.mcap") for place in ("x", "y", "z/x")]

    names = _names(drives_of(logs, each=True).drives)

    assert names[1] == "y__drive"
    assert names[2] == "z__x__drive"
    assert len(set(names)) == 3


def test_remote_patterns(tmp_path: Path) -> None:
    bucket = f"bucket-{uuid.uuid4().hex}"
    system = import_module("fsspec").filesystem("memory")
    for name in ("a/drive.mcap", "b/drive.mcap"):
        system.pipe(f"/{bucket}/{name}", b"")

    found = drives_of([f"memory://{bucket}/*/drive.mcap"])
    system.rm(f"/{bucket}", recursive=True)

    assert _names(found.drives) == ["a__drive", "b__drive"]
    assert found.drives[0].logs == (f"memory://{bucket}/a/drive.mcap",)
    assert not drives_of([f"memory://{bucket}/a/drive.mcap"]).is_many


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("{}/nothing-*.mcap", "nothing matches"),
        ("@{}/gone.txt", "No such file"),
        ("@{}/empty.txt", "names no drive"),
        ("@{}/torn.txt", "line 2: No closing quotation"),
        ("@{}/twice.txt", "named twice"),
        ("{}/bare", "no drive in it"),
    ],
)
def test_errors_are_one_line(tmp_path: Path, argument: str, said: str) -> None:
    _touch(tmp_path, "a.mcap", "bare/readme.md")
    tmp_path.joinpath("empty.txt").write_text("# none\n")
    tmp_path.joinpath("torn.txt").write_text("a.mcap\n'b\n")
    tmp_path.joinpath("twice.txt").write_text("a.mcap\na.mcap\n")

    with pytest.raises(CrosscueError, match=said) as caught:
        drives_of([argument.format(tmp_path)])

    assert "\n" not in str(caught.value)


def test_a_link_that_leads_back_is_not_followed_for_ever(tmp_path: Path) -> None:
    _simulated(tmp_path, "A-01")
    (tmp_path / "again").symlink_to(tmp_path)

    assert _names(drives_of([str(tmp_path)]).drives) == ["A-01"]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.text(min_size=1, max_size=300), min_size=1, max_size=6, unique=True))
def test_names_are_safe_and_apart_whatever_the_logs_are_called(texts: list[str]) -> None:
    logs = [f"s3://bucket/{text.replace('*', '').replace('?', '').replace('[', '')}.mcap"
            for text in texts]  # fmt: skip
    logs = list(dict.fromkeys(logs))

    names = _names(drives_of(logs, each=True).drives)

    assert len(set(names)) == len(logs)
    for name in names:
        assert name == Path(name).name
        assert name not in (".", "..")
        assert len(name.encode()) < 200


def test_an_unreadable_folder_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)

    with pytest.raises(LogError, match="Permission denied"):
        drives_of([str(tmp_path)])
