"""Laws that hold for every format of CAN log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.errors import CrosscueError
from crosscue.replay.ledger import Ledger
from crosscue.replay.log import Selection, open_log
from support.can_files import (
    START_NS,
    Sent,
    asc,
    blf,
    by_bus,
    candump,
    damaged,
    made,
    read_back,
    trc,
)


@dataclass(frozen=True, slots=True)
class Kind:
    """One way to write frames down.

    Attributes:
        spell: From frames to a file.
        suffix: Of the file.
        fd: It can hold CAN FD frames.
        buses: It names buses.
        tells_end: It shows whether its end is missing, even after a whole line.
        start_ns: Log time at which its clock begins.
        step_ns: Its clock's step.
    """

    spell: Callable[[Sequence[Sent]], bytes]
    suffix: str
    fd: bool = True
    buses: bool = True
    tells_end: bool = False
    start_ns: int = START_NS
    step_ns: int = 1_000

    def frames(self, count: int, seed: int = 1) -> list[Sent]:
        """Frames that it can hold."""
        frames = made(count, seed, fd=self.fd, step_ns=self.step_ns)
        return frames if self.buses else [replace(f, bus="1") for f in frames]

    def expected(self, frames: Sequence[Sent]) -> dict[str, list[Sent]]:
        """What a reader should give."""
        shifted = [replace(f, t_ns=f.t_ns - START_NS + self.start_ns) for f in frames]
        return by_bus(shifted, "can{}" if self.suffix == ".log" else "can/{}")


KINDS = {
    "candump": Kind(candump, ".log"),
    "asc": Kind(asc, ".asc", tells_end=True),
    "asc-relative": Kind(lambda f: asc(f, relative=True), ".asc", tells_end=True),
    "asc-comma": Kind(lambda f: asc(f, mark=","), ".asc", tells_end=True),
    "trc-1.0": Kind(lambda f: trc(f, "1.0"), ".trc", fd=False, buses=False, start_ns=0),
    "trc-1.1": Kind(lambda f: trc(f, "1.1"), ".trc", fd=False, buses=False),
    "trc-1.2": Kind(lambda f: trc(f, "1.2"), ".trc", fd=False),
    "trc-1.3": Kind(lambda f: trc(f, "1.3"), ".trc", fd=False),
    "trc-2.1": Kind(trc, ".trc"),
    "blf": Kind(blf, ".blf", tells_end=True),
    "blf-stored": Kind(lambda f: blf(f, stored=True), ".blf", tells_end=True),
    "blf-old": Kind(lambda f: blf(f, is_old=True), ".blf", tells_end=True, step_ns=10_000),
    "blf-unclosed": Kind(lambda f: blf(f, is_closed=False), ".blf", tells_end=True, start_ns=0),
}
EACH = pytest.mark.parametrize("kind", KINDS.values(), ids=list(KINDS))


def _file(folder: Path, kind: Kind, content: bytes) -> Path:
    path = folder / f"x{kind.suffix}"
    path.write_bytes(content)
    return path


def _read_or_refuse(path: Path) -> tuple[dict[str, list[Sent]], Ledger] | None:
    """What is read; None when the file is refused, which must be one line naming it."""
    try:
        open_log(path).close()
    except CrosscueError as refused:
        message = str(refused)
    else:
        return read_back(path)
    assert "\n" not in message
    assert path.name in message
    return None


@EACH
@given(seed=st.integers(0, 2**31))
@settings(max_examples=5, deadline=None)
def test_what_was_sent_is_what_is_read(
    tmp_path_factory: pytest.TempPathFactory, kind: Kind, seed: int
) -> None:
    frames = kind.frames(300, seed)
    path = _file(tmp_path_factory.mktemp("log"), kind, kind.spell(frames))

    found, ledger = read_back(path)

    assert found == kind.expected(frames)
    assert ledger.is_whole == (kind is not KINDS["blf-unclosed"])
    assert ledger.integrity != "not checked"


@EACH
def test_no_cut_is_silent_and_none_invents_a_frame(tmp_path: Path, kind: Kind) -> None:
    frames = kind.frames(60)
    content = kind.spell(frames)
    for at in range(1, len(content), max(len(content) // 120, 1)):
        read = _read_or_refuse(_file(tmp_path, kind, content[:at]))
        if read is None:
            continue
        found, ledger = read
        expected = kind.expected(frames)
        count = sum(map(len, found.values()))
        assert found == {n: expected[n][: len(f)] for n, f in found.items()}
        is_line_end = content[:at].endswith(b"\n") and not kind.tells_end
        if count < len(frames) and not is_line_end:
            assert not ledger.is_whole, f"cut at {at}: {count} frames, nothing said"


@EACH
def test_no_damage_invents_frames_or_hides_their_loss(tmp_path: Path, kind: Kind) -> None:
    frames = kind.frames(60)
    content = kind.spell(frames)
    whole = Counter((f.arbitration_id, f.payload) for f in frames)
    for seed in range(120):
        copy = damaged(content, seed)
        outcome = _read_or_refuse(_file(tmp_path, kind, copy))
        if outcome is None:
            continue
        found, ledger = outcome
        read = Counter((f.arbitration_id, f.payload) for rows in found.values() for f in rows)
        # Text has no checksum: the lines hit may say something else, but they are no more.
        hit = _lines_hit(content, copy) if kind.suffix != ".blf" else 0
        if kind is KINDS["blf-stored"]:
            hit = 3
        assert (read - whole).total() <= hit, f"seed {seed}"
        assert read.total() <= len(frames), f"seed {seed}"
        if read.total() < len(frames):
            others = ledger.topic("").skipped.total() > (kind.suffix == ".asc")
            said = not ledger.is_whole or others
            assert said, f"seed {seed}: {read.total()} frames, nothing said"


def _lines_hit(content: bytes, copy: bytes) -> int:
    places = [k for k, (a, b) in enumerate(zip(content, copy, strict=True)) if a != b]
    if not places:
        return 0
    return content[places[0] : places[-1] + 1].count(b"\n") + 1


@EACH
def test_only_what_was_asked_for_comes_and_the_rest_is_counted(tmp_path: Path, kind: Kind) -> None:
    frames = kind.frames(200)
    expected = kind.expected(frames)
    path = _file(tmp_path, kind, kind.spell(frames))
    name = sorted(expected)[0]
    times = [f.t_ns for f in expected[name]]
    lo, hi = times[len(times) // 3], times[2 * len(times) // 3]

    found, ledger = read_back(path, Selection(frozenset({name}), lo, hi))

    assert found == {name: [f for f in expected[name] if lo <= f.t_ns < hi]}
    assert {n: ledger.topic(n).found for n in expected} == {n: len(f) for n, f in expected.items()}


@EACH
def test_topics_are_known_before_reading(tmp_path: Path, kind: Kind) -> None:
    frames = kind.frames(50)

    with open_log(_file(tmp_path, kind, kind.spell(frames))) as log:
        assert {t.name for t in log.topics} == set(kind.expected(frames))
        assert {t.type_name for t in log.topics} == {"crosscue/CanFrames"}
