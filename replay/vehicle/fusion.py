"""The vehicle file's sections on intersection range and belief, for ``crosscue.fusion``.

The graph of cues and features is a table in the vehicle file. Users who interpret the source's
figure differently, or who add a cue or a feature, change a line of the file:

    [fusion.cues]
    stop_sign = { precision = 0.99 }                          # other keys keep their defaults
    zebra = { precision = 0.8, supports = ["intersection"] }  # a new cue
    lanes_past = { use = false }                              # a disabled cue
"""

import difflib
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from .cue_table import CUES
from .section import Name, NotNegative, Positive, Probability, Section

ByDistance = Annotated[tuple[Probability, ...], Field(min_length=1)]


class CueChain(Section):
    """Transition probabilities of a cue, given the presence and absence of features.

    Probabilities are listed by distance, nearest first, in the bins of ``Temporal.edges_m``. Where
    no intersection is ahead, each list has a single entry.
    """

    cue: Name
    there: tuple[Name, ...] = ()
    """Features that are present; if this and ``missing`` are empty, no intersection is ahead."""
    missing: tuple[Name, ...] = ()
    """Features that are absent."""
    first: ByDistance
    """Probability of a positive if the cue was not evaluated in the previous step."""
    stays: ByDistance
    """Probability of a positive after a positive."""
    appears: ByDistance
    """Probability of a positive after a negative."""

    @model_validator(mode="after")
    def _line_up(self) -> Self:
        if not len(self.first) == len(self.stays) == len(self.appears):
            raise PydanticCustomError(
                "temporal", "first, stays, appears: expected equal numbers of entries"
            )
        return self


class Temporal(Section):
    """Parameters learned by ``crosscue fit temporal``."""

    ahead: Probability
    """Probability that an intersection is within the visibility range where a drive begins."""
    ways: dict[str, Probability]
    """Prior probabilities of the combinations of roads at an intersection, joined by ``+``
    (``none`` for a dead end): ``{ "left+right" = 0.2, ... }``. Other combinations have probability
    zero."""
    edges_m: Annotated[tuple[float, ...], Field(min_length=2)]
    """Edges of the distance bins, ascending; the last one is the visibility range."""
    chains: tuple[CueChain, ...]
    exponent: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    """Exponent of all cues' likelihoods, since cues are correlated even given the state."""
    lapse: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.0
    """Probability of an atypical place, where cues are uninformative and the prior applies."""
    stray: Probability = 0.05
    """Probability that a sign's range is unrelated to the intersection."""
    step_m: Positive = 1.5
    """Distance after which a cue is evaluated again; standing adds no evidence."""
    step_s: Positive = 0.5
    """Time after which cues of moving objects are searched for an appearance in between."""
    spacing_m: Positive = 150.0
    """Mean distance between intersections."""
    cell_m: Positive = 2.0
    """Width of the cells of the distance grid."""
    behind_m: NotNegative = 4.0
    """Distance behind the vehicle at which an intersection is passed."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if any(a >= b for a, b in pairwise(self.edges_m)):
            raise PydanticCustomError("temporal", "edges_m: expected ascending distances")
        bins = len(self.edges_m) - 1
        for one in self.chains:
            wanted = bins if one.there or one.missing else 1
            if len(one.first) != wanted:
                raise PydanticCustomError(
                    "temporal",
                    "{cue}: expected {wanted} entries, got {got}",
                    {"cue": one.cue, "wanted": wanted, "got": len(one.first)},
                )
        if not self.ways:
            raise PydanticCustomError("temporal", "ways: expected at least one")
        return self


class Combined(Section):
    """Logistic regression over running counts of cues, learned by ``crosscue fit temporal``."""

    intercepts: dict[Name, float]
    """Log odds of each feature without counts."""
    positive: dict[Name, dict[Name, float]]
    """Weight of each cue's positive steps in the log odds of each feature."""
    negative: dict[Name, dict[Name, float]]
    """Weight of the steps in which the cue was looked for in vain."""
    fade_m: Positive = 50.0
    """Distance over which counts fade."""
    step_m: Positive = 5.0
    """Distance that counts as one step."""


# Assumed precision of roads of ``[regions] kind = "area"``, a round number; what the shape of the
# mask shows says more or less, by its log odds.
OPENING_PRECISION: Final = 0.9
# Columns of ``belief.parquet``, which cannot be names of features.
NOT_FEATURES: Final = ("t_ns", "approach", "established", "not_believed")


