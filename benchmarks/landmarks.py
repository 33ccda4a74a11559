"""Landmarks: time per frame as the database grows, and the effect of the search ellipse.

    python benchmarks/landmarks.py [--sizes 100 10000 1000000] [--skip-growth]

Growth: landmarks on a 10 m grid with 32 synthetic descriptors each, 500 descriptors in the frame,
and a 2-sigma ellipse of 20 m radius. Each size runs in a new process, so that peak memory is its
own. Ellipse: the same frames against the same landmarks with and without the search ellipse, on
simulated walls of which a quarter have a twin elsewhere, and on real pictures where available
(`CROSSCUE_DATA` or ../shared/data).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from crosscue.localization.landmarks.database import (
    LandmarkDatabase,
    LandmarkPosition,
    LandmarkWriter,
)
from crosscue.localization.landmarks.features import Keypoints
from crosscue.localization.landmarks.images import grey_of, read_encoded
from crosscue.localization.landmarks.matcher import OrbMatcher
from crosscue.localization.landmarks.update import best_candidate
from crosscue.replay.columns import Floats
from support.landmark_files import seen_from, some_features, wall

SPACING_M = 10.0
SD_M = 10.0
FRAMES = 200
ROUNDS = 5
ORB = OrbMatcher()


def build(path: Path, count: int) -> float:
    side = int(np.ceil(np.sqrt(count)))
    rng = np.random.default_rng(1)
    made = [some_features(seed, 32) for seed in range(100)]
    began = time.perf_counter()
    with LandmarkWriter(path, "orb") as writer:
        for i in range(count):
            y, x = divmod(i, side)
            xy_m = SPACING_M * np.array([x, y]) + rng.uniform(-2.0, 2.0, 2)
            writer.add(LandmarkPosition(str(i), xy_m, 4.0 * np.eye(2)), made[i % 100])
    return time.perf_counter() - began


def measure(path: Path, count: int) -> dict[str, float]:
    """Return milliseconds per frame and memory for one size, measured in this process."""
    side_m = SPACING_M * np.ceil(np.sqrt(count))
    rng = np.random.default_rng(2)
    seen = some_features(7, 500)
    search_ms, match_ms, found = [], [], 0
    before_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    with LandmarkDatabase(path) as database:
        for _ in range(ROUNDS):
            places = rng.uniform(0.0, side_m, (FRAMES, 2))
            began = time.perf_counter()
            candidates = [database.near(xy, SD_M**2 * np.eye(2)) for xy in places]
            searched = time.perf_counter()
            for some in candidates:
                best_candidate(seen, some, database, ORB)
            done = time.perf_counter()
            search_ms.append(1e3 * (searched - began) / FRAMES)
            match_ms.append(1e3 * (done - searched) / FRAMES)
            found += sum(map(len, candidates))
    return {
        "search_ms": statistics.median(search_ms),
        "match_ms": statistics.median(match_ms),
        "candidates": found / (ROUNDS * FRAMES),
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "grown_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 - before_mib,
    }


def growth(sizes: list[int]) -> None:
    print("growth (simulated descriptors, 10 m grid, 2-sigma ellipse of 20 m radius)")
    print(
        "landmarks   built s   file MiB   candidates   search ms   match ms   peak MiB   grown MiB"
    )
    for count in sizes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "marks.sqlite"
            built_s = build(path, count)
            child = subprocess.run(
                [sys.executable, __file__, "--measure", str(path), str(count)],
                capture_output=True,
                text=True,
                check=True,
            )
            got = json.loads(child.stdout)
            size_mib = path.stat().st_size / 2**20
        print(
            f"{count:9,} {built_s:9.1f} {size_mib:10.1f} {got['candidates']:11.1f} "
            f"{got['search_ms']:10.3f} {got['match_ms']:9.2f} {got['peak_mib']:9.0f} "
            f"{got['grown_mib']:10.1f}"
        )


@dataclass(frozen=True, slots=True)
class Query:
    """A frame with its true position and the position estimated by the filter."""

    seen: Keypoints
    true_m: Floats
    believed_m: Floats


def ellipse(
    name: str,
    marks: list[tuple[Floats, Keypoints]],
    queries: list[Query],
    sd_m: float,
    right_m: float,
) -> None:
    """Compare with and without the search ellipse at several thresholds."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "marks.sqlite"
        with LandmarkWriter(path, "orb") as writer:
            for i, (xy_m, features) in enumerate(marks):
                writer.add(LandmarkPosition(str(i), xy_m, 9.0 * np.eye(2)), features)
        with LandmarkDatabase(path) as database:
            everything = tuple(database)
            print(f"\n{name}: {len(marks)} landmarks, {len(queries)} frames, prior sd {sd_m:g} m")
            print("ellipse   threshold   right   false   none   compared a frame   ms a frame")
            for use in (False, True):
                best, compared = [], 0
                began = time.perf_counter()
                for query in queries:
                    near = database.near(query.believed_m, sd_m**2 * np.eye(2))
                    some = near if use else everything
                    compared += len(some)
                    best.append(best_candidate(query.seen, some, database, ORB))
                ms = 1e3 * (time.perf_counter() - began) / len(queries)
                for threshold in (6.0, 10.0, 20.0):
                    right = false = 0
                    for query, found in zip(queries, best, strict=True):
                        if found is None or found.match.score < threshold:
                            continue
                        apart = float(np.hypot(*(found.place.xy_m - query.true_m)))
                        right, false = right + (apart <= right_m), false + (apart > right_m)
                    none, each = len(queries) - right - false, compared / len(queries)
                    print(
                        f"{'yes' if use else 'no':7} {threshold:11g} {right:7} {false:7} "
                        f"{none:6} {each:18.1f} {ms:12.1f}"
                    )


