"""The vehicle file's sections on intersection range and belief; rules in ``crosscue.fusion``.

The graph of cues and features is a table here, so that who reads the source's figure otherwise, or
has a cue or feature of one's own, changes a line of the vehicle file:

    [fusion.cues]
    stop_sign = { precision = 0.99 }                          # the rest as below
    zebra = { precision = 0.8, supports = ["intersection"] }  # a new one
    lanes_past = { use = false }                              # left out
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from .cue_table import CUES
from .section import NotNegative, Positive, Section
from .temporal import Temporal

Probability = Annotated[float, Field(gt=0.0, lt=1.0)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)]

NOT_FEATURES: Final = ("t_ns", "approach", "established", "not_believed")
"""Columns of ``belief.parquet`` that no feature may be called."""


class RangeFilter(Section):
    """The 1-D filter of the distance to an intersection (eq. 8 to 12)."""

    gate_nis: Positive | None = 16.0
    """Measurements whose normalised innovation squared is larger are refused and counted."""
    max_m: Positive = 150.0
    """A sign measured further away than this is refused and counted."""
    begin_after: Annotated[int, Field(ge=1)] = 2
    """So many measurements that agree begin a range; the source has 1. On simulated layouts that
    are not scored, lights that are not there are often seen once, those that are there again and
    again."""
    begin_within_m: Positive = 5.0
    """A first observation that none has confirmed within this way is forgotten."""
    restart_after: Annotated[int, Field(ge=1)] = 5
    """So many refused measurements in a row that agree among themselves replace the belief."""
    sd_fraction: NotNegative = 0.05
    """This fraction of a sign's range is added to its curve's s.d. in squares (source: 0)."""
    fade_m: NotNegative = 1.0
    """A sign's errors resemble each other over this way, so that an observation soon after another
    counts for less. With 0 every frame is a new look, as in the source; on simulated drives the
    variance
    is then five times too small, with these two about right."""
    take_up_m: NotNegative = 10.0
    """A range from motion is taken up over this way: it is an estimate from the same observations
    as before and some more, no new measurement. Corrections below it never make the range grow.
    With 0 it is taken up at once."""
    unseen_mps: Positive = 15.0
    """Where odometry is missing, the s.d. grows by this each second; the mean stays."""
    max_sd_m: Positive = 20.0
    """A belief less sure than this is dropped."""


class FeatureEntry(Section):
    """One thing to know about an intersection."""

    prior: Probability = 0.5
    establishes: bool = False
    """An intersection counts as present once this is probable."""
    use: bool = True


class Fade(Section):
    """Over what a cue's looks become independent: a way, or a time for what moves by itself."""

    way_m: Positive | None = None
    time_s: Positive | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.way_m is None) == (self.time_s is None):
            raise _refused("expected either way_m or time_s")
        return self


class CueEntry(Section):
    """One cue: its reliability, and the features that it is about."""

    precision: Probability
    """Fraction of its detections that are right; what it sends along its edges (Table 5)."""
    supports: tuple[Name, ...] = ()
    """Features that it shows to be there: direct edges."""
    excludes: tuple[Name, ...] = ()
    """Features that it shows not to be there: exclusive edges."""
    speaks_first: bool = False
    """Sends before presence is established."""
    counted: bool = False
    """Sends one message for each detection, not one for each frame."""
    dissents: bool = False
    """Near the intersection its absence speaks against what it supports."""
    seen_frames: Annotated[int, Field(ge=1)] = 3
    """With ``kind = "persistent"``, a cue counts once it was positive in this many ..."""
    of_frames: Annotated[int, Field(ge=1, le=1000)] = 5
    """... of this many most recent frames in which it was searched for."""
    within_m: Positive = 100.0
    """With ``kind = "persistent"`` it says nothing about an intersection known to be farther
    away, since it was never validated there. An unknown range limits nothing."""
    fade: Fade = Fade(way_m=10.0)
    """With ``kind = "persistent"``: over what its errors become independent."""
    use: bool = True

    @model_validator(mode="after")
    def _can_be_seen(self) -> Self:
        if self.seen_frames > self.of_frames:
            raise _refused(
                f"seen_frames {self.seen_frames} of of_frames {self.of_frames}; expected no more"
            )
        return self