class RangeFilter(Section):
    """The 1-D filter of the distance to an intersection (eq. 8 to 12)."""

    gate_nis: Positive | None = 16.0
    """Measurements with a larger normalised innovation squared are rejected and counted."""
    max_m: Positive = 150.0
    """Maximum range of a measurement; larger ones are rejected and counted."""
    begin_after: Annotated[int, Field(ge=1)] = 2
    """Number of consistent measurements that start a range; the source uses 1. On simulated layouts
    that are not scored, false lights are often detected once, and true lights repeatedly."""
    begin_within_m: Positive = 5.0
    """Distance travelled after which an unconfirmed first measurement is discarded."""
    restart_after: Annotated[int, Field(ge=1)] = 5
    """Number of consecutive rejected measurements that, if consistent, restart the filter."""
    sd_fraction: NotNegative = 0.05
    """Fraction of the range whose square is added to the variance of a range curve (source: 0)."""
    fade_m: NotNegative = 1.0
    """Distance over which the errors of a sign's measurements are correlated, so that measurements
    in quick succession count less. With 0, frames are independent, as in the source. On simulated
    drives, the variance is then five times too small; with the defaults of this setting and
    ``sd_fraction`` it is about right."""
    take_up_m: NotNegative = 10.0
    """Distance over which the filter adopts a range from motion. Such a range is estimated mostly
    from earlier observations and is not an independent measurement. Corrections smaller than this
    never increase the range. With 0, the range is adopted at once."""
    unseen_mps: Positive = 15.0
    """Growth of the standard deviation per second where odometry is missing; the mean is kept."""
    max_sd_m: Positive = 20.0
    """Maximum standard deviation; an estimate above it is discarded."""


class FeatureEntry(Section):
    """A feature of an intersection."""

    prior: Probability = 0.5
    establishes: bool = False
    """If true, a high probability of this feature establishes that an intersection is present."""
    use: bool = True


class Fade(Section):
    """Correlation length of a cue's errors: a distance, or a time for moving objects."""

    way_m: Positive | None = None
    time_s: Positive | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.way_m is None) == (self.time_s is None):
            raise _refused("expected either way_m or time_s")
        return self


class CueEntry(Section):
    """A cue: its precision, and the features that it implies."""

    precision: Probability
    """Fraction of correct detections; the strength of its messages (Table 5)."""
    supports: tuple[Name, ...] = ()
    """Features whose presence it implies: direct edges."""
    excludes: tuple[Name, ...] = ()
    """Features whose absence it implies: exclusive edges."""
    can_start: bool = False
    """If true, it sends messages before presence is established."""
    per_detection: bool = False
    """If true, it sends one message per detection instead of one per frame."""
    absence_counts: bool = False
    """If true, its absence near the intersection is evidence against the supported features."""
    seen_frames: Annotated[int, Field(ge=1)] = 3
    """With ``kind = "persistent"``: required number of positive frames among ``of_frames``."""
    of_frames: Annotated[int, Field(ge=1, le=1000)] = 5
    """With ``kind = "persistent"``: number of most recent frames that evaluated the cue."""
    within_m: Positive = 100.0
    """With ``kind = "persistent"``: maximum range of the intersection, because the cue was not
    validated beyond. It does not apply where the range is unknown."""
    at_most: Probability | None = None
    """With ``kind = "persistent"``: probability that it can give a feature as long as no other cue
    speaks for the intersection. A light may be a pedestrian crossing's, however long it is seen."""
    fade: Fade = Fade(way_m=10.0)
    """With ``kind = "persistent"``: correlation length of its errors."""
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
    """Return the default entries of all cues, after Table 5 and our interpretation of Fig. 27."""
    same = CueEntry.model_fields.keys() - {"fade", "use"}
    return {
        name: CueEntry(
            fade=Fade(way_m=cue.fade_m) if cue.fade_s is None else Fade(time_s=cue.fade_s),
            **{field: getattr(cue, field) for field in same},
        )
        for name, cue in CUES.items()
    }


class Rates(Section):
    """Rates of positive frames of a cue, where a feature is present and where it is absent."""

    cue: Name
    feature: Name
    near: bool
    """True for the rates within ``dissent_within_m`` of the intersection, False for the others."""
    if_there: Probability
    if_not: Probability


class Calibrated(Section):
    """Parameters learned by ``crosscue fit messages``; see ``crosscue.fusion.calibrated``."""

    fades: dict[Name, Fade] = Field(default_factory=dict)
    """Correlation length of the errors, by cue."""
    exponents: dict[Name, NotNegative] = Field(default_factory=dict)
    """Factor on the log odds of all messages, by feature, because cues are correlated."""
    rates: tuple[Rates, ...] = ()


