"""CAN layouts and frames for tests: random ones, and frames of real drives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

from crosscue.replay.can.layout import CanMessage, CanSignal
from crosscue.replay.columns import DATA, Block, CanFrames

from .data import shared

FRAME_LENGTHS = (1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


def comma2k19_frames(bus: int) -> Block:
    """All frames of one bus of a real segment, 8 bytes each because it does not store lengths."""
    folder = shared(
        *("comma2k19", "Example_1", "b0c9d2329ad1606b_2018-08-02--08-34-47", "40"),
        *("processed_log", "CAN", "raw_can"),
    )
    column = {
        name: np.load(folder / name, allow_pickle=False) for name in ("address", "data", "src", "t")
    }
    rows = np.flatnonzero(column["src"] == bus)
    # Element access would drop trailing zero bytes of the |S8 column; its buffer has them.
    payload = np.ascontiguousarray(column["data"].view(np.uint8).reshape(-1, 8)[rows])
    address = column["address"][rows]
    log_ns = np.round(column["t"][rows] * 1e9).astype(np.int64)
    frames = frames_of(payload, address.astype(np.uint32), address > 0x7FF)
    return Block(f"can{bus}", log_ns, frames)


def ford_frames() -> Block:
    """All frames of a real candump log of a Ford, parsed without crosscue."""
    path = shared(
        "can", "ford_fusion_2017", "acc_on_speed_changing_from_30km_to_80km_per_hour.candump"
    )
    lines = [line.split() for line in path.read_text().splitlines()]
    stamps = [stamp.strip("()").split(".") for stamp, _, _ in lines]
    ids, hexes = zip(*(frame.split("#") for _, _, frame in lines), strict=True)
    payload = np.zeros((len(lines), 8), dtype=np.uint8)
    length = np.array([len(text) // 2 for text in hexes], dtype=np.uint8)
    for row, text in enumerate(hexes):
        payload[row, : length[row]] = np.frombuffer(bytes.fromhex(text), dtype=np.uint8)
    frames = frames_of(
        payload,
        np.array([int(text, 16) for text in ids], dtype=np.uint32),
        np.array([len(text) == 8 for text in ids]),
        length,
    )
    log_ns = np.array([int(s) * 10**9 + int(us) * 1000 for s, us in stamps], dtype=np.int64)
    return Block("can0", log_ns, frames)


def frames_of(
    payload: NDArray[np.uint8],
    arbitration_id: ArrayLike,
    is_extended: ArrayLike = False,
    length: ArrayLike | None = None,
    kind: ArrayLike = DATA,
    is_fd: ArrayLike | None = None,
) -> CanFrames:
    """Frames with the given payloads; CAN FD if longer than 8 bytes."""
    n, carried = payload.shape
    data = np.zeros((n, 8 if carried <= 8 else 64), dtype=np.uint8)
    data[:, :carried] = payload

    def column(values: ArrayLike, kind: type[np.generic]) -> NDArray[Any]:
        return np.broadcast_to(np.asarray(values, kind), n).copy()

    return CanFrames(
        arbitration_id=column(arbitration_id, np.uint32),
        is_extended=column(is_extended, np.bool_),
        kind=column(kind, np.uint8),
        length=column(carried if length is None else length, np.uint8),
        data=data,
        is_fd=column(carried > 8 if is_fd is None else is_fd, np.bool_),
    )


def block_of(frames: CanFrames, topic: str = "can0") -> Block:
    """A block of frames that are a millisecond apart."""
    return Block(topic, np.arange(len(frames), dtype=np.int64) * 1_000_000, frames)


def join(blocks: Sequence[Block]) -> Block:
    """Concatenate blocks of frames."""
    rows = [b.rows for b in blocks if isinstance(b.rows, CanFrames)]
    columns = ("arbitration_id", "is_extended", "kind", "length", "data", "is_fd")
    joined = CanFrames(*(np.concatenate([getattr(r, name) for r in rows]) for name in columns))
    return Block(blocks[0].topic, np.concatenate([b.log_ns for b in blocks]), joined)


def dbc_text(messages: list[CanMessage]) -> str:
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: ECU"]
    tail = []
    for message in messages:
        stored = message.arbitration_id | (1 << 31 if message.is_extended else 0)
        lines += ["", f"BO_ {stored} {message.name}: {message.length} ECU"]
        for s in message.signals:
            mark = f"m{min(s.branches)}" if s.multiplexer else ""
            mark += "M" if s.is_multiplexer else ""
            order, sign = int(not s.is_big_endian), "-" if s.is_signed else "+"
            lines.append(
                f" SG_ {s.name} {mark} : {s.start}|{s.length}@{order}{sign} "
                f'({s.scale},{s.offset}) [{s.minimum or 0}|{s.maximum or 0}] "{s.unit}" ECU'
            )
            if s.is_float:
                kind = {32: 1, 64: 2}[s.length]
                tail.append(f"SIG_VALTYPE_ {stored} {s.name} : {kind};")
            if s.choices:
                named = " ".join(f'{raw} "{name}"' for raw, name in s.choices.items())
                tail.append(f"VAL_ {stored} {s.name} {named} ;")
            if s.multiplexer:
                ranges = ", ".join(f"{v}-{v}" for v in sorted(s.branches))
                tail.append(f"SG_MUL_VAL_ {stored} {s.name} {s.multiplexer} {ranges};")
    return "\n".join([*lines, "", *tail, ""])


@dataclass(slots=True)
class _Packing:
    """Bits of a message that signals use already."""

    length: int
    taken: set[int] = field(default_factory=set)

    def fit(self, signal: CanSignal) -> bool:
        """Mark the signal's bits as used if all are free, and return whether they were."""
        if signal.end_bit > 8 * self.length:
            return False
        run = range(signal.first_bit, signal.end_bit)
        bits = {8 * (b // 8) + 7 - b % 8 for b in run} if signal.is_big_endian else set(run)
        if bits & self.taken:
            return False
        self.taken |= bits
        return True

    def copy(self) -> _Packing:
        """Return an independent copy."""
        return _Packing(self.length, set(self.taken))


SCALES = st.sampled_from([1, 1, 1, -1, 2, 10, 3600, 0.1, 0.5, -0.01, 1e-7, 0.0625, 1.5])
OFFSETS = st.sampled_from([0, 0, 0, -40, 1, 500, 0.5, -273.15, -(2**31), 1e-3])


@st.composite
def signals(draw: st.DrawFn, name: str, length_bytes: int) -> CanSignal:
    """One random signal that fits into ``length_bytes``."""
    is_float = length_bytes >= 4 and draw(st.integers(0, 7)) == 0
    max_count = min(64, 8 * length_bytes)
    short = st.integers(1, min(16, max_count))
    length = draw(st.one_of(short, st.integers(1, max_count)))
    if is_float:
        length = draw(st.sampled_from([32, 64])) if length_bytes >= 8 else 32
    is_big_endian = draw(st.booleans())
    first = draw(st.integers(0, 8 * length_bytes - length))
    start = 8 * (first // 8) + 7 - first % 8 if is_big_endian else first
    return CanSignal(
        name=name,
        start=start,
        length=length,
        is_big_endian=is_big_endian,
        is_signed=draw(st.booleans()) and not is_float,
        is_float=is_float,
        scale=draw(SCALES),
        offset=draw(OFFSETS),
        unit=draw(st.sampled_from(["", "m/s", "°/s"])),
    )


@st.composite
def messages(draw: st.DrawFn, multiplexed: bool = False) -> CanMessage:
    """A random message whose signals do not overlap, optionally with nested multiplexers."""
    length = draw(st.sampled_from(FRAME_LENGTHS[2:] if multiplexed else FRAME_LENGTHS))
    packing = _Packing(length)
    made: list[CanSignal] = []
    if multiplexed:
        _add_multiplexer(draw, packing, made, None, depth=0)
    for i in range(draw(st.integers(1, 12))):
        signal = draw(signals(f"S{i}", length))
        if packing.fit(signal):
            made.append(signal)
    is_extended = draw(st.booleans())
    return CanMessage(
        name="Random",
        arbitration_id=draw(st.integers(0, 2**29 - 1 if is_extended else 2**11 - 1)),
        is_extended=is_extended,
        length=length,
        signals=tuple(made),
    )


def _add_multiplexer(
    draw: st.DrawFn,
    packing: _Packing,
    made: list[CanSignal],
    below: tuple[str, frozenset[int]] | None,
    depth: int,
) -> None:
    """Add a multiplexer of 1 to 4 bits with branches, which may contain another one."""
    selector = draw(signals(f"M{len(made)}", packing.length))
    selector = replace(
        selector,
        length=draw(st.integers(1, 4)),
        is_float=False,
        is_signed=False,
        scale=1,
        offset=0,
        is_multiplexer=True,
        multiplexer=below[0] if below else None,
        branches=below[1] if below else frozenset(),
    )
    if not packing.fit(selector):
        return
    at = len(made)
    made.append(selector)
    values = st.integers(0, 2**selector.length - 1)
    done: list[tuple[frozenset[int], set[int]]] = []
    for branch in draw(st.lists(st.frozensets(values, min_size=1, max_size=3), max_size=3)):
        # Branches of one multiplexer may use the same bits if their values differ.
        inside = packing.copy()
        inside.taken.update(*(taken for values_of, taken in done if values_of & branch))
        for _ in range(draw(st.integers(1, 3))):
            signal = draw(signals(f"B{len(made)}", packing.length))
            if inside.fit(signal):
                made.append(replace(signal, multiplexer=selector.name, branches=branch))
        if depth == 0 and draw(st.booleans()):
            _add_multiplexer(draw, inside, made, (selector.name, branch), depth + 1)
        done.append((branch, inside.taken))
    packing.taken.update(*(taken for _, taken in done))
    if len(made) == at + 1:
        made[at] = replace(selector, choices={0: "only"})