FEATURES: Final[Mapping[str, FeatureEntry]] = {
    "intersection": FeatureEntry(establishes=True),
    "left": FeatureEntry(establishes=True),
    "right": FeatureEntry(establishes=True),
    "straight": FeatureEntry(),
}


def usual_cues() -> dict[str, CueEntry]:
    """Every cue of the table as the source has it (Table 5 and our reading of Fig. 27)."""
    return {
        name: CueEntry(
            precision=cue.precision,
            supports=cue.supports,
            excludes=cue.excludes,
            speaks_first=cue.can_start,
            counted=cue.per_detection,
            dissents=cue.absence_counts,
            seen_frames=cue.seen_frames,
            of_frames=cue.of_frames,
            within_m=cue.within_m,
            fade=Fade(way_m=cue.fade_m) if cue.fade_s is None else Fade(time_s=cue.fade_s),
        )
        for name, cue in CUES.items()
    }


class Rates(Section):
    """How often a cue is positive where a feature is there, and where it is not."""

    cue: Name
    feature: Name
    near: bool
    """Within ``dissent_within_m`` of the intersection, or not known to be."""
    if_there: Probability
    if_not: Probability


class Calibrated(Section):
    """What ``crosscue fit messages`` has learned; see ``crosscue.fusion.calibrated``."""

    fades: dict[Name, Fade] = Field(default_factory=dict)
    """By cue."""
    exponents: dict[Name, NotNegative] = Field(default_factory=dict)
    """By feature: all messages' log odds times this, since cues repeat one another."""
    rates: tuple[Rates, ...] = ()


