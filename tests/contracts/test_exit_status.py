"""Commands return the exit status that docs/reference/exit_status.md states in each row."""

import json
import re
import shutil
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import pytest

from crosscue.eval import cli
from support.empty_inputs import COMMANDS, empty_inputs
from support.every_format import EVERY_FORMAT
from support.landmark_files import database_of
from support.mcap_files import ChunkOf, McapFile, channel, message, schema
from support.onnx_models import bright_box_model, write_card
from support.pictures import picture_folder

PAGE: Final = Path(__file__).parents[2] / "docs" / "reference" / "exit_status.md"
LATER: Final = "--from 100000"
STAGES: Final = ("reading", "detecting", "estimating", "scoring")


def _empty_cases(*first_words: str) -> list[tuple[int, str]]:
    """Return cases of commands with an empty result, selected by their first word."""
    return [
        (1, f"{name} {line}") for name, line in COMMANDS.items() if name.split()[0] in first_words
    ]


WITHOUT_RESULT: Final = {f"{name} {line}" for name, line in COMMANDS.items()}


def _all_four(log: str) -> list[tuple[int, str]]:
    return [
        (4, f"replay {log} -o {{out}} --vehicle {{car}}"),
        (4, f"detect {log} -o {{out}} --vehicle {{car}} --detectors grey --no-cache"),
        (4, f"decode {log} -o {{out}}"),
        (4, f"convert {log} -o {{out}}.mcap"),
    ]


STATUS: Final[dict[str, list[tuple[int, str]]]] = {
    "0": [
        (0, "info {log}"),
        (0, "replay {log} -o {out} --vehicle {car} --no-cache"),
        (0, "score {run} --truth {truth} --without-figures --gate {kept}"),
    ],
    "1": [
        (1, "convert {log} -o {log}/below.mcap"),
        (1, "score {run} --truth {truth} --without-figures --gate {violated}"),
        (1, "check {truth} {other}"),
        (1, "decode {log} -o {out} --vehicle {contradicting}"),
        (1, f"decode {{log}} -o {{out}} {LATER}"),
    ],
    "2": [
        (2, "info"),
        (2, "info {log} --topics /gone"),
        (2, "replay {log} -o {out} --vehicle {noise}"),
        (2, "replay {log} -o {out} --vehicle {mute}"),
        (2, "score {run} --truth {truth} --gate {noise}"),
        (2, "model show {noise}"),
    ],
    "3": [
        (3, "info {cut}"),
        (3, "replay {cut} -o {out} --vehicle {car} --no-cache"),
        (3, "convert {cut} -o {out}.mcap"),
    ],
    "4": [
        (4, "info {gone}"),
        (4, "info {noise}"),
        (4, "estimate {gone}"),
        (4, "estimate {older}"),
        (4, "compare {run} {cut_run}"),
        (4, "landmarks list {gone}"),
        (4, "landmarks list {noise}"),
        (4, "decode {log} -o {out} --vehicle {without_dbc}"),
        (4, "landmarks match {db} {gone}"),
        (4, "landmarks match {db} {noise}"),
        (4, "check {gone}"),
        (4, "check {noise}"),
        (4, "check {newer} {log}"),
    ],
    "130, 143": [
        (130, "detect {log} -o {out} --detectors support.stopping:interrupted --no-cache"),
        (143, "detect {log} -o {out} --detectors support.stopping:terminated --no-cache"),
    ],
}
EMPTY: Final[dict[str, list[tuple[int, str]]]] = {
    "`replay`, `estimate`": [
        (1, f"replay {{log}} -o {{out}} --vehicle {{car}} {LATER}"),
        (1, "replay {can_log} -o {out}"),
        (1, "replay {can_log} -o {out} --detectors signs"),
        (1, "estimate {run} --vehicle {other_car}"),
    ],
    "`detect`": [
        (1, f"detect {{log}} -o {{out}} --detectors support.gap_drive:build {LATER}"),
        (1, "detect {spoiled} -o {out} --detectors signs"),
        (1, "detect {can_log} -o {out} --detectors signs"),
    ],
    "`decode`, `convert`": [
        (1, f"decode {{log}} -o {{out}} {LATER}"),
        (1, f"convert {{log}} -o {{out}}.mcap {LATER}"),
        (3, "convert {unwritable} -o {out}.mcap"),
    ],
    "all four": _all_four("{nothing_whole}"),
    "`score`": _empty_cases("score"),
    "`truth`, `truth import`": _empty_cases("truth"),
    "`fit ...`, `train ...`": _empty_cases("fit", "train"),
    "`landmarks add`": _empty_cases("landmarks"),
    "`vehicle init`, `check`": _empty_cases("vehicle", "check"),
    "`check` of a log": [(1, "check {can_log}"), (3, "check {log} --vehicle {car} --for cues")],
    "`check` of a model": [(3, "check {net} --picture {white}")],
    "`merge`": _empty_cases("merge", "browse", "export"),
    "`info`, `query`": [
        (0, "info {rowless}"),
        (3, "info {nothing_whole}"),
        (0, "query {run} select/**/cue/**/from/**/cues/**/where/**/false"),
    ],
    "many drives": [
        (4, "replay --each {noise} {noise2} -o {out}"),
        (1, "replay --each {noise} {can_log} -o {out}"),
        (3, "replay --each {noise} {log} -o {out} --vehicle {car} --no-cache"),
    ],
}


