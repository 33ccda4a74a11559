"""A camera missing from a truncated log is explained by the truncation, in every command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.truth.truth import Truth, save
from crosscue.datasets.truth.tum import planar, write_tum
from crosscue.eval import cli
from crosscue.localization.landmarks.database import LandmarkWriter
from support.mcap_files import ChunkOf, McapFile, channel, message, schema

START_NS = 1_700_000_000_000_000_000
# Commands that need a camera, with arguments.
NEEDS_CAMERA = {
    "truth import": "{coco} --log {log} -o {out}.json --vehicle {car}",
    "fit signs": "{drive} --label stop_sign",
    "landmarks add": "{out}.db {log} --poses {truth} --vehicle {car}",
    "fit landmarks": "{log} --database {db} --poses {truth} --vehicle {car}",
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
    t_ns = START_NS + np.arange(4) * 10**8
    zero = np.zeros(4)
    truth = Truth(
        version=1, source="x", start_ns=int(t_ns[0]), end_ns=int(t_ns[-1]) + 1, pose="pose.tum"
    )
    save(truth, folder)
    write_tum(folder / "pose.tum", planar(t_ns, 9 * np.arange(4.0), zero, zero), "made up")
    image = {"id": 0, "file_name": "a.png", "width": 24, "height": 16, "t_ns": START_NS}
    kinds = [{"id": 1, "name": "stop sign"}]
    coco = json.dumps({"categories": kinds, "images": [image], "annotations": []})
    (folder / "objects.json").write_text(coco)
    with LandmarkWriter(folder.parent / "known.db", "orb"):
        pass
    return {
        "drive": folder,
        "log": folder / "a.mcap",
        "car": folder / "vehicle.toml",
        "truth": folder / "truth.json",
        "coco": folder / "objects.json",
        "db": folder.parent / "known.db",
        "out": folder.parent / "out",
    }


ANY, NAMED = "", '[topics]\ncamera = "/camera"\n'


@pytest.mark.parametrize("is_cut", [False, True])
@pytest.mark.parametrize("camera", [ANY, NAMED], ids=["any", "named"])
@pytest.mark.parametrize("command", NEEDS_CAMERA)
def test_camera_missing_from_log_is_blamed_on_its_truncation_alone(
    command: str, is_cut: bool, camera: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = _drive(tmp_path / "drive", is_cut, camera)
    words = [word.replace("_sign", " sign") for word in NEEDS_CAMERA[command].split()]

    status = cli.run([*command.split(), *(word.format(**names) for word in words)])

    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert ("camera = '/camera': no such topic" if camera else "no camera") in error
    assert ("the file is cut" in error) == is_cut
    assert status == 4 if is_cut else status in (1, 2)