def simulated_walls() -> None:
    rng = np.random.default_rng(3)
    looks = np.arange(200)
    looks[150:] = rng.permutation(150)[:50]
    places = rng.uniform(0.0, 2000.0, (200, 2))
    marks = [
        (xy, ORB.describe(seen_from(wall(int(look), 320, 240), 0.0, 1.0, 3.0, i)))
        for i, (xy, look) in enumerate(zip(places, looks, strict=True))
    ]
    queries = []
    for i in rng.permutation(200)[:100]:
        view = seen_from(wall(int(looks[i]), 320, 240), 5.0, 1.1, 6.0, 1000 + int(i))
        believed = places[i] + rng.normal(0.0, 20.0, 2)
        queries.append(Query(ORB.describe(view), places[i], believed))
    ellipse("simulated walls, a quarter with a twin", marks, queries, 20.0, 1.0)


def real_street(data: Path) -> None:
    """Compare on KITTI: frames 0, 10, 20, 30 and other places are landmarks, the rest queries."""
    folder = data / "sequences" / "kitti_seq2_right_turn_98deg"
    strangers = sorted((data / "place_recognition").rglob("*.jpg"))
    if not folder.is_dir():
        print(f"\nreal pictures: not available ({folder})")
        return
    pose = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    places = np.column_stack([pose[:, 2, 3], -pose[:, 0, 3]])
    seen = [
        ORB.describe(grey_of(read_encoded(folder / "image_l" / f"{i:06d}.png"))) for i in range(51)
    ]
    marks = [(places[i], seen[i]) for i in range(0, 31, 10)]
    rng = np.random.default_rng(4)
    for path in strangers:
        elsewhere = rng.uniform(-2000.0, 2000.0, 2)
        marks.append((elsewhere, ORB.describe(grey_of(read_encoded(path)))))
    rows = [i for i in range(51) if i % 10 or i > 30]
    queries = [Query(seen[i], places[i], places[i] + rng.normal(0.0, 5.0, 2)) for i in rows]
    ellipse("real street (KITTI) among real strangers", marks, queries, 5.0, 12.0)


def real_days(data: Path) -> None:
    """Compare eight pairs of one place on different days, labelled by eye, with other pairs."""
    folder = data / "place_recognition"
    if not folder.is_dir():
        return
    orb = OrbMatcher(features=1000)
    seen = {p.stem: orb.describe(grey_of(read_encoded(p))) for p in folder.rglob("*.jpg")}
    same = {
        ("gmb_q1", "gmb_db2"),
        ("gmb_q2", "gmb_db5"),
        ("gmb_q3", "gmb_db11"),
        ("gmb_q5", "gmb_db13"),
        ("prbonn_query_1", "prbonn_ref_0"),
        ("prbonn_query_2", "prbonn_ref_1"),
        ("prbonn_query_2", "prbonn_ref_3"),
        ("prbonn_query_3", "prbonn_ref_2"),
    }
    unsure = {("gmb_q4", f"gmb_db{i}") for i in (15, 16, 17)}
    pairs = [(q, d) for q in seen for d in seen if "_q" in q and "_q" not in d]
    score = {pair: orb.match(seen[pair[0]], seen[pair[1]]).score for pair in pairs}
    others = [score[pair] for pair in pairs if pair not in same | unsure]
    found = sorted((score[pair] for pair in same), reverse=True)
    print(
        f"\nreal pairs of different days: agreeing points of {len(same)} same places "
        f"{[int(s) for s in found]}; of {len(others)} other pairs at most {max(others):.0f}"
    )
    print(f"above every other pair: {sum(s > max(others) for s in found)} of {len(same)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", nargs="+", type=int, default=[100, 10_000, 1_000_000])
    parser.add_argument("--skip-growth", action="store_true")
    parser.add_argument("--measure", nargs=2, metavar=("DB", "COUNT"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        print(json.dumps(measure(Path(args.measure[0]), int(args.measure[1]))))
        return
    if not args.skip_growth:
        growth(args.sizes)
    simulated_walls()
    default = Path(__file__).parents[2] / "shared" / "data"
    data = Path(os.environ.get("CROSSCUE_DATA", default))
    real_street(data)
    real_days(data)


if __name__ == "__main__":
    main()
