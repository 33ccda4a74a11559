"""Decode signals of MF4 bus logs: ours next to asammdf, with a parsed DBC and from a cold start.

    python benchmarks/mf4_decoding.py [rounds]

There are three logs: a CANedge log with its DBC; the Ford candump, repeated, with a DBC of 0.8 MB,
unfinalized and unsorted as loggers leave it; and the same log finalized and sorted by asammdf.
asammdf extracts with ``extract_bus_logging``. Ours reads and decodes the same bus or buses with its
NumPy engine, looks up every frame and accounts for it. All values are compared before timing, by
bus, identifier and signal, in order; of values with texts in a value table, the numbers are
compared. Warm: one process, DBC parsed before by each, alternating, CPU seconds of the process;
ratios are taken round by round. Cold: a process for each pass, imports and DBC included, CPU
seconds of the child; the first start fills the caches, and the second uses them. The recordings
are in $CROSSCUE_DATA or ../shared/data.
"""

from __future__ import annotations

import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

DATA = Path(os.environ.get("CROSSCUE_DATA", Path(__file__).parents[2] / "shared" / "data"))
CANEDGE = DATA / "can/css_canedge"
FORD = DATA / "can/ford_fusion_2017"
REPEAT = 12

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))


def ours(log: Path, database: Any) -> dict[str, list[Any]]:
    """Return the decoded blocks of each message, by topic."""
    from crosscue.replay.can.decode import BusDecoder
    from crosscue.replay.ledger import Ledger
    from crosscue.replay.logs.opening import open_log

    ledger = Ledger(str(log))
    found: dict[str, list[Any]] = {}
    decoders: dict[str, BusDecoder] = {}
    with open_log(log) as opened:
        for block in opened.read(ledger):
            if block.topic not in decoders:
                decoders[block.topic] = BusDecoder(database, block.topic, ledger, allow_longer=True)
            for one in decoders[block.topic](block):
                found.setdefault(one.topic, []).append(one)
    return found


def our_database(dbc: Path) -> Any:
    from crosscue.replay.can.database import CanDatabase

    return CanDatabase.load([dbc])


def theirs(log: Path, database: Any) -> Any:
    """Return the signals extracted by asammdf, as an MDF object in memory."""
    import asammdf

    with asammdf.MDF(log) as mdf:
        return mdf.extract_bus_logging({"CAN": [(database, 0)]})


def their_database(dbc: Path) -> Any:
    from asammdf.blocks.utils import load_can_database

    return load_can_database(dbc)


# Bus, identifier and signal.
Key = tuple[str, int, str]
SOURCE = re.compile(r"CAN(\d+)\.CAN_DataFrame\.ID=0x([0-9A-F]+) EXT=(?:True|False)")


def compared(log: Path, dbc: Path) -> int:
    """Compare all values and return their number; exit at the first that differs."""
    numbers = {one.name: one.arbitration_id.id for one in their_database(dbc).frames}
    mine: dict[Key, list[Any]] = {}
    for topic, blocks in ours(log, our_database(dbc)).items():
        bus, message = topic.rsplit("/", 2)[1:]
        for block in blocks:
            for name, values in block.rows.columns.items():
                key = (bus, numbers[message], name)
                mine.setdefault(key, []).append(np.asarray(values, np.float64))
    count, seen = 0, set()
    for signal in theirs(log, their_database(dbc)).iter_channels(raw=True):
        found = SOURCE.fullmatch(signal.source.path)
        if found is None:
            raise SystemExit(f"{log.name}: {signal.name} of {signal.source.path!r}: of no bus")
        key = (found[1], int(found[2], 16), signal.name)
        # Compare numbers, because ours has no texts of value tables.
        values = signal.physical(ignore_value2text_conversions=True).samples.astype(np.float64)
        if signal.invalidation_bits is not None:
            values = values[~np.asarray(signal.invalidation_bits, bool)]
        own = np.concatenate(mine[key])
        if (
            key in seen
            or own.shape != values.shape
            or not np.allclose(own, values, rtol=1e-6, atol=1e-9, equal_nan=True)
        ):
            raise SystemExit(f"{log.name}: {key} differs")
        seen.add(key)
        count += len(values)
    if mine.keys() != seen:
        raise SystemExit(f"{log.name}: asammdf lacks {sorted(mine.keys() - seen)}")
    return count


