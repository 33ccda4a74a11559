"""Damage to a sealed log after a run is reported by every command that reads the log again."""

from __future__ import annotations

from pathlib import Path

import pytest

from crosscue.eval import cli
from crosscue.replay.limits import MIB
from support import scene_run as pictured
from support.scoring import approach, good_truth, span, truth, truth_folder


def _run_with_sealed_log(folder: Path) -> tuple[Path, Path]:
    run = pictured.scene_run(folder).path
    # A false crossing car in the truth, so that the page shows its picture.
    wrong = span("cross_traffic_right", 0, 40, present=False, count=0)
    reported = truth([*good_truth().truth.cues, wrong], approaches=[approach(intersection="A")])
    truth_folder(folder, reported)
    log = folder / "drive.mcap"
    assert cli.run(["seal", str(log)]) == 0
    return run, log


def _damage_middle(log: Path) -> None:
    """Damage bytes in the middle, not in head, tail and index, which identify a large log."""
    raw = bytearray(log.read_bytes())
    assert len(raw) > 5 * MIB
    for at in range(MIB + MIB // 2, len(raw) - MIB, MIB // 2):
        raw[at] ^= 0x10
    log.write_bytes(raw)


def _command_line(command: str, runs: list[Path], out: Path) -> list[str]:
    named = [str(run) for run in runs]
    return {
        "view": ["view", named[0], "-o", str(out / "out.rrd")],
        "score": ["score", named[0]],
        "score --workers": ["score", *named, "-o", str(out / "all"), "--workers", "2"],
    }[command]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["view", "score", "score --workers"])
def test_damage_to_sealed_log_after_the_run_is_reported(
    command: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pictured, "SIZE", (400, 225))
    made = [_run_with_sealed_log(tmp_path / name) for name in ("one", "two")]
    argv = _command_line(command, [run for run, _ in made], tmp_path)
    cli.run(argv)
    assert "differ from the seal" not in capfd.readouterr().err

    log = made[0][1]
    _damage_middle(log)
    again = [*argv, "--overwrite"] if command == "view" else argv

    assert cli.run(again) == 3
    reported = [
        line for line in capfd.readouterr().err.splitlines() if "differ from the seal" in line
    ]
    assert reported
    assert all(line.startswith("crosscue: dropped: ") for line in reported)
    assert all("one" in line and "drive.mcap: bytes " in line for line in reported)
