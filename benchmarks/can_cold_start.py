"""Decode all signals of a candump log with a large DBC file in a new process, next to two peers.

    python benchmarks/can_cold_start.py [--rounds 5]

Each run is a separate process that parses the DBC file again, except ours after the first run,
which finds the layout in the user's cache. Two CPU times are measured (user and system, all
threads): opening, parsing and decoding after all imports ("work"), and the whole process with
Python's start and all imports. Values are counted, not compared; the counts are printed. The cases
alternate, and ratios are taken round by round. Ours yields columns, the others a dictionary for
each frame. hilspy (``pip install hilspy``) is the strongest peer known. A peer that is not
installed is left out, with a message.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Final

FORD: Final = Path("can/ford_fusion_2017")
LOG: Final = FORD / "acc_on_speed_changing_from_30km_to_80km_per_hour.candump"
DBC: Final = FORD / "ford_lincoln_base_pt.dbc"

_OURS: Final = """
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import BusDecoder
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
import crosscue.replay.readers.can_text.candump, crosscue.replay.seal.log
began = time.process_time()
database = CanDatabase.load([dbc])
ledger = Ledger(log)
decoders, count = {}, 0
with open_log(log) as opened:
    for block in opened.read(ledger):
        if block.topic not in decoders:
            decoders[block.topic] = BusDecoder(
                database, block.topic, ledger, allow_longer=True)
        for one in decoders[block.topic](block):
            count += len(one) * len(one.rows.columns)
"""
_HILSPY: Final = """
import hilspy
began = time.process_time()
count = 0
with hilspy.open(f"file://{log}?format=candump", f"dbc:{dbc}", decode_choices=False) as channel:
    for message in channel:
        if message.name is not None:
            count += len(message.fields)
"""
_CANTOOLS: Final = """
import can, cantools
began = time.process_time()
database = cantools.database.load_file(dbc, strict=False)
known = {(m.frame_id, m.is_extended_frame): m for m in database.messages}
count = 0
for frame in can.LogReader(log):
    message = known.get((frame.arbitration_id, frame.is_extended_id))
    if message is not None and message.signals and len(frame.data) >= message.length:
        count += len(message.decode(bytes(frame.data), decode_choices=False))
"""
_HEAD: Final = "import sys, time\nlog, dbc = sys.argv[1:]\n"
_FOOT: Final = """
done = time.process_time()
print(count, done - began, done)
"""
CASES: Final = {"ours": _OURS, "hilspy": _HILSPY, "python-can + cantools": _CANTOOLS}
NEEDS: Final = {"hilspy": ("hilspy",), "python-can + cantools": ("can", "cantools")}


def run(name: str, log: Path, dbc: Path, cache: str) -> tuple[int, float, float]:
    """Return the number of values, and the CPU seconds of the work and of the process."""
    script = _HEAD + CASES[name] + _FOOT
    done = subprocess.run(
        [sys.executable, "-c", script, str(log), str(dbc)],
        env={**os.environ, "CROSSCUE_DBC_CACHE": cache},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    count, work_s, process_s = done.stdout.split()
    return int(count), float(work_s), float(process_s)


def main() -> None:
    """Print a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    asked = parser.parse_args()
    names = [n for n in CASES if all(find_spec(module) for module in NEEDS.get(n, ()))]
    for name in CASES.keys() - set(names):
        print(f"{name}: not installed, left out")
    with tempfile.TemporaryDirectory() as folder:
        # The peers recognise the format by this suffix.
        log, dbc = Path(folder, "drive.log"), asked.data / DBC
        log.write_bytes((asked.data / LOG).read_bytes())
        first = run("ours", log, dbc, folder)
        print(f"ours, first start: work {first[1]:.3f} s, process {first[2]:.3f} s")
        rounds = [{n: run(n, log, dbc, folder) for n in names} for _ in range(asked.rounds)]
    print(f"{'':24}{'values':>10}{'work s':>9}{'ours is':>9}{'process s':>11}{'ours is':>9}")
    for name in names:
        count = rounds[0][name][0]
        line = f"{name:24}{count:10,}"
        for k, width in ((1, 9), (2, 11)):
            own = statistics.median(one[name][k] for one in rounds)
            ratio = statistics.median(one[name][k] / one["ours"][k] for one in rounds)
            line += f"{own:{width}.3f}{ratio:8.2f}x"
        print(line)


if __name__ == "__main__":
    main()
