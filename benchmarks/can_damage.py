"""Truncate and damage CAN logs reproducibly, and count the results of our readers.

The columns in capitals must be zero. "undetectable" counts changed digits where a format has no
checksum, and text cut exactly at a line's end; the account states this for each of these formats.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.can_files import KINDS, Kind, damaged, judge

COLUMNS = ("refused", "same", "reported", "undetectable", "SILENT", "INVENTED", "UNCLEAR", "CRASH")


def count(
    kind: Kind, folder: Path, what: str, copies: int, show: bool
) -> tuple[Counter[str], float]:
    """Return the verdicts over ``copies`` damaged copies, and the longest reading time."""
    frames = kind.frames(60)
    whole = kind.spell(frames)
    chance = random.Random(1)
    verdicts: Counter[str] = Counter()
    slowest = 0.0
    for seed in range(copies):
        copy = (
            damaged(whole, seed) if what == "damage" else whole[: chance.randrange(1, len(whole))]
        )
        began = time.perf_counter()
        try:
            verdict = judge(kind, frames, whole, copy, folder / f"x{kind.suffix}")
            word, why = verdict.word, verdict.why
        except Exception as error:
            word, why = "CRASH", repr(error)
        slowest = max(slowest, time.perf_counter() - began)
        verdicts[word] += 1
        if show and word.isupper():
            print(f"  {what} {seed}: {word} {why}")
    return verdicts, slowest


def main() -> None:
    """Print one line for each format and kind of damage."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--copies", type=int, default=1000, help="of each format and kind of harm")
    parser.add_argument("--only", default="", help="formats whose name holds this")
    parser.add_argument("--show", action="store_true", help="print each fault")
    asked = parser.parse_args()
    print(f"{'format':16}{'what':8}" + "".join(f"{c:>13}" for c in COLUMNS) + f"{'slowest s':>11}")
    with tempfile.TemporaryDirectory() as folder:
        for name, kind in KINDS.items():
            for what in ("cut", "damage") if asked.only in name else ():
                verdicts, slowest = count(kind, Path(folder), what, asked.copies, asked.show)
                cells = "".join(f"{verdicts[c]:13,}" for c in COLUMNS)
                print(f"{name:16}{what:8}{cells}{slowest:11.3f}", flush=True)


if __name__ == "__main__":
    main()
