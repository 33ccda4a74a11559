"""Properties of all formats of CAN logs."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.can_files import damaged, read_back
from support.can_kinds import KINDS, Kind, judge

EVERY_KIND = pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))


def _file(folder: Path, kind: Kind, content: bytes) -> Path:
    path = folder / f"x{kind.suffix}"
    path.write_bytes(content)
    return path


@EVERY_KIND
@given(seed=st.integers(0, 2**31))
@settings(max_examples=5)
def test_frames_survive_write_and_read(
    tmp_path_factory: pytest.TempPathFactory, kind: Kind, seed: int
) -> None:
    frames = kind.frames(300, seed)
    path = _file(tmp_path_factory.mktemp("log"), kind, kind.spell(frames))

    found, ledger = read_back(path)

    assert found == kind.expected(frames)
    assert ledger.is_whole == (kind is not KINDS["blf-unclosed"])
    assert ledger.integrity != "not checked"


@pytest.mark.slow
@EVERY_KIND
def test_truncation_is_reported_and_adds_no_frames(tmp_path: Path, kind: Kind) -> None:
    frames = kind.frames(60)
    content = kind.spell(frames)
    path = tmp_path / f"x{kind.suffix}"
    for at in range(1, len(content), max(len(content) // 120, 1)):
        verdict = judge(kind, frames, content, content[:at], path)

        assert not verdict.is_fault, f"cut at {at}: {verdict}"


@pytest.mark.slow
@EVERY_KIND
def test_damage_adds_no_frames_and_hides_no_loss(tmp_path: Path, kind: Kind) -> None:
    frames = kind.frames(60)
    content = kind.spell(frames)
    path = tmp_path / f"x{kind.suffix}"
    for seed in range(120):
        verdict = judge(kind, frames, content, damaged(content, seed), path)

        assert not verdict.is_fault, f"seed {seed}: {verdict}"
