"""The vehicle file: which stream plays which role, how sensors are mounted, how noisy they are.

TOML, versioned, checked with pydantic. Unknown keys, wrong units and missing roles are refused with
the line in the file and a suggestion. Units stand last in every name (SI); frames are ISO 8855 /
REP-103: x forward, y left, heading counter-clockwise. Every default is written to the manifest.

The table of cues, which the file is checked against, is exported with it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from crosscue.replay.base import MIB, VehicleError, read_at_most, toml_tree

from .cue_spec import CueSpec as CueSpec
from .cue_spec import Input as Input
from .cue_spec import Scoring as Scoring
from .cue_table import BUILTIN_CUES as BUILTIN_CUES
from .cue_table import CUES as CUES
from .cue_table import SAME_SIGN
from .cue_table import STOP_SIGN as STOP_SIGN
from .cue_table import TRAFFIC_LIGHT as TRAFFIC_LIGHT
from .fusion import Fusion, Name, RangeFilter
from .mobileye_cues import Past
from .pose import DEGREE, Gnss, Odometry, Start
from .section import Finite, NotNegative, Positive, Section, tuples
from .time import Time
from .validation_errors import explain

VERSION: Final = 1
MAX_BYTES: Final = 1 * MIB

Vector = tuple[Finite, Finite, Finite]
Matrix = tuple[Vector, Vector, Vector]
Proportion = Annotated[float, Field(ge=0.0, le=1.0)]
Polygon = Annotated[tuple[tuple[Proportion, Proportion], ...], Field(min_length=3)]
Signal = Annotated[str, Field(pattern=r"^[^.\s]+\.[^.\s]+$")]
"""``MESSAGE.SIGNAL`` as the DBC file spells them."""


class Topics(Section):
    """Which topic plays which role; a role left out goes to the only topic of a fitting type."""

    camera: str | None = None
    imu: str | None = None
    magnetometer: str | None = None
    heading: str | None = None
    """Topic with a column ``heading_rad``, or an inertial unit whose orientation is trusted."""
    gnss: str | None = None
    odometry: str | None = None


class WheelSpeeds(Section):
    """Signals with the speed of each wheel; the rear two alone are enough."""

    bus: str | None = None
    """Topic of the bus that carries them; left out, ``can.bus``."""
    front_left: Signal | None = None
    front_right: Signal | None = None
    rear_left: Signal
    rear_right: Signal
    unit: Literal["km/h", "m/s", "mph", "rad/s"] | None = None
    """Overrides the unit of the DBC file, or states it where the file is silent."""
    wheel_radius_m: Positive | None = None
    """Rolling radius, for signals in rad/s."""


class AngleSignal(Section):
    """One signal with an angle or an angular rate, counter-clockwise positive."""

    bus: str | None = None
    """Topic of the bus that carries it; left out, ``can.bus``."""
    signal: Signal
    unit: Literal["deg", "rad", "deg/s", "rad/s"] | None = None
    sign: Literal[1, -1] = 1


class Can(Section):
    """The bus with the car's own signals and how to decode it."""

    bus: str | None = None
    """Topic of the bus; may be left out where the log has only one. A section may name another."""
    dbc: tuple[str, ...] = ()
    """Files, relative to the vehicle file's folder."""
    wheel_speeds: WheelSpeeds | None = None
    yaw_rate: AngleSignal | None = None
    steering: AngleSignal | None = None


class Mobileye(Section):
    """The Mobileye's bus, protocol and mounting."""

    bus: str | None = None
    """Topic of its bus; left out, no Mobileye is read from CAN."""
    revision: Literal["auto", "classic", "2.32"] = "auto"
    family: Literal["auto", "extended", "tsr"] = "auto"
    """Which of the two meanings message 0x700 has."""
    slots: Literal[10, 13] = 13
    x_m: Finite | None = None
    """Reference point ahead of the rear axle; must be measured, so it has no default."""
    y_m: Finite = 0.0
    yaw_rad: Finite = 0.0


class Compass(Section):
    """From a magnetometer's reading to a heading; ``crosscue fit compass`` writes this section."""

    use: bool = True
    mounting_rotation: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Turns the sensor's axes into forward, left, up."""
    mounting_yaw_rad: Finite = 0.0
    hard_iron_t: Vector = (0.0, 0.0, 0.0)
    soft_iron: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    declination_rad: Finite = 0.0
    """East positive."""
    heading_sd_rad: Positive = 15.0 * DEGREE
    interval_m: NotNegative = 1.0
    """A reading counts once the car has gone this far since the last that counted."""
    interval_s: NotNegative = 2.0
    """And this long: twice the time over which the compass's error persists."""
    gate_nis: Positive | None = 10.8
    """Refuse readings whose normalised innovation squared is larger."""


