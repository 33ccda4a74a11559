"""Drives named on the command line."""

import re
import uuid
from importlib import import_module
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.eval.batch.drive_list import DriveInput, find_drives
from crosscue.replay.errors import CrosscueError, LogError, UsageError


def _touch(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(str(path))
    return folder


def _simulated(folder: Path, *names: str) -> Path:
    """Write a drive folder as ``crosscue simulate`` does."""
    for name in names:
        _touch(folder / name, "drive.mcap", "vehicle.toml", "truth.json", "objects.json", "car.dbc")
    return folder


def _names(drives: tuple[DriveInput, ...]) -> list[str]:
    """Return the names without their hash."""
    assert all(re.fullmatch(r".*-[0-9a-f]{8}", one.name, re.DOTALL) for one in drives)
    return [one.name[:-9] for one in drives]


# Files and folders of simulated drives to write, arguments, and the names of the drives found.
LAYOUTS: Final[dict[str, tuple[list[str], list[str], list[str], list[str]]]] = {
    "one log": (["a.b.mcap"], [], ["a.b.mcap"], ["a.b"]),
    "drive folder": ([], ["A-01"], ["A-01"], ["A-01"]),
    "folder of drives": (
        ["notes.txt", "runs/A-01/manifest.json", "runs/A-01/pictures/1.jpg"],
        ["B-02", "A-01"],
        [""],
        ["A-01", "B-02"],
    ),
    "folder of bags": (["mon.bag", "tue.bag"], [], [""], ["mon", "tue"]),
    "split bag": (["bag_0.mcap", "bag_1.mcap"], [], ["--each", ""], ["bag_0", "bag_1"]),
    "each log": (
        ["x/drive.mcap", "y/drive.mcap", "z/x/drive.mcap"],
        [],
        ["--each", "x/drive.mcap", "y/drive.mcap", "z/x/drive.mcap"],
        ["x", "y", "x"],
    ),
    "data set": (
        [f"{place}/processed_log/t" for place in ("one/40", "one/41", "two/40")],
        [],
        [""],
        ["one__40", "one__41", "two__40"],
    ),
    "pattern of files": ([], ["A-01", "A-02", "B-01"], ["A-*/drive.mcap"], ["A-01", "A-02"]),
    "pattern of folders": ([], ["A-01", "A-02", "B-01"], ["A-*"], ["A-01", "A-02"]),
    "deep pattern": ([], ["A-01", "B-01"], ["**/drive.mcap"], ["A-01", "B-01"]),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_drives_of_a_layout_are_found_and_named(tmp_path: Path, layout: str) -> None:
    files, simulated, arguments, names = LAYOUTS[layout]
    _touch(tmp_path, *files)
    _simulated(tmp_path, *simulated)
    each = "--each" in arguments

    found = find_drives(*[f"{tmp_path}/{one}" for one in arguments if one != "--each"], each=each)

    assert _names(found.drives) == names
    assert len({one.name for one in found.drives}) == len(names)
    assert found.is_many == (len(names) > 1)
    for drive, name in zip(found.drives, names, strict=True):
        if name in simulated:
            place = tmp_path / name
            assert drive.logs == (str(place / "drive.mcap"),)
            assert (drive.vehicle, drive.truth) == (place / "vehicle.toml", place / "truth.json")


def test_several_log_arguments_or_parts_of_a_bag_are_one_drive(tmp_path: Path) -> None:
    _touch(tmp_path, "monday.mcap", "tuesday.blf", "vehicle.toml", "bag/b_0.mcap", "bag/b_1.mcap")
    logs = (str(tmp_path / "monday.mcap"), str(tmp_path / "tuesday.blf"))

    found = find_drives(*logs)

    assert not found.is_many
    assert found.drives == (DriveInput(found.drives[0].name, logs),)
    assert find_drives(*logs[::-1]) == found
    assert find_drives(str(tmp_path / "bag")).drives[0].logs == (str(tmp_path / "bag"),)


def test_folder_of_mixed_formats_needs_a_vehicle_file(tmp_path: Path) -> None:
    _touch(tmp_path, "camera.bag", "can.blf")

    with pytest.raises(UsageError, match=r"several formats \(blf, rosbag1\): one drive or many"):
        find_drives(tmp_path)

    _touch(tmp_path, "vehicle.toml")
    assert len(find_drives(tmp_path).drives[0].logs) == 2


def test_list_file_names_drives_line_by_line(tmp_path: Path) -> None:
    _touch(tmp_path, "a b.mcap", "can.blf", "c.bag")
    _simulated(tmp_path / "sim", "A-01", "A-02")
    text = "# day one\n'a b.mcap' can.blf\n\nc.bag  # alone\nsim\nmemory://bucket/x.mcap\n"
    (tmp_path / "drives.txt").write_text(text)

    found = find_drives(f"@{tmp_path / 'drives.txt'}")

    assert found.is_many
    assert _names(found.drives) == ["a_b", "c", "A-01", "A-02", "x"]
    assert found.drives[0].logs == (str(tmp_path / "a b.mcap"), str(tmp_path / "can.blf"))
    assert found.drives[4].logs == ("memory://bucket/x.mcap",)


def test_remote_patterns_are_expanded() -> None:
    bucket = f"bucket-{uuid.uuid4().hex}"
    system = import_module("fsspec").filesystem("memory")
    for name in ("a/drive.mcap", "b/drive.mcap"):
        system.pipe(f"/{bucket}/{name}", b"")

    found = find_drives(f"memory://{bucket}/*/drive.mcap")
    system.rm(f"/{bucket}", recursive=True)

    assert _names(found.drives) == ["a", "b"]
    assert found.drives[0].logs == (f"memory://{bucket}/a/drive.mcap",)
    assert not find_drives(f"memory://{bucket}/a/drive.mcap").is_many


def test_drive_name_depends_only_on_its_logs(tmp_path: Path) -> None:
    _touch(tmp_path, "x/drive.mcap", "y/drive.mcap", "route/40/drive.mcap", "mon.bag", "tue.bag")
    logs = [str(path) for path in sorted(tmp_path.rglob("*.*"))]
    together = {one.logs: one.name for one in find_drives(*logs, each=True).drives}

    assert len(together) == len(logs)
    for log in logs:
        (alone,) = find_drives(log).drives
        assert together[alone.logs] == alone.name
    before = find_drives(logs[0]).drives[0].name
    Path(logs[0]).write_text("recorded again")
    assert find_drives(logs[0]).drives[0].name != before


def test_copy_of_a_recording_is_refused(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "monday.bag").write_text("the same")

    with pytest.raises(UsageError, match="the same recording as"):
        find_drives(tmp_path)


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("{}/nothing-*.mcap", "nothing matches"),
        ("@{}/gone.txt", "No such file"),
        ("@{}/empty.txt", "names no drive"),
        ("@{}/torn.txt", "line 2: No closing quotation"),
        ("@{}/twice.txt", "named twice"),
        ("{}/bare", "no drive found"),
    ],
)
def test_invalid_drive_arguments_are_refused_in_one_line(
    tmp_path: Path, argument: str, message: str
) -> None:
    _touch(tmp_path, "a.mcap", "bare/readme.md")
    tmp_path.joinpath("empty.txt").write_text("# none\n")
    tmp_path.joinpath("torn.txt").write_text("a.mcap\n'b\n")
    tmp_path.joinpath("twice.txt").write_text("a.mcap\na.mcap\n")

    with pytest.raises(CrosscueError, match=message) as caught:
        find_drives(argument.format(tmp_path))

    assert "\n" not in str(caught.value)


def test_cyclic_symbolic_link_is_not_followed(tmp_path: Path) -> None:
    _simulated(tmp_path, "A-01")
    (tmp_path / "again").symlink_to(tmp_path)

    assert _names(find_drives(tmp_path).drives) == ["A-01"]


@given(st.lists(st.text(min_size=1, max_size=300), min_size=1, max_size=6, unique=True))
def test_drive_names_are_unique_and_safe_file_names(texts: list[str]) -> None:
    logs = [
        f"memory://bucket/{text.replace('*', '').replace('?', '').replace('[', '')}.mcap"
        for text in texts
    ]
    logs = list(dict.fromkeys(logs))

    names = [one.name for one in find_drives(*logs, each=True).drives]

    assert len(set(names)) == len(logs)
    for name in names:
        assert name == Path(name).name
        assert name not in (".", "..")
        assert len(name.encode()) < 200


def test_unreadable_folder_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refuse)

    with pytest.raises(LogError, match="Permission denied"):
        find_drives(tmp_path)