def ford_logs(folder: Path) -> list[Path]:
    """Write the repeated Ford frames: unfinalized as by a logger, and finalized."""
    import asammdf
    import can

    from support.can_files import START_NS, Sent
    from support.mf4_files import unsorted

    source = folder / "ford.log"
    candump = FORD / "acc_on_speed_changing_from_30km_to_80km_per_hour.candump"
    source.write_bytes(candump.read_bytes())
    once = [m for m in can.LogReader(source) if not m.is_error_frame and not m.is_remote_frame]
    first, span = once[0].timestamp, once[-1].timestamp - once[0].timestamp + 0.001
    frames = [
        Sent(
            START_NS + round((m.timestamp - first + k * span) * 1e6) * 1000,
            "1",
            m.arbitration_id,
            bytes(m.data),
            m.is_extended_id,
        )
        for k in range(REPEAT)
        for m in once
    ]
    card, finalized = folder / "ford_on_card.mf4", folder / "ford_finalized.mf4"
    card.write_bytes(unsorted(frames, virtual=True).content)
    with asammdf.MDF(card) as mdf:
        mdf.save(finalized, compression=0)
    return [finalized, card]


def cpu_s(run: Callable[[], object]) -> float:
    began = time.process_time()
    run()
    return time.process_time() - began


def cold_s(which: str, log: Path, dbc: Path, cache: Path) -> float:
    """Return the CPU seconds of a process that does only one pass."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    command = [sys.executable, __file__, "--once", which, str(log), str(dbc)]
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def once(which: str, log: Path, dbc: Path) -> None:
    """Do one pass; called in a separate process."""
    warnings.simplefilter("ignore")
    if which == "ours":
        ours(log, our_database(dbc))
    else:
        theirs(log, their_database(dbc))


def warm(log: Path, dbc: Path, rounds: int) -> None:
    mine, peer = our_database(dbc), their_database(dbc)
    times = [
        (cpu_s(lambda: ours(log, mine)), cpu_s(lambda: theirs(log, peer)))
        for _ in range(rounds + 1)
    ][1:]
    report("DBC parsed before", times)


def cold(log: Path, dbc: Path, rounds: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder)
        first = [(cold_s("ours", log, dbc, cache), cold_s("asammdf", log, dbc, cache))]
        later = [
            (cold_s("ours", log, dbc, cache), cold_s("asammdf", log, dbc, cache))
            for _ in range(min(rounds, 3))
        ]
    report("cold, first start", first)
    report("cold, after the first", later)


def report(title: str, times: list[tuple[float, float]]) -> None:
    mine, peer = (statistics.median(column) * 1e3 for column in zip(*times, strict=True))
    ratios = [b / a for a, b in times]
    spread = f"[{min(ratios):.1f} to {max(ratios):.1f}]"
    print(
        f"  {title:22} ours {mine:8.1f} ms   asammdf {peer:8.1f} ms"
        f"   x{statistics.median(ratios):.1f} {spread}"
    )


def main(rounds: int) -> None:
    warnings.simplefilter("ignore")
    canedge = CANEDGE / "3BA199E2/00000164/00000001-60FE3F04.MF4"
    with tempfile.TemporaryDirectory() as folder:
        logs = [(canedge, CANEDGE / "canmod-gps.dbc")]
        logs += [(log, FORD / "ford_lincoln_base_pt.dbc") for log in ford_logs(Path(folder))]
        for log, dbc in logs:
            frames = sum(len(b) for blocks in ours(log, our_database(dbc)).values() for b in blocks)
            values = compared(log, dbc)
            print(
                f"{log.name}: {log.stat().st_size / 1e6:.1f} MB, {frames:,} frames decoded with"
                f" {dbc.name}; {values:,} values compared, all equal"
            )
            warm(log, dbc, rounds)
            cold(log, dbc, rounds)


if __name__ == "__main__":
    if not DATA.is_dir():
        raise SystemExit(f"{DATA}: no recordings there; set CROSSCUE_DATA")
    if sys.argv[1:2] == ["--once"]:
        once(sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4]))
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 7)
