"""Read ten thousand damaged MCAP files: no silent loss, and no wrong message, is allowed.

    python benchmarks/mcap_damage.py [copies per file] [seed]

A third of the copies are cut at a random byte; the others have 1 to 64 bytes overwritten. Every
copy is read to its end and compared with the undamaged file. The script prints for every file the
outcomes of its copies, the fraction of messages kept, and the slowest reading. It exits with 1 if
any copy was read wrongly without a report, or raised anything but a one-line error.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from support.mcap_damage import Kind, copies, judge, sound_files
from support.mcap_files import read_back

NEVER = (Kind.SILENT, Kind.WRONG, Kind.UNBALANCED)
SHOWN = (Kind.REFUSED, Kind.SAME, Kind.NOTICED, Kind.REPORTED, Kind.CHANGED, *NEVER)


def main(number: int, seed: int) -> int:
    """Return the number of copies that crashed the reader or were read incorrectly."""
    wrong = 0
    names = "".join(f"{kind.name.lower():>11}" for kind in SHOWN)
    print(f"{'file':24}{'':8}{names}{'crash':>8}{'kept':>8}{'slowest':>9}")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.mcap"
        for name, coded in sound_files():
            path.write_bytes(coded)
            truth = read_back(path)
            assert truth.ledger.is_whole, name
            counts = {"cut": Counter[str](), "damage": Counter[str]()}
            kept: dict[str, list[float]] = {"cut": [], "damage": []}
            slowest = {"cut": 0.0, "damage": 0.0}
            for what, damaged in copies(coded, seed, number // 3, number - number // 3):
                path.write_bytes(damaged)
                how = what.split()[0]
                begin = time.perf_counter()
                try:
                    verdict = judge(path, truth)
                except Exception as error:  # crashes are counted
                    print(f"{name}, {what}, seed {seed}: {error!r}")
                    counts[how]["crash"] += 1
                    continue
                slowest[how] = max(slowest[how], time.perf_counter() - begin)
                counts[how][verdict.kind.name] += 1
                kept[how].append(verdict.kept)
                if verdict.kind in NEVER:
                    print(f"{name}, {what}, seed {seed}: {verdict.kind.value}")
            for how, found in counts.items():
                cells = "".join(f"{found[kind.name]:>11}" for kind in SHOWN)
                mean = sum(kept[how]) / max(len(kept[how]), 1)
                tail = f"{found['crash']:>8}{mean:>8.3f}{slowest[how]:>8.2f}s"
                print(f"{name if how == 'cut' else '':24}{how:8}{cells}{tail}", flush=True)
                wrong += found["crash"] + sum(found[kind.name] for kind in NEVER)
    print(f"\n{wrong} copies crashed or were read wrong without a word")
    return wrong


if __name__ == "__main__":
    given = [int(word) for word in sys.argv[1:]]
    sys.exit(min(1, main(*(given + [600, 1][len(given) :]))))
