"""Consistency of ranges from motion on a path like that of PandaSet 002, simulated.

Run it as ``python benchmarks/range_consistency.py [TRACKS]``. Sizes, shapes and box errors of two
lights of one make are sampled from the estimator's model; the car creeps 17 m towards them in 8 s.
The script prints the NEES (1 is consistent) over the simulated tracks, and the fraction of tracks
whose mean is as low as that of the real drive, which is one sample.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.ranging.object_tracks import CarStep, ObjectTracks
from crosscue.detectors.ranging.range_from_motion import HeightErrors
from crosscue.detectors.ranging.standard_sizes import ASPECT_SPREAD, BOX_SPREAD, HOUSINGS

FOCAL_PX, CENTER_PX = 1970.0, (970.0, 483.0)
STARTS_M = (79.0, 57.0)
RIGHT_M = (1.0, -6.0)
WAY_M, FRAMES = 17.0, 80
SCALE_SD = 0.01
# Mean NEES of the far and the near light on PandaSet 002.
REAL = (0.13, 0.10)


def track(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the NEES of both lights in each frame, shape (frames, 2)."""
    housings = list(HOUSINGS.values())
    common = np.array([one.proportion for one in housings])
    housing = housings[rng.choice(len(housings), p=common / common.sum())]
    own = np.exp(BOX_SPREAD * rng.normal(size=2))
    shape = np.exp(ASPECT_SPREAD * rng.normal())
    scale, errors = 1.0 + SCALE_SD * rng.normal(), HeightErrors()
    speed = np.clip(np.linspace(-1.5, 5.5, FRAMES), 0.02, None)
    gone_m = np.cumsum(speed) * WAY_M / speed.sum()
    tracks = ObjectTracks("traffic_light", FOCAL_PX, CENTER_PX, SCALE_SD)
    off, before_m, found = rng.normal(size=2), 0.0, []
    for now_m in gone_m:
        step_m, before_m = now_m - before_m, now_m
        alike = np.exp(-step_m / errors.resemble_m)
        off = alike * off + np.sqrt(1.0 - alike**2) * rng.normal(size=2)
        px_per_m = FOCAL_PX / (np.array(STARTS_M) - now_m)
        exact_px = housing.height_m * own * px_per_m
        height = exact_px * np.exp(np.hypot(errors.fraction, errors.edges_px / exact_px) * off)
        width = housing.width_m * own * shape * px_per_m
        x, y = CENTER_PX[0] + RIGHT_M * px_per_m, CENTER_PX[1] - 3.0 * px_per_m
        boxes = np.stack([x - width / 2, y - height / 2, x + width / 2, y + height / 2], axis=1)
        motion = CarStep(float(step_m * scale), 0.0, 0.0, 0.1)
        ranged = tracks(motion, boxes, height, ["dark", "dark"])[:2]
        true_m = np.array(STARTS_M)[: len(ranged)] - now_m
        found.append(
            [(one.range_m - m) ** 2 / one.var_m2 for one, m in zip(ranged, true_m, strict=True)]
        )
    return np.array(found)


def main() -> None:
    """Print the NEES over the simulated tracks and its comparison with the real drive."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    rng = np.random.default_rng(1)
    tracks = np.array([track(rng) for _ in range(count)])
    means = tracks.mean(axis=1)
    low = (means <= REAL).mean(axis=0)
    print(f"{count} simulated pairs of lights: far, near")
    for name, values in (("first frame", tracks[:, 0]), ("last", tracks[:, -1]), ("all", means)):
        far, near = values.mean(axis=0)
        print(f"  NEES, {name:12} {far:.2f}, {near:.2f}")
    print(f"  tracks with a mean as low as the real drive's: {low[0]:.0%}, {low[1]:.0%}")


if __name__ == "__main__":
    main()
