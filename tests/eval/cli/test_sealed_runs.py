"""Damage to a sealed log after a run is reported by every command that reads the log again."""

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


@pytest.mark.slow
def test_damage_to_sealed_log_after_the_run_is_reported(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pictured, "SIZE", (400, 225))
    made = [_run_with_sealed_log(tmp_path / name) for name in ("one", "two")]
    one, two = (run for run, _ in made)
    commands = [
        ["view", str(one), "-o", str(tmp_path / "out.rrd"), "--overwrite"],
        ["score", str(one)],
        ["score", str(one), str(two), "-o", str(tmp_path / "all"), "--workers", "2"],
    ]
    for argv in commands[:2]:
        cli.run(argv)
        assert "differ from the seal" not in capfd.readouterr().err

    _damage_middle(made[0][1])

    for argv in commands:
        assert cli.run(argv) == 3
        printed = capfd.readouterr().err.splitlines()
        reported = [line for line in printed if "differ from the seal" in line]
        assert reported
        assert all(line.startswith("crosscue: dropped: ") for line in reported)
        assert all("one" in line and "drive.mcap: bytes " in line for line in reported)