class Camera(Section):
    """Pinhole camera and where it sits."""

    x_m: Finite = 0.0
    """Ahead of the rear axle."""
    y_m: Finite = 0.0
    z_m: Finite = 1.2
    focal_px: Positive | None = None
    center_px: tuple[Finite, Finite] | None = None
    roll_rad: Finite = 0.0
    """How far it is turned about its axis: its right side down is positive."""
    pitch_rad: Finite = 0.0
    """How far its axis points below the horizon."""
    yaw_rad: Finite = 0.0
    """How far its axis points to the left; ``crosscue fit odometry`` finds it where the truth is
    the camera's track."""
    pitch_sd_rad: NotNegative = 0.01
    """How far that is off in a frame: a car pitches by some half a degree as it brakes."""
    depth_bits: Annotated[int, Field(ge=8, le=16)] = 16
    """How many bits of a 16-bit picture are in use; 12 for many cameras."""


class Regions(Section):
    """Where to look for road (eq. 13): in the picture, as published, or on the ground."""

    kind: Literal["picture", "ground"] | None = None
    """``picture``: the polygons below. ``ground``: rectangles on the road, anchored to the believed
    intersection; needs ``camera.focal_px``, ``z_m`` and a range. Left out: ``ground``, but
    ``picture`` in a simulated car's file and where a polygon is given."""
    left: Polygon = ((0.0, 0.55), (0.2, 0.55), (0.2, 0.7), (0.0, 0.7))
    """Polygons of (x, y) in fractions of the picture's width and height."""
    straight: Polygon = ((0.44, 0.52), (0.56, 0.52), (0.6, 0.62), (0.4, 0.62))
    right: Polygon = ((0.8, 0.55), (1.0, 0.55), (1.0, 0.7), (0.8, 0.7))
    aside_m: tuple[Positive, Positive] = (12.0, 20.0)
    """On the ground: lateral span in which side roads are searched, beyond three lanes beside the
    ego lane and no farther than a camera sees nearby."""
    beyond_m: tuple[Positive, Positive] = (6.0, 26.0)
    """On the ground: span beyond the intersection's end in which the road ahead is searched."""
    half_width_m: Positive = 2.0
    """Half the width of that region, centered on the ego vehicle's path."""
    min_rows: Positive = 6.0
    """A region that spans fewer rows of the segmentation is not seen: where a road ends, the
    embedded network's mask runs on for up to five."""

    @model_validator(mode="after")
    def _near_before_far(self) -> Self:
        for name in ("aside_m", "beyond_m"):
            near_m, far_m = getattr(self, name)
            if near_m >= far_m:
                raise PydanticCustomError("regions", f"{name}: expected the nearer end first")
        return self


class OwnCue(Section):
    """A cue of your own: it counts detections with one of these labels and a higher score."""

    labels: Annotated[tuple[str, ...], Field(min_length=1)]
    score: Proportion = 0.5


SIMULATED_CAR: Final = "crosscue simulated car"
"""Name in the vehicle files that ``simulate`` writes; with it the published belief is the default.

That a log is simulated is known from the file beside it, see ``crosscue.replay.files.made_of``."""


class Cues(Section):
    """When a detection is a cue."""

    stop_sign_labels: tuple[str, ...] = ("stop sign",)
    stop_sign_score: Proportion | None = None
    """Only higher scores count. Left out: the detector's own threshold, which ``crosscue fit
    detector`` writes into its card, or 0.5; the source's network has the source's 0.9."""
    traffic_light_labels: tuple[str, ...] = ("traffic light",)
    traffic_light_score: Proportion | None = None
    """As ``stop_sign_score``."""
    road_fraction: Proportion = 0.2
    """More road than this in a region is a cue (eq. 14)."""
    own: dict[Name, OwnCue] = Field(default_factory=dict)
    """By name; what each says about an intersection is declared under [fusion.cues]."""

    @field_validator("own")
    @classmethod
    def _new_names(cls, own: dict[str, OwnCue]) -> dict[str, OwnCue]:
        for name in own:
            if name in CUES:
                raise ValueError(f"{name}: a cue of this name is there already; choose another")
        return own


