"""Results of the range study for other choices of the two numbers that decide it most.

The source states neither how long a compass error lasts nor how much its wheels slip. The first was
calibrated to one published figure; here both are varied, so that a reader sees what the others are
worth as predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.eval.studies.intervals import Measured, mean_of
from crosscue.eval.studies.page import Table
from crosscue.eval.studies.pictures import COLOURS, figure, save
from crosscue.eval.studies.words import km
from crosscue.localization.town.drive import Outcome, Result, drive_many
from crosscue.localization.town.random_stream import key_of
from crosscue.localization.town.settings import Drive

from .range_study import CALIBRATED_DEG, PUBLISHED_M
from .settings import UNTIL_LOST, RangeStudy, changed

NAME: Final = "range_choices"
SLIPS: Final = (0.5, 1.0, 2.0, 3.0)
"""Times the study's own."""
INTERVALS: Final = (0.6, 0.8, 0.95, 1.0, 1.25, 1.6)
"""Times the study's own."""
PREDICTED: Final = (20.0, None)
"""Compasses whose published figure was not calibrated to; infinite ones need no curve."""
FRACTION: Final = 10
"""Of the study's drives, one in so many for each choice."""
BLOCK: Final = 1000
"""Of seeds, which no case of the study uses."""
PICTURE: Final = (12.0, 4.6)


@dataclass(frozen=True, slots=True)
class Choice:
    """The distance at loss with one slip and one compass interval.

    Attributes:
        slip_per_sqrt_m: S.d. of a wheel's path after one metre.
        compass_interval_m: Distance between readings with errors of their own.
        is_studied: The choice of the study itself.
        drives: With each compass.
        lost_after_m: Mean by compass 2-sigma in degrees; None without a compass.
    """

    slip_per_sqrt_m: float
    compass_interval_m: float
    is_studied: bool
    drives: int
    lost_after_m: dict[float | None, Measured]


def drive_choices(study: RangeStudy, workers: int = 2) -> tuple[Choice, ...]:
    """Drive every pair of slip and interval; seconds for a full study."""
    sensors, count = study.drive.sensors, max(study.drives // FRACTION, 1)
    with ThreadPoolExecutor(workers) as pool:
        return tuple(
            pool.map(
                lambda pair: _choice(study, pair, count),
                [
                    (slip * sensors.slip_per_sqrt_m, max(times * sensors.compass_interval_m, 1.0))
                    for slip, times in product(SLIPS, INTERVALS)
                ],
            )
        )


def _choice(study: RangeStudy, pair: tuple[float, float], count: int) -> Choice:
    slip, interval_m = pair
    own = study.drive.sensors
    sensors = own.model_copy(update={"slip_per_sqrt_m": slip, "compass_interval_m": interval_m})
    drive = study.drive.model_copy(update={"sensors": sensors})
    seeds = np.array([key_of(study.seed, BLOCK, i) for i in range(count)], np.uint64)
    return Choice(
        slip_per_sqrt_m=slip,
        compass_interval_m=interval_m,
        is_studied=(slip, interval_m) == (own.slip_per_sqrt_m, own.compass_interval_m),
        drives=count,
        lost_after_m={
            compass: _lost_after(drive, compass, seeds) for compass in (CALIBRATED_DEG, *PREDICTED)
        },
    )


def _lost_after(
    drive: Drive, compass: float | None, seeds: np.typing.NDArray[np.uint64]
) -> Measured:
    rows = drive_many(changed(drive, compass_2sigma_deg=compass, goals=UNTIL_LOST), seeds)
    lost = rows[:, Result._fields.index("outcome")] == Outcome.LOST
    return mean_of(rows[lost, Result._fields.index("travelled_m")])


def as_dict(choice: Choice) -> dict[str, object]:
    """As in ``summary.json``; the compass is named in degrees, or ``none``."""
    return {
        **asdict(choice),
        "lost_after_m": {
            "none" if compass is None else f"{compass:g}": mean
            for compass, mean in choice.lost_after_m.items()
        },
    }


def table(choices: Sequence[Choice]) -> Table:
    """Every choice beside the published figures."""
    published = [f"{PUBLISHED_M[c] / 1e3:.1f} published" for c in (CALIBRATED_DEG, *PREDICTED)]
    return Table(
        f"Mean distance at loss with other choices, km ({choices[0].drives} drives each)",
        (
            "slip, m per root m",
            "compass interval, m",
            f"30 degrees, {published[0]}",
            f"20 degrees, {published[1]}",
            f"none, {published[2]}",
        ),
        tuple(
            (
                f"{one.slip_per_sqrt_m:g}",
                f"{one.compass_interval_m:.3f}" + (" (studied)" if one.is_studied else ""),
                *(km(one.lost_after_m[c]) for c in (CALIBRATED_DEG, *PREDICTED)),
            )
            for one in choices
        ),
    )


def draw(choices: Sequence[Choice], folder: Path) -> Path:
    """Write ``range_choices.png`` and ``range_choices.svg``."""
    made, axes = figure(2, *PICTURE)
    for panel, compass in zip(axes, (CALIBRATED_DEG, PREDICTED[0]), strict=True):
        for i, slip in enumerate(dict.fromkeys(one.slip_per_sqrt_m for one in choices)):
            mine = [one for one in choices if one.slip_per_sqrt_m == slip]
            found = np.array([one.lost_after_m[compass] for one in mine]) / 1e3
            panel.errorbar(
                [one.compass_interval_m for one in mine],
                found[:, 0],
                np.nan_to_num(np.abs(found[:, 1:] - found[:, :1]).T),
                color=COLOURS[i % len(COLOURS)],
                marker="o",
                ms=3,
                lw=1.2,
                label=f"slip {slip:g} m per root m",
            )
        for one in choices:
            if one.is_studied:
                panel.axvline(one.compass_interval_m, color="0.6", lw=0.9)
        panel.axhline(PUBLISHED_M[compass] / 1e3, color="0.2", ls="--", lw=1.0)
        panel.set_ylim(bottom=0.0)
        panel.set_xlabel("distance between independent compass readings (m)")
        panel.set_ylabel("mean distance at loss (km)")
        role = "calibrated here" if compass == CALIBRATED_DEG else "predicted"
        panel.set_title(f"compass ±{compass:g}°: {role}; dashed: published", fontsize=9)
    axes[0].legend(frameon=False, fontsize=8)
    made.suptitle("Other choices of slip and compass interval, simulated", fontsize=11)
    return save(made, folder, NAME)