def _rows() -> list[list[str]]:
    """Return the cells of every row of the page's tables."""
    lines = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [
        row
        for row, after in zip(cells, [*cells[1:], ["end"]], strict=True)
        if not set("".join(row)) <= {"-"} and not set("".join(after)) <= {"-"}
    ]


ROWS: Final = _rows()


def test_every_row_of_exit_status_page_has_case() -> None:
    assert [row[0] for row in ROWS] == [*STATUS, *STAGES, *EMPTY]


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Valid, empty and truncated inputs, and inputs of another version."""
    folder = tmp_path_factory.mktemp("inputs")
    found = empty_inputs(folder)
    log, run, drive = found["log"], found["run"], found["car"].parent
    text = found["car"].read_text()
    for name in ("noise", "noise2"):
        (folder / name).write_bytes(bytes(range(256)) * 8)
    (folder / "cut.mcap").write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
    for name, bound in (("kept", 0.0), ("violated", 2.0)):
        (folder / f"{name}.toml").write_text(
            f'version = 1\n[[gate]]\nmetric = "cues.stop_sign.precision"\nmin = {bound}\n'
        )
    dbc = (drive / "simulated_car.dbc").read_text()
    (drive / "turned.dbc").write_text(dbc.replace("|16@1", "|15@1").replace("|16@0", "|15@0"))
    (drive / "shifted.dbc").write_text(re.sub(r"(?m)^BO_ 176 ", "BO_ 177 ", dbc))
    cars = {
        "contradicting": text.replace('car.dbc"', 'car.dbc", "turned.dbc"'),
        "without_dbc": text.replace("simulated_car.dbc", "gone.dbc"),
        "other_car": text.replace("simulated_car.dbc", "shifted.dbc"),
        "mute": text.replace('camera = "camera"', 'camera = "/gone"'),
    }
    for name, content in cars.items():
        (drive / f"{name}.toml").write_text(content)
    output = 'kind = "end-to-end"\nclasses = ["bright"]'
    # Its scale is another than the network expects.
    write_card(folder, bright_box_model(), output, (96, 64), "scale = [0.004, 0.004, 0.004]")
    cv2.imwrite(str(folder / "white.png"), np.full((64, 96, 3), 255, np.uint8))
    spoiled = picture_folder(folder / "spoiled", 3, "rate_hz: 10\n")
    for one in spoiled.glob("*.png"):
        one.write_bytes(b"\x89PNG")
    invalid_schema = [
        schema(1, "made_msgs/msg/Bad", body=b"not a definition ~~\n"),
        channel(1, 1, "/bad"),
        *(message(1, k, bytes(4)) for k in range(3)),
    ]
    parts = {
        "rowless": [],
        "unwritable": [ChunkOf(invalid_schema)],
        "nothing_whole": [ChunkOf(invalid_schema, crc=1)],
    }
    for name, chunks in parts.items():
        (folder / f"{name}.mcap").write_bytes(McapFile(chunks).coded())
    older, cut_run = (shutil.copytree(run, folder / name) for name in ("older", "cut_run"))
    for source, changed, version in (
        (run / "manifest.json", older / "manifest.json", {"format_version": 0}),
        (drive / "truth.json", drive / "newer.json", {"version": 99}),
    ):
        changed.write_text(json.dumps({**json.loads(source.read_text()), **version}))
    (cut_run / "pose.parquet").write_bytes((run / "pose.parquet").read_bytes()[:-100])
    return {
        **found,
        **{path.stem: path for path in folder.glob("*.toml")},
        **{name: drive / f"{name}.toml" for name in cars},
        "truth": drive / "truth.json",
        "noise": folder / "noise",
        "gone": folder / "gone",
        "noise2": folder / "noise2",
        "white": folder / "white.png",
        "cut": folder / "cut.mcap",
        "older": older,
        "cut_run": cut_run,
        "newer": drive / "newer.json",
        "db": database_of(folder / "known.db", np.array([[0.0, 1.0]])),
        "can_log": EVERY_FORMAT["candump"](folder),
        "spoiled": spoiled,
        **{name: folder / f"{name}.mcap" for name in parts},
    }


@pytest.mark.parametrize("row", [row for row in ROWS if row[0] not in STAGES], ids=lambda r: r[0])
def test_commands_return_documented_exit_status(
    row: list[str], names: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cases = STATUS.get(row[0]) or EMPTY[row[0]]
    stated = {int(n) for n in re.findall(r"\b\d+\b", row[0] if row[0] in STATUS else row[-1])}
    found = {}

    for number, (status, line) in enumerate(cases):
        argv = line.format(**names, out=tmp_path / f"out{number}").split()
        before = {*tmp_path.rglob("*"), *names["run"].rglob("*")}
        got, (out, error) = cli.run(argv), capsys.readouterr()
        if got != status or "bug" in error or (got != 3 and error.count("\n") > 1):
            found[line] = (got, error)
        # Valid input without a result: one line, and no files.
        if line in WITHOUT_RESULT:
            assert {*tmp_path.rglob("*"), *names["run"].rglob("*")} == before, line
            assert (out, error[:10], error.count("\n")) == ("", "crosscue: ", 1), line

    assert not found
    assert stated <= {status for status, _ in cases}


@pytest.mark.parametrize("stage", STAGES)
def test_every_stage_accounts_for_all_its_inputs(
    stage: str, names: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    argv = ["replay", names["cut"], "--vehicle", names["car"], "-o", out, "--no-cache", "--json"]
    assert cli.run([str(one) for one in argv]) == 3
    printed = capsys.readouterr().out
    if stage == "scoring":
        cli.run(["score", str(out), "--truth", str(names["truth"]), "--any-log", "--json"])
        printed = json.dumps(json.loads(capsys.readouterr().out)["metrics"])

    lines = json.loads(printed)["account"][stage]
    topics = [t for log in lines for t in log["topics"].values()] if stage == "reading" else None

    counted = topics or list(lines.values())
    assert any(one["used"] for one in counted)
    for one in counted:
        gone = sum(one["skipped"].values()) + sum(one["dropped"].values())
        assert one["in"] == one["used"] + gone
    if stage == "reading":
        assert any(one["dropped"] or one["dropped_unknown"] for one in counted)