class Fusion(Section):
    """Belief over the features of an intersection (eq. 18)."""

    kind: Literal["source", "calibrated", "persistent", "temporal"] | None = None
    """``source`` multiplies every message in (eq. 18); ``calibrated`` takes learned ratios,
    discounted; ``persistent`` believes the published messages only of what is seen in several
    frames, near enough, and discounts frames that resemble each other; ``temporal`` filters a
    learned hidden Markov model along the drive. Left out: ``source`` in a simulated car's file,
    ``persistent`` in every other."""
    established: Probability = 0.9
    """Presence is established once a feature that establishes it is more probable than this."""
    withdrawn: Probability = 0.5
    """With ``kind = "temporal"`` it is withdrawn once none of them is more probable than this."""
    dissent: Probability = 0.49
    """What a cue that dissents sends near the intersection when it is not detected."""
    dissent_within_m: NotNegative = 20.0
    dissent_every_m: NotNegative = 0.1
    """Min distance travelled between two such messages: a car that stands sees nothing new."""
    reference: Literal["start", "end"] = "start"
    """Which range applies to dissent and to cues past the intersection, where both are known."""
    length_m: NotNegative = 15.0
    """From the start of an intersection to its end, where only the start is known."""
    closes_behind_m: NotNegative = 2.0
    """An approach ends once the intersection is this far behind the rear axle."""
    stale_after_m: Positive = 60.0
    """Or once the car has gone this far without any evidence."""
    stale_unranged_m: Positive = 30.0
    """The same where no sign has reported a range."""
    longest_m: Positive = 100.0
    """Evidence from further before an intersection is not about it; the source's runs are as long.
    Without a range an approach ends after this distance."""
    turned_rad: Positive = 0.8
    """Without a range ahead, an approach ends once the car has turned this much within about 25
    m."""
    rest_m: NotNegative = 10.0
    """Over this distance after an intersection, only a sign with a range opens an approach."""
    features: Annotated[dict[Name, FeatureEntry], Field(validate_default=True)] = Field(
        default_factory=dict
    )
    cues: Annotated[dict[Name, CueEntry], Field(validate_default=True)] = Field(
        default_factory=dict
    )

    calibrated: Calibrated | None = None
    temporal: Temporal | None = None

    @field_validator("features", mode="before")
    @classmethod
    def _with_usual_features(cls, given: object) -> object:
        return _merged(FEATURES, given)

    @field_validator("cues", mode="before")
    @classmethod
    def _with_usual_cues(cls, given: object) -> object:
        if isinstance(given, Mapping):
            for name, entry in given.items():
                is_new = name not in CUES and isinstance(entry, Mapping)
                if is_new and "precision" not in entry:
                    raise _refused(
                        f"{name}: no such cue{_near(name, CUES)}; a new one needs precision and "
                        f"supports or excludes; there are: {', '.join(CUES)}"
                    )
        return _merged(usual_cues(), given)

    @field_validator("features")
    @classmethod
    def _free_names(cls, features: dict[str, FeatureEntry]) -> dict[str, FeatureEntry]:
        for name in NOT_FEATURES:
            if name in features:
                raise _refused(f"{name}: a column of the belief table; choose another name")
        return features

    @field_validator("cues")
    @classmethod
    def _known_features(
        cls, cues: dict[str, CueEntry], info: ValidationInfo
    ) -> dict[str, CueEntry]:
        features = info.data.get("features", {})
        for name, cue in cues.items():
            edges = (*cue.supports, *cue.excludes)
            if not edges:
                raise _refused(f"{name}: neither supports nor excludes a feature; name one")
            if len(set(edges)) < len(edges):
                raise _refused(f"{name}: a feature stands twice in its edges; keep one")
            for feature in edges:
                if feature not in features:
                    raise _refused(
                        f"{name}: no feature {feature!r}{_near(feature, features)}; "
                        f"there are: {', '.join(features)}"
                    )
        return cues

    @field_validator("calibrated")
    @classmethod
    def _known_edges(cls, learned: Calibrated | None, info: ValidationInfo) -> Calibrated | None:
        if learned is None or "cues" not in info.data:
            return learned
        cues, features = info.data["cues"], info.data["features"]
        for known, names in ((cues, learned.fades), (features, learned.exponents)):
            for name in names:
                if name not in known:
                    raise _refused(
                        f"no {name!r}{_near(name, known)}; there are: {', '.join(known)}"
                    )
        seen: set[tuple[str, str, bool]] = set()
        for one in learned.rates:
            edges = cues[one.cue].supports + cues[one.cue].excludes if one.cue in cues else ()
            if one.feature not in edges:
                raise _refused(f"rates: {one.cue} and {one.feature} are not joined; add the edge")
            key = (one.cue, one.feature, one.near)
            if key in seen:
                raise _refused(f"rates: {one.cue} and {one.feature} stand twice; keep one")
            seen.add(key)
        return learned

    @model_validator(mode="after")
    def _has_learned(self) -> Self:
        if self.kind == "calibrated" and self.calibrated is None:
            raise _refused(
                "kind calibrated needs [fusion.calibrated]; make it with: crosscue fit messages"
            )
        return self

    @model_validator(mode="after")
    def _has_learned_chains(self) -> Self:
        for one in () if self.temporal is None else self.temporal.chains:
            if one.cue not in self.cues:
                raise _refused(f"temporal: no cue {one.cue!r}{_near(one.cue, self.cues)}")
            for name in (*one.there, *one.missing):
                if name not in self.features:
                    raise _refused(f"temporal: no feature {name!r}{_near(name, self.features)}")
        if self.kind != "temporal":
            return self
        if self.temporal is None:
            raise _refused(
                "kind temporal needs [fusion.temporal]; make it with: crosscue fit temporal"
            )
        if self.withdrawn >= self.established:
            raise _refused(
                f"withdrawn {self.withdrawn:g}, established {self.established:g}: "
                "expected withdrawn to be smaller"
            )
        return self

    @model_validator(mode="after")
    def _can_begin(self) -> Self:
        if not any(one.use and one.establishes for one in self.features.values()):
            raise _refused("features: none establishes presence; set establishes = true for one")
        if not any(one.use and one.speaks_first for one in self.cues.values()):
            raise _refused("cues: none speaks first; set speaks_first = true for one")
        return self


def _merged(usual: Mapping[str, Section], given: object) -> object:
    """The usual entries with the given ones' keys over them, as unchecked tables."""
    if not isinstance(given, Mapping):
        return given
    merged: dict[object, Any] = {name: entry.model_dump() for name, entry in usual.items()}
    for name, entry in given.items():
        over = entry.model_dump() if isinstance(entry, Section) else entry
        merged[name] = merged.get(name, {}) | over if isinstance(over, Mapping) else over
    return merged


def _near(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f" (did you mean {close[0]}?)" if close else ""


def _refused(why: str) -> PydanticCustomError:
    return PydanticCustomError("fusion", "{why}", {"why": why})
