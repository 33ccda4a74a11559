"""The manifest is a typed record that is read back unchanged and refuses other keys."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from crosscue.eval import cli
from crosscue.eval.batch.merge import merge_runs
from crosscue.eval.runs.account import account
from crosscue.eval.runs.folder import RunFolder, create, open_run, write_manifest
from crosscue.eval.runs.manifest import FORMAT_VERSION, EstimateManifest, Manifest, TimeSegments
from crosscue.replay.errors import RunError
from crosscue.replay.time.segments import Cause, Epoch, EpochMarks, LogClock, TimeSegment
from support.manifests import detected, estimated, log_account

SET_BACK = TimeSegments(
    segments=(
        TimeSegment(0, 0, 1, 2, 1, 2, Cause.START),
        TimeSegment(1, 5, 5, 9, 3, 7, Cause.SET_BACK, None, -2, breaks_odometry=True),
    ),
    clocks=(LogClock((Epoch(0, 0), Epoch(5, 2)), {"/a": EpochMarks((3, None), (7,), ((1, 2),))}),),
    notices=("set back",),
)
RICH = detected("/cam", {"finder": "objects"}, time=SET_BACK)
LOST = account([log_account("a", "/t", used=7, skipped={"dull": 2}, dropped={"cut": 1})])


@pytest.mark.parametrize(
    "manifest",
    [estimated(), estimated(detect=RICH, account=LOST), RICH],
    ids=["bare", "rich", "detect"],
)
def test_manifest_is_read_back_unchanged(manifest: Manifest, tmp_path: Path) -> None:
    run = create(tmp_path / "run", overwrite=False)
    write_manifest(run, manifest)
    first = run.file("manifest.json").read_bytes()

    assert run.manifest() == manifest
    write_manifest(run, run.manifest())
    assert run.file("manifest.json").read_bytes() == first


@pytest.mark.parametrize("command", ["score", "estimate", "view"])
def test_single_drive_commands_refuse_merged_run_in_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    merged = create(tmp_path / "merged", overwrite=False).path
    merge_runs({}, RunFolder(merged), {})

    assert cli.run([command, str(merged)]) == 1

    assert re.fullmatch(r"crosscue: .*many drives.*\n", capsys.readouterr().err)


def _run_with_changed_manifest(run: RunFolder, **changes: Any) -> RunFolder:
    write_manifest(run, estimated())
    path = run.file("manifest.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return run


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 2}, rf"format 2, this crosscue reads {FORMAT_VERSION}: replay again"),
        ({"format_version": None}, r"format None"),
        ({"stage": "dream"}, r"stage: .*'dream'.*replay again"),
        ({"settings": {"version": 1, "wings": 2}}, r"settings: wings: extra inputs.*replay again"),
        ({"notices": "none"}, r"notices: .*replay again"),
        ({"pose": {"rows": "7", "travelled_m": 0.0, "major_axis_m": None}}, r"pose\.rows: "),
        ({"colour": "red"}, r"colour: extra inputs are not permitted"),
    ],
)
def test_invalid_manifest_is_refused_in_one_line(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    run = _run_with_changed_manifest(create(tmp_path / "run", overwrite=False), **changes)

    with pytest.raises(RunError, match=message) as error:
        open_run(run.path)
    assert "\n" not in str(error.value)


def test_run_schema_covers_all_stages(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["run", "schema"]) == 0
    printed = capsys.readouterr().out
    assert cli.run(["run", "schema", "-o", str(tmp_path / "s.json")]) == 0
    assert (tmp_path / "s.json").read_text() == printed
    assert cli.run(["run", "schema", "-o", str(tmp_path / "s.json")]) == 1
    schema = json.loads(printed)
    stages = set(schema["discriminator"]["mapping"])
    assert stages == {"detect", "estimate", "merged", "decode"}
    names = schema["$defs"][EstimateManifest.__name__]
    assert names["properties"].keys() == estimated().as_json().keys()
    assert names["properties"]["format_version"]["const"] == FORMAT_VERSION
    assert schema["$defs"]["Line"]["properties"].keys() >= {"in", "used", "skipped", "dropped"}
    assert names["additionalProperties"] is False

    assert cli.run(["truth", "schema", "-o", str(tmp_path / "t.json")]) == 0
    assert json.loads((tmp_path / "t.json").read_text())["title"] == "Truth"