class Cars(Section):
    """Crossing and parked cars: shape, association and motion (eq. 15, 16)."""

    kind: Literal["pairs", "tracks"] | None = None
    """``pairs``: motion in the picture between two frames, as published. ``tracks``: motion on the
    road over three frames and more, the ego vehicle's taken out; needs ``camera.focal_px`` and
    odometry. Left out: ``pairs`` in a simulated car's file, ``tracks`` in every other."""
    labels: tuple[str, ...] = ("car",)
    score: Proportion | None = None
    """As ``cues.stop_sign_score``; the source's network has the source's 0.95."""
    length_per_height: Positive = 2.0
    """Only cars seen from the side: min ratio of their length to their height."""
    area_change: Proportion = 0.03
    """The same car in two frames: mask areas differ by less."""
    position_change: Proportion = 0.05
    """And positions by less than this fraction of the picture's width."""
    still_change: Proportion = 0.002
    """A car that moved by less than this fraction of the width, both ways, stood."""
    slope: NotNegative = 0.25
    """Horizontal motion: max vertical pixels per horizontal pixel."""
    max_gap_s: Positive = 0.5
    """Frames further apart are not compared."""
    min_frames: Annotated[int, Field(ge=3)] = 3
    """With ``kind = "tracks"``: min number of frames with a car before it is judged."""
    max_frames: Annotated[int, Field(ge=3, le=100)] = 10
    """Number of most recent frames by which it is judged."""
    parked_frames: Annotated[int, Field(ge=3, le=100)] = 15
    """The same for a parked one: it takes longer to be sure that a car stands."""
    within_m: Positive = 100.0
    """Cars farther away, by their height, are not judged; nearer ones are judged where their motion
    is certain."""
    crossing_mps: Positive = 2.0
    """A car that crosses moves sideways by more; a parked one surely moves by less. One past the
    intersection comes or goes by more."""
    past_within_m: Positive = 120.0
    """Oncoming and outgoing cars past the intersection: max distance ahead, by their height."""
    past_aside_m: Positive = 12.0
    """Max distance of these cars to either side of the ego path: three lanes beside its own."""
    past_frames: Annotated[int, Field(ge=3, le=100)] = 30
    """Number of most recent frames by which these cars are judged."""


class RangeCurve(Section):
    """From an object's height in pixels to its range; ``crosscue fit ranges`` writes it."""

    family: Literal["pinhole", "pinhole-offset", "power"] = "pinhole"
    parameters: tuple[Finite, ...]
    residual_sd_m: Positive


class Ranges(Section):
    """Where ranges to an intersection come from, and a curve for each kind of object."""

    kind: Literal["curve", "motion"] | None = None
    """``curve``: the curves below, and no range without one. ``motion``: range and true height
    together, from how an object grows as the car moves; needs ``camera.focal_px``. Left out: a
    curve where one is given, else motion where ``camera.focal_px`` is."""
    stop_sign: RangeCurve | None = None
    traffic_light: RangeCurve | None = None
    light_setback_m: Finite = 3.0
    """With ``motion``: distance from the intersection's end to the lights that face the ego vehicle
    from the far corners, and from lights seen from behind to its start; a fitted curve includes
    it."""
    light_setback_sd_m: NotNegative = 2.0
    """Standard deviation of that distance from one intersection to another."""


