"""Mobileye frames from hexadecimal text, or random ones within the ranges of the layout table."""

from collections.abc import Iterable, Sequence

import numpy as np

from crosscue.replay.columns import DATA, Block, Floats, Int64s, Table
from crosscue.replay.mobileye.bits import Words, payloads_of, place_bits
from crosscue.replay.mobileye.layout import BitField, Message, layout
from support.can_layouts import frames_of, join

MS = 1_000_000


def frames(
    sent: Sequence[tuple[int, str]],
    log_ns: Sequence[int] | None = None,
    topic: str = "can1",
    kind: int = DATA,
    is_extended: bool = False,
) -> Block:
    """Frames from pairs of identifier and hexadecimal bytes, by default a millisecond apart."""
    payloads = [bytes.fromhex(text) for _, text in sent]
    n = len(sent)
    data = np.zeros((n, 8), dtype=np.uint8)
    for row, payload in enumerate(payloads):
        data[row, : len(payload)] = list(payload)
    times = list(range(0, n * MS, MS)) if log_ns is None else list(log_ns)
    lengths = [len(payload) for payload in payloads]
    rows = frames_of(data, [i for i, _ in sent], is_extended, lengths, kind)
    return Block(topic, np.array(times, dtype=np.int64), rows)


def status(count: int, counter_ms: int, length: int = 6) -> tuple[int, str]:
    """A status frame that announces ``count`` obstacles."""
    text = f"{count:02X}{counter_ms & 0xFF:02X}00F203"
    return 0x738, text + "00" * (length - len(text) // 2)


def triple(slot: int, mark: int) -> list[tuple[int, str]]:
    """Frames A, B and C of one obstacle slot; ``mark`` is the obstacle's id."""
    first = 0x739 + 3 * slot
    return [
        (first, f"{mark:02X}80010000000300"),
        (first + 1, f"1184{mark:02X}0000000000"),
        (first + 2, f"{mark:02X}00000000103007"),
    ]


def random_words(message: Message, n: int, rng: np.random.Generator, variant: str = "") -> Words:
    """Random payloads within the ranges that the table declares.

    Fields can have their code for a missing value, together with the fields that depend on them.
    """
    words = np.zeros(n, dtype=np.uint64)
    raws: dict[str, Int64s] = {}
    for f in message.fields:
        if f.only not in ("", variant):
            continue
        raw = _random_raw(f, n, rng)
        if f.missing_with:
            other = next(o for o in message.fields if o.name == f.missing_with)
            is_missing = np.isin(raws[other.name], other.missing)
            raw = np.where(is_missing, f.missing[0], _random_present(f, n, rng))
        raws[f.name] = raw
    for f in message.fields:
        if f.name not in raws or f.only not in ("", variant):
            continue
        raw = raws[f.name]
        if f.needs:
            raw = np.where(raws[f.needs] == 0, f.default, raw)
        words |= place_bits(raw, f.start, f.width, f.order == "big")
    return words


def _random_present(f: BitField, n: int, rng: np.random.Generator) -> Int64s:
    lowest, highest = f.raw_range
    raw = rng.integers(lowest, highest + 1, n)
    ends = rng.integers(0, 8, n)
    raw = np.where(ends == 0, lowest, np.where(ends == 1, highest, raw))
    return np.where(np.isin(raw, f.missing), f.default, raw)


def _random_raw(f: BitField, n: int, rng: np.random.Generator) -> Int64s:
    raw = _random_present(f, n, rng)
    if not f.missing:
        return raw
    return np.where(rng.integers(0, 4, n) == 0, f.missing[0], raw)


def block_of(
    words: Words, ids: Int64s, lengths: Int64s, log_ns: Int64s, topic: str = "can1"
) -> Block:
    data = payloads_of(words)
    data = np.where(np.arange(8) < lengths[:, None], data, 0).astype(np.uint8)
    return Block(topic, log_ns, frames_of(data, ids, length=lengths))


def random_drive(
    bursts: int, rng: np.random.Generator, revision: str = "classic", *, has_lanes: bool = True
) -> Block:
    """Complete bursts of obstacles, lanes and further lanes, as a device sends them."""
    parts: list[Block] = []
    for k in range(bursts):
        log_ns = 10_000 * MS + k * 66 * MS
        count = int(rng.integers(0, 11))
        parts.append(_burst(count, k, log_ns, rng, revision, has_lanes))
    return join(parts)


def _burst(
    count: int, number: int, log_ns: int, rng: np.random.Generator, revision: str, has_lanes: bool
) -> Block:
    step_ns = 250_000
    words, ids, lengths = [], [], []

    def add(message: Message, instance: int, payload: Words, variant: str = "") -> None:
        words.append(int(payload[0]))
        ids.append(message.ids[instance])
        lengths.append(message.length_of(variant))

    opening = random_words(layout()["status"], 1, rng, revision) & ~np.uint64(0xFFFF)
    opening |= np.uint64(count | (number * 66 & 0xFF) << 8)
    add(layout()["status"], 0, opening, revision)
    for slot in range(count):
        for name in ("obstacle_a", "obstacle_b", "obstacle_c"):
            add(layout()[name], slot, random_words(layout()[name], 1, rng))
    for prefix, lanes in (("", 2), ("next_", 8)) if has_lanes else ():
        for lane in range(lanes):
            for half in ("a", "b"):
                message = layout()[f"{prefix}lane_{half}"]
                add(message, lane, random_words(message, 1, rng))
    n = len(words)
    return block_of(
        np.array(words, dtype=np.uint64),
        np.array(ids, dtype=np.int64),
        np.array(lengths, dtype=np.int64),
        log_ns + np.arange(n, dtype=np.int64) * step_ns,
    )


def tables_of(blocks: Iterable[Block]) -> dict[str, Table]:
    """Join the tables of a decoder by the last part of their topics."""
    parts: dict[str, list[Table]] = {}
    for block in blocks:
        assert isinstance(block.rows, Table)
        parts.setdefault(block.topic.rpartition("/")[2], []).append(block.rows)
    joined = {}
    for name, tables in parts.items():
        columns = list(tables[0].columns)
        assert all(list(table.columns) == columns for table in tables)
        joined[name] = Table({c: np.concatenate([t[c] for t in tables]) for c in columns})
    return joined


def values(table: Table, name: str) -> Floats:
    """A column converted to float64."""
    return table[name].astype(np.float64)