class Fusion(Section):
    """Belief over the features of an intersection (eq. 18)."""

    kind: Literal["source", "calibrated", "persistent", "temporal", "combined"] | None = None
    """``source`` multiplies all messages (eq. 18). ``calibrated`` uses learned likelihood ratios,
    discounted for correlation. ``persistent`` uses the published messages of cues that are positive
    in several frames and near enough, and discounts correlated frames. ``temporal`` filters a
    learned hidden Markov model along the drive, and ``combined`` takes the mean of its log odds and
    those of a learned regression. Default: ``source`` in a simulated vehicle's file,
    else ``persistent``."""
    established: Probability = 0.9
    """Probability of a feature above which it establishes the presence of an intersection."""
    withdrawn: Probability = 0.5
    """With ``temporal`` and ``combined``: presence is withdrawn if no such feature exceeds it."""
    dissent: Probability = 0.49
    """Message strength of an undetected cue with ``absence_counts``, near the intersection."""
    dissent_within_m: NotNegative = 20.0
    dissent_every_m: NotNegative = 0.1
    """Minimum distance between two such messages: a stationary vehicle gains no new evidence."""
    reference: Literal["start", "end"] = "start"
    """Range used for dissent and for cues past the intersection, where both are known."""
    length_m: NotNegative = 15.0
    """Assumed length of an intersection, where only its start is known."""
    closes_behind_m: NotNegative = 2.0
    """Distance of the intersection behind the rear axle at which an approach ends."""
    stale_after_m: Positive = 60.0
    """Distance travelled without evidence after which an approach ends."""
    stale_unranged_m: Positive = 30.0
    """The same distance where no sign has a range."""
    longest_m: Positive = 100.0
    """Maximum length of an approach, as in the source's runs. Evidence from farther before an
    intersection is not attributed to it. Without a range, an approach ends after this distance."""
    turned_rad: Positive = 0.8
    """Turn within about 25 m that ends an approach without a range ahead."""
    rest_m: NotNegative = 10.0
    """Distance after an intersection over which only a sign with a range starts an approach."""
    features: Annotated[dict[Name, FeatureEntry], Field(validate_default=True)] = Field(
        default_factory=dict
    )
    cues: Annotated[dict[Name, CueEntry], Field(validate_default=True)] = Field(
        default_factory=dict
    )

    calibrated: Calibrated | None = None
    temporal: Temporal | None = None
    combined: Combined | None = None

    def with_openings(self) -> Self:
        """Return the settings in which a road to a side, as the road area shows it, says more.

        It leaves the carriageway at a place that stays where it is, so it is an intersection, too,
        and its precision is another. Entries that differ from the defaults are kept.
        """
        usual, cues = usual_cues(), dict(self.cues)
        for name, more in (
            ("road_left", ("intersection",)),
            ("road_right", ("intersection",)),
            ("road_straight", ()),
        ):
            if cues.get(name) == usual[name]:
                # The mean over frames confirms it before it is a cue.
                changed = {
                    "supports": (*usual[name].supports, *more),
                    "precision": OPENING_PRECISION,
                    "seen_frames": 1,
                }
                cues[name] = usual[name].model_copy(update=changed)
        return self.model_copy(update={"cues": cues})

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
                raise _refused(f"{name}: a feature occurs twice in its edges; keep one")
            _check_known(
                edges, features, f"{name}: no feature", f"; there are: {', '.join(features)}"
            )
        return cues

    @field_validator("calibrated")
    @classmethod
    def _known_edges(cls, learned: Calibrated | None, info: ValidationInfo) -> Calibrated | None:
        if learned is None or "cues" not in info.data:
            return learned
        cues, features = info.data["cues"], info.data["features"]
        for known, names in ((cues, learned.fades), (features, learned.exponents)):
            _check_known(names, known, "no", f"; there are: {', '.join(known)}")
        seen: set[tuple[str, str, bool]] = set()
        for one in learned.rates:
            edges = cues[one.cue].supports + cues[one.cue].excludes if one.cue in cues else ()
            if one.feature not in edges:
                raise _refused(f"rates: no edge from {one.cue} to {one.feature}; add it")
            key = (one.cue, one.feature, one.near)
            if key in seen:
                raise _refused(f"rates: {one.cue} and {one.feature} occur twice; keep one")
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
            _check_known((one.cue,), self.cues, "temporal: no cue")
            _check_known((*one.there, *one.missing), self.features, "temporal: no feature")
        sides = () if self.combined is None else (self.combined.positive, self.combined.negative)
        for name, weights in (pair for side in sides for pair in side.items()):
            _check_known((name,), self.features, "combined: no feature")
            _check_known(weights, self.cues, "combined: no cue")
        if self.kind not in ("temporal", "combined"):
            return self
        for name in ("temporal", self.kind):
            if getattr(self, name) is None:
                raise _refused(
                    f"kind {self.kind} needs [fusion.{name}]; make it with: crosscue fit temporal"
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
        if not any(one.use and one.can_start for one in self.cues.values()):
            raise _refused("cues: none can start an approach; set can_start = true for one")
        return self


def _merged(usual: Mapping[str, Section], given: object) -> object:
    """Merge the default entries with the user's keys, as unvalidated tables."""
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


def _check_known(
    names: Iterable[str], known: Mapping[str, object], of: str, more: str = ""
) -> None:
    for name in names:
        if name not in known:
            raise _refused(f"{of} {name!r}{_near(name, known)}{more}")


def _refused(why: str) -> PydanticCustomError:
    return PydanticCustomError("fusion", "{why}", {"why": why})
