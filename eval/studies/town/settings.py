"""Settings of a study, by default those of the published one."""

from collections.abc import Callable
from itertools import product
from typing import Annotated, Final, Literal, NamedTuple, TypeVar

from pydantic import Field, ValidationError

from crosscue.localization.town.settings import City, Proportion, TownDrive
from crosscue.replay.errors import UsageError
from crosscue.replay.vehicle.section import Section

VERSION: Final = 1
UNTIL_LOST: Final = 1_000_000

StrategyName = Literal["straight to goal", "landmark to landmark", "hybrid"]
Degrees = Annotated[float, Field(gt=0.0, le=180.0)]
Density = Annotated[float, Field(ge=0.0, le=100.0)]
Drives = Annotated[int, Field(ge=1, le=1_000_000)]
Seed = Annotated[int, Field(ge=0, lt=1 << 63)]


class Case(NamedTuple):
    """One combination of conditions.

    Attributes:
        block: Number of the block; its cases have the same cities, starts, goals and sensor errors.
        settings: Settings of each drive.
    """

    block: int
    settings: TownDrive


class _Study(Section):
    version: Literal[1] = VERSION
    seed: Seed = 1
    drive: TownDrive = TownDrive()


class RangeStudy(_Study):
    """Range without landmarks: drives from goal to goal until lost."""

    kind: Literal["range"] = "range"
    drives: Drives = 1000
    """Number of drives with each compass."""
    compass_2sigma_deg: tuple[Degrees, ...] = (10.0, 20.0, 30.0)
    without_compass: bool = True

    def cases(self) -> tuple[Case, ...]:
        """Return one case per compass."""
        compasses = (*self.compass_2sigma_deg, *((None,) if self.without_compass else ()))
        return tuple(
            Case(block, changed(self.drive, compass_2sigma_deg=compass, goals=UNTIL_LOST))
            for block, compass in enumerate(compasses)
        )


class LandmarkStudy(_Study):
    """Success by strategy, density of landmarks and detection rate, with one goal per drive."""

    kind: Literal["landmarks"] = "landmarks"
    drives: Drives = 700
    """Number of drives with each combination."""
    strategies: Annotated[tuple[StrategyName, ...], Field(min_length=1)] = (
        "straight to goal",
        "landmark to landmark",
        "hybrid",
    )
    densities_per_km2: Annotated[tuple[Density, ...], Field(min_length=1)] = (
        0.1,
        0.5,
        1.0,
        5.0,
        10.0,
    )
    detection_rates: Annotated[tuple[Proportion, ...], Field(min_length=1)] = (
        0.2,
        0.4,
        0.6,
        0.8,
        1.0,
    )
    points: tuple[tuple[Density, Proportion], ...] = ((0.55, 0.6),)
    """Further pairs of density and rate, only for landmark to landmark."""

    def cases(self) -> tuple[Case, ...]:
        """Return all cases, strategies outermost.

        Strategies of the same density and rate have the same cities.
        """
        grid = tuple(product(self.densities_per_km2, self.detection_rates))
        cases = [
            Case(block, _landmarks(self.drive, strategy, *pair))
            for strategy in self.strategies
            for block, pair in enumerate(grid)
        ]
        extra = [
            Case(len(grid) + i, _landmarks(self.drive, "landmark to landmark", *pair))
            for i, pair in enumerate(self.points)
        ]
        return (*cases, *extra)


class FieldStudy(_Study):
    """The field protocol: drives from goal to goal in a small town, with logs and replays."""

    kind: Literal["field"] = "field"
    range_runs: Annotated[int, Field(ge=0, le=10_000)] = 33
    landmark_runs: Annotated[int, Field(ge=0, le=10_000)] = 10
    town_km2: Annotated[float, Field(ge=0.25, le=25.0)] = 1.0
    minutes: Annotated[float, Field(gt=0.0, le=600.0)] = 75.0
    compass_2sigma_deg: Degrees = 25.0
    landmarks_per_km2: Density = 0.55
    detection_rate: Proportion = 0.6

    def settings(self, *, has_landmarks: bool) -> TownDrive:
        """Return the settings of one kind of run."""
        town = self.drive.city.model_dump(exclude={"smallest_km2", "largest_km2"})
        base = self.drive.model_copy(
            update={
                "city": City(smallest_km2=self.town_km2, largest_km2=self.town_km2, **town),
                "landmark_per_goal": True,
                "longest_s": 60.0 * self.minutes,
                "longest_m": 1e6,
            }
        )
        return changed(
            base,
            compass_2sigma_deg=self.compass_2sigma_deg,
            detection_rate=self.detection_rate,
            landmarks_per_km2=self.landmarks_per_km2 if has_landmarks else 0.0,
            strategy="landmark to landmark" if has_landmarks else "straight to goal",
            goals=UNTIL_LOST,
        )


Study = TypeVar("Study", RangeStudy, LandmarkStudy, FieldStudy)
_Sensors = ("compass_2sigma_deg", "detection_rate")


def changed(drive: TownDrive, **values: object) -> TownDrive:
    """Return a drive's settings with some replaced, by their names without sections."""
    sensors = {name: values.pop(name) for name in _Sensors if name in values}
    navigation = {"strategy": values.pop("strategy")} if "strategy" in values else {}
    return drive.model_copy(
        update={
            "sensors": drive.sensors.model_copy(update=sensors),
            "navigation": drive.navigation.model_copy(update=navigation),
            **values,
        }
    )


def study_of(kind: type[Study], **given: object) -> Study:
    """Return the settings of the published study, with others in their place.

    Args:
        kind: Kind of the study.
        given: The settings to replace; None for none.

    Raises:
        UsageError: A value is out of range.
    """
    changed = {name: value for name, value in given.items() if value is not None}
    try:
        return kind.model_validate(changed)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        raise UsageError(f"{name}: {changed.get(name)}, {first['msg'].lower()}") from None


def drives_of(kind: type[Study]) -> Callable[..., Study]:
    """Return a function that makes the settings of a study from the options of its command."""

    def make(*, seed: int | None = None, drives: int | None = None) -> Study:
        """Return the settings of a study.

        Args:
            seed: Random seed.
            drives: Drives per combination.
        """
        return study_of(kind, seed=seed, drives=drives)

    return make


def _landmarks(drive: TownDrive, strategy: str, per_km2: float, rate: float) -> TownDrive:
    return changed(
        drive, strategy=strategy, landmarks_per_km2=per_km2, detection_rate=rate, goals=1
    )
