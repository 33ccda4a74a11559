"""Speed of decoding a Mobileye's frames, next to cantools frame by frame.

Both receive the same simulated frames and the same layout, for which our table (classic revision,
family extended) is converted to an in-memory cantools database. cantools returns a dictionary per
frame; ours returns joined obstacles and lanes in the vehicle frame, with every check and the
account. Both alternate within one run, because timings of different runs are not comparable.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Final

import cantools.database
import numpy as np
from cantools.database.can import Message as DbMessage
from cantools.database.can import Signal
from cantools.database.conversion import BaseConversion

from crosscue.replay.columns import BLOCK_ROWS, Block, CanFrames, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.mobileye.can.encode import bursts_of, encode_tables
from crosscue.replay.mobileye.geometry import DevicePosition
from crosscue.replay.mobileye.layout import BitField, Columns, Message, layout
from crosscue.replay.mobileye.settings import MobileyeSettings
from crosscue.replay.mobileye.tables import table_block

ROUNDS: Final = 7
IMAGES: Final = 3000
OBJECTS: Final = 8
CANTOOLS_FRAMES: Final = 20_000
MS: Final = 1_000_000
SETTINGS: Final = MobileyeSettings(mounting=DevicePosition(1.8, 0.0))


def simulated_bus() -> Block:
    """Return frames of obstacles and lanes in ``IMAGES`` images, about 500 frames a second."""
    rng = np.random.default_rng(11)
    image_ns = 10**18 + np.arange(IMAGES, dtype=np.int64) * 66 * MS
    n = IMAGES * OBJECTS
    objects = Table(
        {
            "t_ns": np.repeat(image_ns, OBJECTS),
            "obstacle_id": (np.arange(n) % 64).astype(np.int16),
            "x_m": rng.uniform(5.0, 200.0, n),
            "y_m": rng.uniform(-15.0, 15.0, n),
            "vx_mps": rng.uniform(-30.0, 30.0, n),
            "width_m": rng.uniform(1.5, 2.5, n),
        }
    )
    tables = bursts_of(image_ns, objects, SETTINGS)
    for k, side in enumerate((1, -1)):
        lane: Columns = {
            "side": np.full(IMAGES, side, dtype=np.int8),
            "c0_m": side * rng.uniform(1.5, 2.0, IMAGES),
            "c1": rng.uniform(-0.01, 0.01, IMAGES),
            "c2_per_m": rng.uniform(-1e-4, 1e-4, IMAGES),
            "c3_per_m2": rng.uniform(-1e-7, 1e-7, IMAGES),
            "view_range_m": rng.uniform(30.0, 80.0, IMAGES),
            "quality": np.full(IMAGES, 3, dtype=np.int16),
        }
        tables.append(table_block("can1", "lanes", image_ns + (100 + k) * MS, lane))
    return encode_tables(tables, SETTINGS, "can1")


def peer() -> cantools.database.Database:
    """Return the layout table as a cantools database with one message per instance."""
    messages = [_db_message(m, k) for m in layout().values() for k in range(len(m.ids))]
    return cantools.database.Database(messages)


def _db_message(message: Message, instance: int) -> DbMessage:
    signals = [_signal(f) for f in message.fields if f.only in ("", "classic", "extended")]
    return DbMessage(
        frame_id=message.ids[instance],
        name=f"{message.name}_{instance}",
        length=message.length_of("classic"),
        signals=signals,
        strict=False,
    )


def _signal(f: BitField) -> Signal:
    factor = f.scale / f.per
    big = f.order == "big"
    return Signal(
        name=f.name,
        start=f.start + 7 if big else f.start,
        length=f.bits,
        byte_order="big_endian" if big else "little_endian",
        is_signed=f.signed,
        conversion=BaseConversion.factory(scale=factor, offset=-f.zero * factor),
    )


def ours(block: Block) -> int:
    """Return the rows of all tables, decoded block by block as from a reader."""
    decoder = MobileyeDecoder("can1", Ledger("bench"), SETTINGS)
    rows = 0
    for start in range(0, len(block), BLOCK_ROWS):
        rows += sum(len(b) for b in decoder(block.take(np.s_[start : start + BLOCK_ROWS])))
    return rows + sum(len(b) for b in decoder.flush())


def theirs(database: cantools.database.Database, ids: list[int], payloads: list[bytes]) -> int:
    """Return one dictionary per frame."""
    decode = database.decode_message
    return sum(1 for i, p in zip(ids, payloads, strict=True) if decode(i, p, decode_choices=False))


def check_equal(block: Block, database: cantools.database.Database) -> None:
    """Check that both return the same positions of obstacles, before timing them."""
    decoder = MobileyeDecoder("can1", Ledger("bench"), MobileyeSettings(mounting=DevicePosition()))
    tables = [b for b in (*decoder(block), *decoder.flush()) if b.topic.endswith("/obstacles")]
    mine = np.concatenate([b.rows["y_m"] for b in tables if isinstance(b.rows, Table)])
    assert isinstance(block.rows, CanFrames)
    is_a = (block.rows.arbitration_id >= 0x739) & (block.rows.arbitration_id % 3 == 0x739 % 3)
    is_a &= block.rows.arbitration_id <= 0x75D
    frames = zip(block.rows.arbitration_id[is_a], block.rows.data[is_a], strict=True)
    others = [_y_m(database, int(i), d.tobytes()) for i, d in frames]
    np.testing.assert_allclose(mine, np.array(others, dtype=np.float64))


def _y_m(database: cantools.database.Database, identifier: int, payload: bytes) -> object:
    values = database.decode_message(identifier, payload)
    assert isinstance(values, dict)
    return values["y_m"]


def seconds(work: Callable[[], object]) -> float:
    start = perf_counter()
    work()
    return perf_counter() - start


def main() -> None:
    block = simulated_bus()
    frames = block.rows
    assert isinstance(frames, CanFrames)
    database = peer()
    whole_bursts = int(np.flatnonzero(frames.arbitration_id == 0x738)[200])
    check_equal(block.take(np.s_[:whole_bursts]), database)
    ids = frames.arbitration_id[:CANTOOLS_FRAMES].tolist()
    lengths = frames.length[:CANTOOLS_FRAMES].tolist()
    payloads = [frames.data[k, :n].tobytes() for k, n in enumerate(lengths)]
    ours_s, theirs_s = [], []
    for _ in range(ROUNDS):
        ours_s.append(seconds(lambda: ours(block)) / len(block))
        theirs_s.append(seconds(lambda: theirs(database, ids, payloads)) / len(ids))
    ratios = [b / a for a, b in zip(ours_s, theirs_s, strict=True)]
    print(f"{len(block)} simulated frames, median of {ROUNDS} alternating rounds")
    print(f"{'':28}{'us a frame':>12}{'frames a second':>18}")
    for name, each in (("crosscue, joined tables", ours_s), ("cantools, frame by frame", theirs_s)):
        print(f"{name:28}{median(each) * 1e6:12.3f}{1 / median(each):18,.0f}")
    print(f"ratio {median(ratios):.0f} (rounds {min(ratios):.0f} to {max(ratios):.0f})")


if __name__ == "__main__":
    main()
