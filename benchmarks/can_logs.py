"""Read CAN logs with our readers and with python-can, alternating, and print the ratios.

The Ford candump is real; the other formats contain the same frames, written by python-can. Both
sides must return the same number of frames. Ours yields columns, python-can an object per frame.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import can

from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.can_files import candump, random_frames

FORD = "can/ford_fusion_2017/acc_on_speed_changing_from_30km_to_80km_per_hour.candump"


def ours(path: Path) -> int:
    """Return the number of frames that our reader yields."""
    ledger = Ledger(str(path))
    with open_log(path) as log:
        count = sum(len(block) for block in log.read(ledger))
    if not ledger.is_whole:
        raise SystemExit(f"{path}: {[*ledger.drops()][:3]}")
    return count


def theirs(path: Path) -> int:
    """Return the number of frames that python-can yields."""
    with can.LogReader(path) as reader:
        return sum(1 for _ in reader)


def originals(folder: Path, data: Path, repeat: int) -> list[Path]:
    """Write one file of each format, all with the same frames."""
    ford = data / FORD
    content = ford.read_bytes() if ford.exists() else candump(random_frames(41_250, fd=False))
    if not ford.exists():
        print(f"no {ford}: simulated frames instead")
    log = folder / "drive.log"
    log.write_bytes(content * repeat)
    paths = [folder / f"drive.{suffix}" for suffix in ("asc", "blf", "trc", "mf4")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        writers = [can.Logger(path) for path in paths]
        for message in can.LogReader(log):
            message.channel = 1
            for writer in writers:
                writer(message)
        for writer in writers:
            writer.stop()
    return [log, *paths]


def seconds(read: Callable[[Path], int], path: Path) -> tuple[float, int]:
    """Return the duration and the counts of one pass."""
    began = time.perf_counter()
    count = read(path)
    return time.perf_counter() - began, count


def main() -> None:
    """Print a line for each format."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--repeat", type=int, default=4, help="times the Ford log in one file")
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared" / "data")
    parser.add_argument("--only", default="", help="formats whose suffix holds this")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        paths = originals(Path(folder), asked.data, asked.repeat)
        print(f"{'format':8}{'frames':>9}{'ours s':>9}{'M/s':>7}{'python-can s':>14}{'times':>7}")
        for path in paths:
            if asked.only not in path.suffix:
                continue
            ours(path)
            mine, peer, ratios = [], [], []
            for _ in range(asked.rounds):
                (a, n), (b, m) = seconds(ours, path), seconds(theirs, path)
                if n != m:
                    print(f"{path.suffix}: ours {n} frames, python-can {m}")
                mine.append(a)
                peer.append(b)
                ratios.append(b / a)
            a, b, ratio = map(statistics.median, (mine, peer, ratios))
            spread = f"[{min(ratios):.1f}-{max(ratios):.1f}]"
            print(f"{path.suffix:8}{n:9,}{a:9.3f}{n / a / 1e6:7.2f}{b:14.3f}{ratio:7.1f} {spread}")


if __name__ == "__main__":
    main()