class DetectorSection(Section):
    """A detector under a name of your choice."""

    kind: str = "model"
    """A detector's name, or ``module:factory``."""
    card: str | None = None
    """Model card, relative to the vehicle file's folder."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """For its factory, checked by it."""


class Landmarks(Section):
    """Camera pictures against a landmark database; ``crosscue fit landmarks`` writes min_score."""

    matcher: str = "orb"
    """``orb``, ``orb-essential``, or your own ``module:factory``."""
    min_score: NotNegative = 20.0
    """Matches with a lower score are ignored."""
    sigmas: Annotated[float, Field(gt=0.0, le=4.0)] = 2.0
    """Compare with landmarks inside this many standard deviations of the position."""
    max_candidates: Annotated[int, Field(ge=1)] = 50
    gate_nis: Positive | None = 13.8
    """Refuse matches whose normalised innovation squared is larger (as for one correct match in a
    thousand)."""
    interval_m: NotNegative = 1.0
    """Compare again once the car has travelled this far ..."""
    interval_s: NotNegative = 0.1
    """... and this much time has passed."""
    revisit_m: NotNegative = 100.0
    """A landmark is used again once the car has travelled this far, since its error repeats."""


class Vehicle(Section):
    """A whole vehicle file."""

    version: Literal[1]
    name: str = "unnamed"
    topics: Topics = Topics()
    can: Can = Can()
    mobileye: Mobileye = Mobileye()
    odometry: Odometry = Odometry()
    time: Time = Time()
    compass: Compass = Compass()
    gnss: Gnss = Gnss()
    start: Start = Start()
    camera: Camera = Camera()
    landmarks: Landmarks = Landmarks()
    regions: Annotated[Regions, Field(validate_default=True)] = Regions()
    cues: Cues = Cues()
    cars: Annotated[Cars, Field(validate_default=True)] = Cars()
    ranges: Ranges = Ranges()
    range_filter: RangeFilter = RangeFilter()
    past: Past = Past()
    fusion: Annotated[Fusion, Field(validate_default=True)] = Fusion()
    detectors: dict[str, DetectorSection] = Field(default_factory=dict)
    lost_above_m: Positive = 100.0
    """The pose counts as lost while the 2-sigma ellipse's full major axis exceeds this."""

    @field_validator("regions")
    @classmethod
    def _kind_of_regions(cls, regions: Regions, info: ValidationInfo) -> Regions:
        if regions.kind is not None:
            return regions
        is_drawn = not regions.model_fields_set.isdisjoint(("left", "straight", "right"))
        kind = "picture" if is_drawn or _is_simulated(info) else "ground"
        return regions.model_copy(update={"kind": kind})

    @field_validator("cars")
    @classmethod
    def _kind_of_cars(cls, cars: Cars, info: ValidationInfo) -> Cars:
        if cars.kind is not None:
            return cars
        return cars.model_copy(update={"kind": "pairs" if _is_simulated(info) else "tracks"})

    @field_validator("fusion")
    @classmethod
    def _kind_of_belief(cls, fusion: Fusion, info: ValidationInfo) -> Fusion:
        if fusion.kind is not None:
            return fusion
        return fusion.model_copy(update={"kind": "source" if _is_simulated(info) else "persistent"})

    @field_validator("ranges")
    @classmethod
    def _focal_length(cls, ranges: Ranges, info: ValidationInfo) -> Ranges:
        camera = info.data.get("camera")
        if ranges.kind == "motion" and camera is not None and camera.focal_px is None:
            raise PydanticCustomError("ranges", 'kind = "motion" needs camera.focal_px')
        return ranges

    def labels_of(self, cue: CueSpec) -> tuple[str, ...]:
        """Labels of the things that a cue is made of; none for road and Mobileye."""
        if cue.observed_by == "car pairs":
            return self.cars.labels
        if cue.settings is not None:
            labels: tuple[str, ...] = getattr(self.cues, f"{cue.settings}_labels")
            return labels
        return () if cue.label is None else SAME_SIGN.get(cue.label, (cue.label,))

    def threshold_of(self, cue: CueSpec) -> tuple[str | None, float | None]:
        """Where a cue's min score is set in the file, and the score if one is set there.

        Without a place every score counts; without a score the detector's threshold holds.
        """
        if cue.settings is None:
            return None, None
        name = f"{cue.settings}_score"
        score: float | None = getattr(self.cues, name)
        return f"[cues] {name}", score

    def cue_labels(self) -> dict[str, tuple[str, ...]]:
        """From every cue, a user's own among them, to its labels; none for road."""
        own = {name: one.labels for name, one in self.cues.own.items()}
        return {name: self.labels_of(cue) for name, cue in CUES.items()} | own

    @property
    def counts_any_label(self) -> bool:
        """Whether a cue of objects names no label, as a plug-in's may: its rule reads any."""
        return any(
            cue.observed_by == "objects" and not self.labels_of(cue) for cue in CUES.values()
        )


def _is_simulated(info: ValidationInfo) -> bool:
    """Is it the file of a simulated car, whose defaults are as published?"""
    return bool(info.data.get("name") == SIMULATED_CAR)


def load(path: Path) -> Vehicle:
    """Read and check a vehicle file.

    Raises:
        VehicleError: Not there, not TOML, or a key or value that does not fit; with the line.
    """
    try:
        content = read_at_most(path, MAX_BYTES)
        if content is None:
            raise VehicleError(f"{path}: over {MAX_BYTES // MIB} MiB; this is not a vehicle file")
        text = content.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise VehicleError(f"{path}: {why}; make one with: crosscue vehicle init LOG") from None
    vehicle = parse(text, str(path))
    can = vehicle.can
    files = tuple(str((path.parent / name).resolve()) for name in can.dbc)
    detectors = {
        name: section
        if section.card is None
        else section.model_copy(update={"card": str((path.parent / section.card).resolve())})
        for name, section in vehicle.detectors.items()
    }
    changed = {"can": can.model_copy(update={"dbc": files}), "detectors": detectors}
    return vehicle.model_copy(update=changed)


def vehicle_given(given: Vehicle | Path | str | None) -> Vehicle:
    """Settings as they are, or of a file; the defaults for None."""
    if given is None:
        return Vehicle(version=1)
    return given if isinstance(given, Vehicle) else load(Path(given))


def parse(text: str, where: str) -> Vehicle:
    """Check the text of a vehicle file; ``where`` names it in errors.

    Raises:
        VehicleError: As in ``load``.
    """
    try:
        tree = toml_tree(text)
    except ValueError as error:
        raise VehicleError(f"{where}: not TOML: {error}; correct that line") from None
    try:
        return Vehicle.model_validate(tuples(tree))
    except ValidationError as error:
        raise VehicleError(explain(error, text, where, Vehicle)) from None
