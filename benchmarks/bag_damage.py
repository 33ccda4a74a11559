"""Truncate and damage ROS bags reproducibly, and count the results of our reader.

The columns of silent errors must be zero. "undetectable" counts payload bytes that were changed
where the format has no checksum; the account reports that such changes cannot be detected.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.rosbag_files import (
    Row,
    damaged_copies,
    judge,
    read_rows,
    rows_of,
    unclosed,
    write_bag,
    write_folder,
)

COLUMNS = (
    "refused",
    "same",
    "reported",
    "wrong, reported",
    "undetectable",
    "SILENT LOSS",
    "SILENT WRONG",
)


def originals(folder: Path) -> dict[str, Path]:
    """Write one small file of each kind."""
    rows = rows_of(600)
    made = {
        f"bag {kind}": write_bag(folder / f"{kind}.bag", rows, kind)
        for kind in ("none", "bz2", "lz4", "lz4 checked")
    }
    made["bag none, unclosed"] = folder / "unclosed.bag"
    made["bag none, unclosed"].write_bytes(unclosed(made["bag none"].read_bytes()))
    made["db3"] = next(write_folder(folder / "db", rows).glob("*.db3"))
    made["db3, zstd messages"] = next(
        write_folder(folder / "dbz", rows, compression="message").glob("*.db3")
    )
    return made


def main() -> None:
    """Print one line for each kind of file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cuts", type=int, default=1000)
    parser.add_argument("--flips", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="")
    parser.add_argument("--show", action="store_true", help="print each silent case")
    asked = parser.parse_args()
    print(f"{'file':20}{'what':8}" + "".join(f"{c:>14}" for c in COLUMNS) + f"{'slowest s':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for name, path in originals(Path(folder)).items():
            if asked.only in name:
                for what, cuts, flips in (("cuts", asked.cuts, 0), ("damage", 0, asked.flips)):
                    run_one(name, what, path, cuts, flips, asked.seed, asked.show)


def run_one(
    name: str, what: str, path: Path, cuts: int, flips: int, seed: int, is_shown: bool
) -> None:
    """Classify all damaged copies of one file and print the line."""
    undamaged = read_rows(path)
    truth: tuple[Row, ...] = undamaged.rows
    calm = frozenset(undamaged.ledger.notices)
    verdicts: Counter[str] = Counter()
    slowest = 0.0
    copy = path.with_name(f"damaged{path.suffix}")
    for how, content in damaged_copies(path.read_bytes(), cuts, flips, seed):
        copy.write_bytes(content)
        began = time.perf_counter()
        verdict = judge(copy, truth, calm)
        slowest = max(slowest, time.perf_counter() - began)
        verdicts[verdict] += 1
        if is_shown and verdict in ("SILENT LOSS", "SILENT WRONG", "wrong, reported"):
            print(f"  {verdict}: {how}")
    counts = "".join(f"{verdicts[c]:>14}" for c in COLUMNS)
    print(f"{name:20}{what:8}{counts}{slowest:>12.2f}", flush=True)


if __name__ == "__main__":
    main()
