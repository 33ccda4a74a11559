"""Decode the signals of real CAN buses: ours next to cantools, in one run.

    python benchmarks/can_decoding.py [rounds]

Every case decodes all frames of a bus that its DBC file defines. cantools receives them as bytes
with their message already looked up, and runs ``message.decode(decode_choices=False)`` on each.
Ours also looks up, checks and accounts for every frame of the bus, and sorts the rows by message.
The cases alternate, and ratios are taken round by round. All values are compared before timing.
Times are CPU seconds of one thread, because other work on the machine would hide milliseconds; a
case of a few milliseconds is repeated ten times. The recordings are in $CROSSCUE_DATA or
../shared/data.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from cantools.database.can import Message
from cantools.database.can.formats import dbc

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import BusDecoder
from crosscue.replay.can.layout import overlapping_signals
from crosscue.replay.columns import BLOCK_ROWS, Block, CanFrames, Table
from crosscue.replay.ledger import Ledger

DATA = Path(os.environ.get("CROSSCUE_DATA", Path(__file__).parents[2] / "shared" / "data"))
SEGMENT = DATA / "comma2k19/Example_1/b0c9d2329ad1606b_2018-08-02--08-34-47/40"
FORD = DATA / "can/ford_fusion_2017"


@dataclass(frozen=True, slots=True)
class Bus:
    """A recorded bus and its DBC file."""

    name: str
    block: Block
    dbc: Path


def comma2k19(source: int) -> Block:
    column = {
        name: np.load(SEGMENT / "processed_log/CAN/raw_can" / name, allow_pickle=False)
        for name in ("address", "data", "src", "t")
    }
    rows = np.flatnonzero(column["src"] == source)
    payload = np.ascontiguousarray(column["data"].view(np.uint8).reshape(-1, 8)[rows])
    address = column["address"][rows].astype(np.uint32)
    length = np.full(len(rows), 8, dtype=np.uint8)
    return block_of(address, address > 0x7FF, length, payload, column["t"][rows])


def ford() -> Block:
    path = FORD / "acc_on_speed_changing_from_30km_to_80km_per_hour.candump"
    lines = [line.split() for line in path.read_text().splitlines()]
    ids, hexes = zip(*(frame.split("#") for _, _, frame in lines), strict=True)
    length = np.array([len(text) // 2 for text in hexes], dtype=np.uint8)
    joined = b"".join(bytes.fromhex(text).ljust(8, b"\0") for text in hexes)
    payload = np.frombuffer(joined, dtype=np.uint8).reshape(-1, 8)
    stamps_s = np.array([float(stamp.strip("()")) for stamp, _, _ in lines])
    address = np.array([int(text, 16) for text in ids], dtype=np.uint32)
    return block_of(address, np.array([len(t) == 8 for t in ids]), length, payload, stamps_s)


def block_of(
    address: np.ndarray, extended: np.ndarray, length: np.ndarray, data: np.ndarray, t: np.ndarray
) -> Block:
    kind, is_fd = np.zeros(len(address), dtype=np.uint8), np.zeros(len(address), dtype=np.bool_)
    frames = CanFrames(address, extended, kind, length, data, is_fd)
    return Block("can", np.round(t * 1e9).astype(np.int64), frames)


class Cantools:
    """Decode frame by frame with cantools; messages are looked up before."""

    def __init__(self, bus: Bus, database: CanDatabase) -> None:
        parsed = dbc.load_string(bus.dbc.read_text(encoding="utf-8"), False).messages
        self.messages = {(m.frame_id, m.is_extended_frame): m for m in parsed}
        usable = {m.key: m for m in database.messages if not m.problem}
        frames = bus.block.rows
        assert isinstance(frames, CanFrames)
        self.work: list[tuple[Message, bytes]] = []
        self.row: list[tuple[tuple[int, bool], int]] = []
        for i, key in enumerate(
            zip(frames.arbitration_id.tolist(), frames.is_extended.tolist(), strict=True)
        ):
            if key in usable and frames.length[i] >= usable[key].length:
                self.work.append((self.messages[key], frames.data[i].tobytes()))
                self.row.append((key, i))

    def __call__(self) -> None:
        """Decode every frame with crosscue."""
        for message, payload in self.work:
            message.decode(payload, decode_choices=False)


def ours(bus: Bus, database: CanDatabase) -> Callable[[], list[Block]]:
    ledger = Ledger(bus.name)
    decode = BusDecoder(database, "can", ledger, allow_longer=True)
    n = len(bus.block)
    blocks = [bus.block.take(slice(i, i + BLOCK_ROWS)) for i in range(0, n, BLOCK_ROWS)]
    return lambda: [one for block in blocks for one in decode(block)]


def count_equal(database: CanDatabase, theirs: Cantools, blocks: list[Block]) -> int:
    """Return the number of compared values; overlapping signals, which differ, are left out."""
    names = {m.key: m.topic_name for m in database.messages if not any(overlapping_signals(m))}
    following = dict.fromkeys((b.topic for b in blocks), 0)
    by_topic: dict[str, list[Block]] = {}
    for block in blocks:
        by_topic.setdefault(block.topic, []).append(block)
    values = {
        topic: {
            name: np.concatenate([np.asarray(b.rows[name]) for b in same])  # type: ignore[index]
            for name in same[0].rows.columns  # type: ignore[union-attr]
        }
        for topic, same in by_topic.items()
    }
    compared = 0
    for (key, _), (message, payload) in zip(theirs.row, theirs.work, strict=True):
        if key not in names:
            continue
        topic = f"can/{names[key]}"
        row = following[topic]
        following[topic] += 1
        for name, value in message.decode_simple(payload, decode_choices=False).items():
            if values[topic][name][row] != value:
                raise SystemExit(f"{topic}.{name}: {values[topic][name][row]} is not {value}")
            compared += 1
    return compared


def seconds(run: Callable[[], object], times: int) -> float:
    start = time.thread_time()
    for _ in range(times):
        run()
    return (time.thread_time() - start) / times


def measure(bus: Bus, rounds: int) -> list[list[float]]:
    database = CanDatabase.load([bus.dbc])
    theirs = Cantools(bus, database)
    decode = ours(bus, database)
    compared = count_equal(database, theirs, decode())  # also warms caches
    cases: list[tuple[Callable[[], object], int]] = [(theirs, 1), (decode, 10)]
    times = [[seconds(case, n) for case, n in cases] for _ in range(rounds)]
    columns = sum(len(b.rows.columns) for b in decode() if isinstance(b.rows, Table))
    print(
        f"{bus.name}: {len(bus.block):,} frames, {len(theirs.work):,} decodable, {columns} columns;"
        f" {compared:,} values compared, all equal"
    )
    report(times)
    return times


def report(times: list[list[float]]) -> None:
    for i, name in enumerate(("cantools", "ours")):
        own = [row[i] * 1e3 for row in times]
        ratios = [row[0] / row[i] for row in times]
        print(
            f"  {name:8} {statistics.median(own):8.2f} ms [{min(own):.2f} to {max(own):.2f}]"
            f"   x{statistics.median(ratios):.1f} [{min(ratios):.1f} to {max(ratios):.1f}]"
        )


def main(rounds: int) -> None:
    toyota = [
        Bus("comma2k19 bus 0", comma2k19(0), DATA / "comma2k19/toyota_2017.dbc"),
        Bus("comma2k19 bus 1", comma2k19(1), DATA / "comma2k19/toyota_adas.dbc"),
    ]
    both = [measure(bus, rounds) for bus in toyota]
    print("comma2k19, both buses together")
    report([[sum(p) for p in zip(a, b, strict=True)] for a, b in zip(*both, strict=True)])
    frames = ford()
    measure(Bus("Ford, 14 messages", frames, FORD / "ford_fusion_2018_pt.dbc"), rounds)
    measure(Bus("Ford, 331 messages", frames, FORD / "ford_lincoln_base_pt.dbc"), rounds)


if __name__ == "__main__":
    if not DATA.is_dir():
        raise SystemExit(f"{DATA}: no recordings there; set CROSSCUE_DATA")
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 9)
