"""``crosscue check``: files are recognised by content and checked against each other."""

import shutil
from pathlib import Path

import pytest

import crosscue
from crosscue.eval import cli
from crosscue.eval.check import KINDS
from crosscue.eval.fit.truth_check import TruthFit
from support import scene_run
from support.refusals import refusal
from support.scoring import good_truth, truth, truth_folder

CAR = "version = 1\n"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log, its run and its truth."""
    folder = tmp_path_factory.mktemp("drive")
    scene_run.scene_run(folder)
    truth_folder(folder, truth(good_truth().truth.cues))
    return folder


def kinds_of(*files: Path | str) -> list[str | None]:
    return [row.kind for row in crosscue.check(*files)]


def test_files_are_recognised_by_content_whatever_their_names(drive: Path, tmp_path: Path) -> None:
    for name, text in {
        "settings.txt": CAR,
        "card.txt": 'version = 1\nweights = "net.onnx"\nsha256 = "0"\n',
        "truth.txt": (drive / "truth.json").read_text(),
    }.items():
        (tmp_path / name).write_text(text)

    names = ("settings.txt", "card.txt", "truth.txt")
    assert kinds_of(*(tmp_path / name for name in names)) == ["vehicle file", "model card", "truth"]
    log = str(shutil.copy(drive / "drive.mcap", tmp_path))
    crosscue.seal(log)
    assert kinds_of(log, f"{log}.seal", drive / "run", drive, "nosuch-model") == [
        "log",
        "seal",
        "run",
        "truth",
        "model",
    ]


def test_every_kind_is_named_where_none_fits(tmp_path: Path) -> None:
    (tmp_path / "x.bin").write_bytes(b"\0\1")

    (row,) = crosscue.check(tmp_path / "x.bin")

    assert (row.kind, row.exit_status) == (None, 4)
    assert all(kind.name in str(row.error) for kind in KINDS)


def test_truth_is_compared_with_the_log_that_is_named_with_it(drive: Path) -> None:
    alone = crosscue.check(drive / "truth.json")[0].result
    (row,) = crosscue.check(drive / "truth.json", drive / "drive.mcap")

    assert isinstance(alone, TruthFit)
    assert "not compared: name the log" in repr(alone)
    assert isinstance(row.result, TruthFit)
    assert row.result.log == drive / "drive.mcap"


def test_exit_status_is_that_of_the_worst_file_and_the_others_are_still_checked(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = str(shutil.copy(drive / "drive.mcap", tmp_path))
    crosscue.seal(log)
    raw = bytearray(Path(log).read_bytes())
    raw[len(raw) // 2] ^= 1
    Path(log).write_bytes(raw)
    (tmp_path / "bad.toml").write_text("version = 1\nnonsense = 2\n")

    status = cli.run(
        ["check", str(tmp_path / "bad.toml"), log, str(tmp_path / "gone"), str(drive / "run")]
    )

    captured = capsys.readouterr()
    assert status == 4
    assert "nonsense" in captured.err
    assert "no such file" in captured.err
    assert captured.err.count("\n") == 2
    assert "differ from the seal" in captured.out
    assert "match their checksums" in captured.out


def test_run_with_changed_table_or_log_fails(drive: Path, tmp_path: Path) -> None:
    shutil.copytree(drive, tmp_path / "copy")
    run = tmp_path / "copy" / "run"
    assert crosscue.check(run)[0].error is None
    log = tmp_path / "copy" / "drive.mcap"
    whole = log.read_bytes()
    log.write_bytes(whole[:-1] + b"\0")
    assert "has changed since" in str(crosscue.check(run)[0].error)
    log.write_bytes(whole)
    table = run / "cues.parquet"
    table.write_bytes(table.read_bytes()[:-1] + b"\0")
    assert "cues" in str(crosscue.check(run)[0].error)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("car.toml --picture x.png", "--picture x.png: applies only to a model"),
        ("car.toml -o check.html", "--output check.html: expected one file to show, found 0"),
    ],
)
def test_setting_that_applies_to_no_file_is_refused(
    line: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("car.toml").write_text(CAR)

    assert message in refusal(2, "check", *line.split())
