"""Check many damaged .db3 files with our check of their structure and with SQLite's.

    python -m benchmarks.db3_damage [copies per shape] [seed]

For every shape of file the script prints how many copies cannot be opened, are found sound or not
sound by both checks, and are left to SQLite, which finds them sound. It exits with 1 if our check
finds a copy sound in which SQLite finds a fault, or leaves an undamaged file of a recorder to it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.db3_damage import SHAPES, copies, own_verdict, sqlite_verdict, write_shape

COLUMNS = ("refused", "both sound", "both not", "left to SQLite", "WRONGLY SOUND")


def main(number: int, seed: int) -> int:
    """Return the number of wrong verdicts."""
    wrong = 0
    print(f"{'shape':24}" + "".join(f"{name:>16}" for name in COLUMNS) + f"{'slowest':>10}")
    with tempfile.TemporaryDirectory() as folder:
        for name, shape in SHAPES.items():
            path = write_shape(Path(folder) / f"{name}.db3", shape)
            intact = path.read_bytes()
            wrong += own_verdict(path) != shape.is_understood
            counts: Counter[str] = Counter()
            slowest = 0.0
            for how, copy in copies(intact, number, seed):
                path.write_bytes(copy)
                begin = time.perf_counter()
                own = own_verdict(path)
                slowest = max(slowest, time.perf_counter() - begin)
                theirs = sqlite_verdict(path)
                if own is None:
                    counts["refused"] += 1
                elif own:
                    counts["both sound" if theirs else "WRONGLY SOUND"] += 1
                else:
                    counts["left to SQLite" if theirs else "both not"] += 1
                if own and not theirs:
                    print(f"{name}: {how}")
            cells = "".join(f"{counts[column]:>16}" for column in COLUMNS)
            print(f"{name:24}{cells}{slowest:>9.2f}s", flush=True)
            wrong += counts["WRONGLY SOUND"]
    print(f"\n{wrong} verdicts are wrong")
    return wrong


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:]]
    sys.exit(min(1, main(*(given + [800, 1][len(given) :]))))
