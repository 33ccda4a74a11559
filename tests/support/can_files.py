"""CAN logs made from a list of frames, and read back as one."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import can

from crosscue.replay.columns import DATA, ERROR, REMOTE, CanFrames
from crosscue.replay.ledger import Ledger
from crosscue.replay.log import EVERYTHING, Selection, open_log

START_NS = 1_436_509_052_000_000_000
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


@dataclass(frozen=True, slots=True)
class Sent:
    """One frame as it was on the bus."""

    t_ns: int
    bus: str
    arbitration_id: int
    payload: bytes
    is_extended: bool = False
    kind: int = DATA
    is_fd: bool = False


def made(count: int, seed: int = 1, *, fd: bool = True, step_ns: int = 1_000) -> list[Sent]:
    """``count`` simulated frames on two buses, in time order, of all kinds."""
    chance = random.Random(seed)
    frames, t_ns = [], START_NS
    for _ in range(count):
        t_ns += step_ns * chance.randrange(0, 2_000)
        is_extended = chance.random() < 0.3
        identifier = chance.randrange(0x20000000 if is_extended else 0x800)
        is_fd = fd and chance.random() < 0.2
        length = chance.choice(FD_LENGTHS) if is_fd else chance.randrange(9)
        kind = REMOTE if not is_fd and chance.random() < 0.05 else DATA
        payload = b"" if kind == REMOTE else chance.randbytes(length)
        bus = chance.choice(("1", "2"))
        frames.append(Sent(t_ns, bus, identifier, payload, is_extended, kind, is_fd))
    return frames


def candump_line(frame: Sent) -> str:
    """As ``candump -l`` writes it."""
    flags = 0x20000000 if frame.kind == ERROR else 0
    width = 8 if frame.is_extended or flags else 3
    separator = "##1" if frame.is_fd else "#R" if frame.kind == REMOTE else "#"
    identifier = f"{frame.arbitration_id | flags:0{width}X}"
    seconds, nanos = divmod(frame.t_ns, 10**9)
    text = f"{identifier}{separator}{frame.payload.hex().upper()}"
    return f"({seconds:010d}.{nanos // 1000:06d}) can{frame.bus} {text}"


def candump(frames: Sequence[Sent]) -> bytes:
    """A candump log."""
    return "".join(candump_line(frame) + "\n" for frame in frames).encode()


def frames_of(columns: CanFrames, log_ns: Sequence[int], bus: str) -> Iterator[Sent]:
    """Rows of a block as frames."""
    for k, t_ns in enumerate(log_ns):
        yield Sent(
            int(t_ns),
            bus,
            int(columns.arbitration_id[k]),
            columns.data[k, : columns.length[k]].tobytes(),
            bool(columns.is_extended[k]),
            int(columns.kind[k]),
            bool(columns.is_fd[k]),
        )


def read_back(
    path: Path, selection: Selection = EVERYTHING
) -> tuple[dict[str, list[Sent]], Ledger]:
    """All frames by topic, and the account."""
    ledger = Ledger(str(path))
    found: dict[str, list[Sent]] = {}
    with open_log(path) as log:
        for block in log.read(ledger, selection):
            assert isinstance(block.rows, CanFrames)
            assert not any(
                block.rows.data[k, length:].any() for k, length in enumerate(block.rows.length)
            )
            rows = frames_of(block.rows, block.log_ns.tolist(), block.topic)
            found.setdefault(block.topic, []).extend(rows)
        assert {topic.name for topic in log.topics} >= set(found)
    for name, rows_of_bus in found.items():
        assert ledger.topic(name).used == len(rows_of_bus)
    return found, ledger


def by_bus(frames: Sequence[Sent], spelled: str = "can/{}") -> dict[str, list[Sent]]:
    """What a reader should give for ``frames``, when bus ``1`` becomes ``spelled``."""
    found: dict[str, list[Sent]] = {}
    for f in frames:
        name = spelled.format(f.bus)
        found.setdefault(name, []).append(
            Sent(f.t_ns, name, f.arbitration_id, f.payload, f.is_extended, f.kind, f.is_fd)
        )
    return found


def damaged(whole: bytes, seed: int) -> bytes:
    """A copy with 1 to 64 consecutive bytes replaced: random ones, zeros, or one bit flipped."""
    chance = random.Random(seed)
    at = chance.randrange(len(whole))
    count = min(chance.randrange(1, 65), len(whole) - at)
    match chance.randrange(3):
        case 0:
            patch = chance.randbytes(count)
        case 1:
            patch = bytes(count)
        case _:
            patch = bytes([whole[at] ^ 1 << chance.randrange(8)])
    return whole[:at] + patch + whole[at + len(patch) :]


def same_as_python_can(path: Path, peer: Iterable[can.Message], bus: str = "{}") -> None:
    """Hold our frames against python-can's, one by one; its times are binary fractions."""
    found, ledger = read_back(path)
    theirs: dict[str, list[can.Message]] = {}
    for message in peer:
        theirs.setdefault(bus.format(message.channel), []).append(message)
    assert ledger.is_whole
    assert {name: len(frames) for name, frames in found.items()} == {
        name: len(messages) for name, messages in theirs.items()
    }
    for name, frames in found.items():
        for ours, message in zip(frames, theirs[name], strict=True):
            assert ours.arbitration_id == message.arbitration_id
            assert ours.payload == bytes(message.data)
            assert ours.is_extended == message.is_extended_id
            assert ours.is_fd == message.is_fd
            assert (ours.kind == REMOTE) == message.is_remote_frame
            assert (ours.kind == ERROR) == message.is_error_frame
            assert abs(ours.t_ns - message.timestamp * 1e9) < 300
