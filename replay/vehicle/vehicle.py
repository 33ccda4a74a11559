"""The vehicle file: roles of topics, mounting and noise of sensors, and settings of estimators.

The file is TOML with a version, and is validated with pydantic. For unknown keys, wrong units and
missing roles, the error names the line in the file and a suggestion. The unit (SI) is the last part
of every name. Frames follow ISO 8855 / REP-103: x forward, y left, heading counter-clockwise. Every
default is written to the manifest.

This module also exports the table of cues that the file is checked against.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from crosscue.replay.errors import VehicleError
from crosscue.replay.files.bounded import read_text
from crosscue.replay.files.tree_text import unspelled
from crosscue.replay.limits import MIB
from crosscue.replay.time.segments import SplitLimits

from .camera import Camera as Camera
from .cue_spec import CueSpec as CueSpec
from .cue_spec import Input as Input
from .cue_spec import Scoring as Scoring
from .cue_table import BUILTIN_CUES as BUILTIN_CUES
from .cue_table import CUES as CUES
from .cue_table import SAME_SIGN
from .cue_table import STOP_SIGN as STOP_SIGN
from .cue_table import TRAFFIC_LIGHT as TRAFFIC_LIGHT
from .fusion import Fusion, RangeFilter
from .mobileye_cues import Past
from .pose import DEGREE, Gnss, Odometry, Start
from .section import Finite, Name, NotNegative, Positive, Section
from .validation_errors import parse_model

_SPLIT = SplitLimits()


class Time(Section):
    """Division of a drive into time segments, and treatment of the gaps between them."""

    max_silence_s: Positive = _SPLIT.max_silence_s
    """A longer gap in the wheel speeds starts a new segment."""
    restart_after_s: NotNegative = 5.0
    """After a longer gap, or after a clock is set back, the range filter and the belief restart."""
    unknown_gap_s: Positive = _SPLIT.unknown_gap_s
    """Assumed gap where a clock was set back, because its true length is unknown."""
    max_accel_mps2: NotNegative = 4.0
    """Maximum acceleration of the vehicle during a gap."""
    max_turn_rate_radps: NotNegative = 0.5
    """Maximum turn rate of the vehicle during a gap."""
    max_speed_mps: Positive = 60.0
    """Maximum speed of the vehicle during a gap."""

    @property
    def split(self) -> SplitLimits:
        """Limits at which a drive is split."""
        return SplitLimits(self.max_silence_s, self.unknown_gap_s)


VERSION: Final = 1
MAX_BYTES: Final = 1 * MIB

Vector = tuple[Finite, Finite, Finite]
Matrix = tuple[Vector, Vector, Vector]
Proportion = Annotated[float, Field(ge=0.0, le=1.0)]
Polygon = Annotated[tuple[tuple[Proportion, Proportion], ...], Field(min_length=3)]
# ``MESSAGE.SIGNAL``, spelled as in the DBC file.
Signal = Annotated[str, Field(pattern=r"^[^.\s]+\.[^.\s]+$")]


class Topics(Section):
    """Topics by role; an omitted role is filled by the only topic of a matching type."""

    camera: str | None = None
    imu: str | None = None
    magnetometer: str | None = None
    heading: str | None = None
    """Topic with a column ``heading_rad``, or an inertial unit with a reliable orientation."""
    gnss: str | None = None
    odometry: str | None = None


class WheelSpeeds(Section):
    """Signals with the speed of each wheel; the two rear wheels are sufficient."""

    bus: str | None = None
    """Topic of the bus that carries them; by default ``can.bus``."""
    front_left: Signal | None = None
    front_right: Signal | None = None
    rear_left: Signal
    rear_right: Signal
    unit: Literal["km/h", "m/s", "mph", "rad/s"] | None = None
    """Unit of the signals; overrides the unit of the DBC file, which may be missing there."""
    wheel_radius_m: Positive | None = None
    """Rolling radius, for signals in rad/s."""


class AngleSignal(Section):
    """A signal with an angle or an angular rate, positive counter-clockwise."""

    bus: str | None = None
    """Topic of the bus that carries it; by default ``can.bus``."""
    signal: Signal
    unit: Literal["deg", "rad", "deg/s", "rad/s"] | None = None
    sign: Literal[1, -1] = 1


class Can(Section):
    """The CAN bus with the vehicle's signals, and the databases that decode it."""

    bus: str | None = None
    """Topic of the bus; optional if the log has only one. Sections may override it."""
    dbc: tuple[str, ...] = ()
    """Paths of the database files, relative to the vehicle file's folder."""
    wheel_speeds: WheelSpeeds | None = None
    yaw_rate: AngleSignal | None = None
    steering: AngleSignal | None = None


class Mobileye(Section):
    """Bus, protocol and mounting of the Mobileye."""

    bus: str | None = None
    """Topic of its bus; if omitted, no Mobileye is read from CAN."""
    revision: Literal["auto", "classic", "2.32"] = "auto"
    family: Literal["auto", "extended", "tsr"] = "auto"
    """Protocol family, which decides the meaning of message 0x700."""
    slots: Literal[10, 13] = 13
    x_m: Finite | None = None
    """Distance of its reference point ahead of the rear axle; must be measured, so no default."""
    y_m: Finite = 0.0
    yaw_rad: Finite = 0.0


class Compass(Section):
    """Conversion of magnetometer readings to a heading; written by ``crosscue fit compass``."""

    use: bool | None = None
    """By default, a magnetometer is used only if this section sets anything. Without calibration,
    its heading can be wrong by any angle."""
    mounting_rotation: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Rotation from the sensor's axes to forward, left, up."""
    mounting_yaw_rad: Finite = 0.0
    hard_iron_t: Vector = (0.0, 0.0, 0.0)
    soft_iron: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    declination_rad: Finite = 0.0
    """Magnetic declination, positive to the east."""
    heading_sd_rad: Positive = 15.0 * DEGREE
    interval_m: NotNegative = 1.0
    """Minimum distance travelled between two readings that are used."""
    interval_s: NotNegative = 2.0
    """Minimum time between two readings that are used: twice the correlation time of the error."""
    gate_nis: Positive | None = 10.8
    """Readings with a larger normalised innovation squared are rejected."""

    @property
    def uses_magnetometer(self) -> bool:
        """True if readings of the magnetic field become headings."""
        return self != Compass() if self.use is None else self.use


class Regions(Section):
    """Where road is searched: in regions of the image (eq. 13), as published, or on the ground."""

    kind: Literal["picture", "area"] | None = None
    """``picture``: the polygons below. ``area``: roads by the shape of the mask; with
    ``camera.focal_px``, ``z_m`` and motion, openings of the road accumulated on the ground along
    the path also give ranges. Default: ``area``, but ``picture`` in a simulated vehicle's file and
    where a polygon is specified."""
    left: Polygon = ((0.0, 0.55), (0.2, 0.55), (0.2, 0.7), (0.0, 0.7))
    """Polygon of (x, y) in fractions of the image's width and height; likewise the other two."""
    straight: Polygon = ((0.44, 0.52), (0.56, 0.52), (0.6, 0.62), (0.4, 0.62))
    right: Polygon = ((0.8, 0.55), (1.0, 0.55), (1.0, 0.7), (0.8, 0.7))

    def polygons(self) -> tuple[Polygon, Polygon, Polygon]:
        """Return the polygons of the image, from left to right."""
        return self.left, self.straight, self.right


class OwnCue(Section):
    """A user-defined cue: it counts detections with one of these labels and a higher score."""

    labels: Annotated[tuple[str, ...], Field(min_length=1)]
    score: Proportion = 0.5


# Name in the vehicle files that ``simulate`` writes; it makes the published belief the default.
# Whether a log is simulated is recorded in a file next to it, see
# ``crosscue.replay.files.made_of``.
SIMULATED_CAR: Final = "crosscue simulated car"


class Cues(Section):
    """Conditions under which a detection is a cue."""

    kind: Literal["frames", "tracks"] | None = None
    """Rule for stop signs and traffic lights. ``frames``: a score above the threshold, in every
    frame by itself, as published. ``tracks``: the evidence of all frames so far, from weak
    detections on, with a second look at stop signs. Default: ``frames`` in a simulated vehicle's
    file and where one of their scores is specified, else ``tracks``."""
    stop_sign_labels: tuple[str, ...] = ("stop sign",)
    stop_sign_score: Proportion | None = None
    """Minimum score. Default: the threshold in the detector's model card, which ``crosscue fit
    detector`` writes, or 0.5. The source's network uses the source's 0.9."""
    traffic_light_labels: tuple[str, ...] = ("traffic light",)
    traffic_light_score: Proportion | None = None
    """Minimum score, with the same default as ``stop_sign_score``."""
    road_fraction: Proportion = 0.2
    """Minimum fraction of road in a region that is a cue (eq. 14)."""
    own: dict[Name, OwnCue] = Field(default_factory=dict)
    """User-defined cues by name; [fusion.cues] declares the features that they support."""

    @field_validator("own")
    @classmethod
    def _new_names(cls, own: dict[str, OwnCue]) -> dict[str, OwnCue]:
        for name in own:
            if name in CUES:
                raise ValueError(f"{name}: a cue of this name already exists; choose another")
        return own


class Cars(Section):
    """Crossing and parked cars: shape, association and motion (eq. 15, 16)."""

    kind: Literal["pairs", "tracks"] | None = None
    """``pairs``: motion in the image between two frames, as published. ``tracks``: motion on the
    road over three or more frames, compensated for ego motion; needs ``camera.focal_px`` and
    odometry. Default: ``pairs`` in a simulated vehicle's file, else ``tracks``."""
    labels: tuple[str, ...] = ("car",)
    score: Proportion | None = None
    """Minimum score, with the same default as ``cues.stop_sign_score``; the source's network uses
    the source's 0.95."""
    length_per_height: Positive = 2.0
    """Minimum ratio of length to height, which selects cars seen from the side."""
    area_change: Proportion = 0.03
    """Maximum relative change of the mask area between two detections of the same car."""
    position_change: Proportion = 0.05
    """Maximum change of position between them, as a fraction of the image width."""
    still_change: Proportion = 0.002
    """Maximum motion of a stationary car on either axis, as a fraction of the image width."""
    slope: NotNegative = 0.25
    """Maximum slope of horizontal motion: vertical pixels per horizontal pixel."""
    max_gap_s: Positive = 0.5
    """Maximum time between two frames that are compared."""
    min_frames: Annotated[int, Field(ge=3)] = 3
    """With ``kind = "tracks"``: minimum number of frames with a car before it is classified."""
    max_frames: Annotated[int, Field(ge=3, le=100)] = 10
    """Number of most recent frames used to classify a car."""
    parked_frames: Annotated[int, Field(ge=3, le=100)] = 15
    """Number of most recent frames used to classify a parked car, which takes longer."""
    within_m: Positive = 100.0
    """Maximum distance, derived from a car's height, of the cars that are classified."""
    crossing_mps: Positive = 2.0
    """Minimum lateral speed of a crossing car, and maximum speed of a parked car. Also the minimum
    longitudinal speed of an oncoming or outgoing car past the intersection."""
    past_within_m: Positive | None = None
    """Maximum distance, derived from their height, of oncoming and outgoing cars past the
    intersection. If left out: 120 m, or the distance at which a car is 15 px high where that is
    greater."""
    past_aside_m: Positive = 12.0
    """Maximum lateral distance of these cars from the ego path, about three lanes."""
    leg_traffic: bool = False
    """With ``kind = "tracks"``: cars that move in a leg of the intersection, further aside than
    ``past_aside_m``, support that leg. Off, because no real drive here has a case for it."""
    past_frames: Annotated[int, Field(ge=3, le=100)] = 30
    """Number of most recent frames used to classify these cars."""


class RangeCurve(Section):
    """Range curve over an object's height in pixels; written by ``crosscue fit ranges``."""

    family: Literal["pinhole", "pinhole-offset", "power"] = "pinhole"
    parameters: tuple[Finite, ...]
    residual_sd_m: Positive


class Ranges(Section):
    """Source of the ranges to an intersection, with a curve for each kind of object."""

    kind: Literal["curve", "motion"] | None = None
    """``curve``: the curves below; objects without a curve have no range. ``motion``: joint
    estimate of range and true height from an object's growth in the image as the vehicle moves;
    needs ``camera.focal_px``. Default: ``curve`` where one is specified, else ``motion`` where
    ``camera.focal_px`` is."""
    stop_sign: RangeCurve | None = None
    traffic_light: RangeCurve | None = None
    light_setback_m: Finite = 3.0
    """With ``motion``: distance from the intersection's end to the lights at the far corners, which
    face the ego vehicle, and from lights seen from behind to the intersection's start. A fitted
    curve includes it."""
    light_setback_sd_m: NotNegative = 2.0
    """Standard deviation of that distance between intersections."""


class DetectorSection(Section):
    """A detector with a user-defined name."""

    kind: str = "model"
    """Name of the detector, or ``module:factory``."""
    card: str | None = None
    """Path of the model card, relative to the vehicle file's folder."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings for the detector's factory, which validates them."""


class Landmarks(Section):
    """Matching of images with landmarks; ``crosscue fit landmarks`` writes ``min_score``."""

    matcher: str = "orb"
    """``orb``, or a user-defined ``module:factory``."""
    min_score: NotNegative = 20.0
    """Matches with a lower score are ignored."""
    sigmas: Annotated[float, Field(gt=0.0, le=4.0)] = 2.0
    """Size of the search region around the position, in standard deviations."""
    max_candidates: Annotated[int, Field(ge=1)] = 50
    gate_nis: Positive | None = 13.8
    """Matches with a larger normalised innovation squared are rejected (one correct match in a
    thousand exceeds the default)."""
    interval_m: NotNegative = 1.0
    """Minimum distance travelled between two comparisons."""
    interval_s: NotNegative = 0.1
    """Minimum time between two comparisons."""
    revisit_m: NotNegative = 100.0
    """Minimum distance travelled between two uses of a landmark, because its error repeats."""


class Vehicle(Section):
    """A complete vehicle file."""

    version: Literal[1]
    """Version of the file's format."""
    name: str = "unnamed"
    """Name of the car, for reports."""
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
    cues: Annotated[Cues, Field(validate_default=True)] = Cues()
    cars: Annotated[Cars, Field(validate_default=True)] = Cars()
    ranges: Ranges = Ranges()
    range_filter: RangeFilter = RangeFilter()
    past: Past = Past()
    fusion: Annotated[Fusion, Field(validate_default=True)] = Fusion()
    detectors: dict[str, DetectorSection] = Field(default_factory=dict)
    """Settings of each detector, by its name."""
    road_map: str | None = None
    """OpenStreetMap extract or Lanelet2 map, .osm, for the cues ``map_left``, ``map_straight`` and
    ``map_right``; it needs ``start.map_origin`` or GNSS. By default there is no map."""
    lost_above_m: Positive = 100.0
    """Maximum full major axis of the 2-sigma ellipse; above it, the pose is reported as lost."""

    @field_validator("regions")
    @classmethod
    def _kind_of_regions(cls, regions: Regions, info: ValidationInfo) -> Regions:
        if regions.kind is not None:
            return regions
        is_drawn = not regions.model_fields_set.isdisjoint(("left", "straight", "right"))
        kind = "picture" if is_drawn or _is_simulated(info) else "area"
        return regions.model_copy(update={"kind": kind})

    @field_validator("cues")
    @classmethod
    def _kind_of_cues(cls, cues: Cues, info: ValidationInfo) -> Cues:
        if cues.kind is not None:
            return cues
        has_score = not (cues.stop_sign_score is None and cues.traffic_light_score is None)
        kind = "frames" if has_score or _is_simulated(info) else "tracks"
        return cues.model_copy(update={"kind": kind})

    @field_validator("cars")
    @classmethod
    def _kind_of_cars(cls, cars: Cars, info: ValidationInfo) -> Cars:
        if cars.kind is not None:
            return cars
        return cars.model_copy(update={"kind": "pairs" if _is_simulated(info) else "tracks"})

    @field_validator("fusion")
    @classmethod
    def _kind_of_belief(cls, fusion: Fusion, info: ValidationInfo) -> Fusion:
        if fusion.kind is None:
            kind = "source" if _is_simulated(info) else "persistent"
            fusion = fusion.model_copy(update={"kind": kind})
        regions = info.data.get("regions")
        if fusion.kind == "persistent" and regions is not None and regions.kind == "area":
            return fusion.with_openings()
        return fusion

    @field_validator("ranges")
    @classmethod
    def _focal_length(cls, ranges: Ranges, info: ValidationInfo) -> Ranges:
        camera = info.data.get("camera")
        if ranges.kind == "motion" and camera is not None and camera.focal_px is None:
            raise PydanticCustomError("ranges", 'kind = "motion" needs camera.focal_px')
        return ranges

    def labels_of(self, cue: CueSpec) -> tuple[str, ...]:
        """Return the detector labels that a cue counts; empty for road and Mobileye cues."""
        if cue.observed_by == "car pairs":
            return self.cars.labels
        if cue.settings is not None:
            labels: tuple[str, ...] = getattr(self.cues, f"{cue.settings}_labels")
            return labels
        return () if cue.label is None else SAME_SIGN.get(cue.label, (cue.label,))

    def threshold_of(self, cue: CueSpec) -> tuple[str | None, float | None]:
        """Return the key of a cue's minimum score in the file, and the score if it is set.

        Without a key, every score counts. Without a score, the detector's threshold applies.
        """
        if cue.settings is None:
            return None, None
        name = f"{cue.settings}_score"
        score: float | None = getattr(self.cues, name)
        return f"[cues] {name}", score

    def cue_labels(self) -> dict[str, tuple[str, ...]]:
        """Return the labels of every cue, including user-defined cues; empty for road."""
        own = {name: one.labels for name, one in self.cues.own.items()}
        return {name: self.labels_of(cue) for name, cue in CUES.items()} | own

    def with_files(self, named: Callable[[str], str]) -> Self:
        """Return the settings with other names of DBC files, model cards and the map."""
        dbc = tuple(map(named, self.can.dbc))
        detectors = {
            name: section
            if section.card is None
            else section.model_copy(update={"card": named(section.card)})
            for name, section in self.detectors.items()
        }
        can = self.can.model_copy(update={"dbc": dbc})
        road_map = None if self.road_map is None else named(self.road_map)
        changed = {"can": can, "detectors": detectors, "road_map": road_map}
        return self.model_copy(update=changed)

    @property
    def counts_any_label(self) -> bool:
        """Return whether the rule of any object cue reads all labels, as a plug-in's may."""
        return any(
            cue.observed_by == "objects" and not self.labels_of(cue) for cue in CUES.values()
        )


def _is_simulated(info: ValidationInfo) -> bool:
    """Return whether the file belongs to a simulated vehicle, which uses published defaults."""
    return bool(info.data.get("name") == SIMULATED_CAR)


def load(path: Path) -> Vehicle:
    """Read and check a vehicle file.

    Raises:
        VehicleError: The file is missing, not TOML, or has an invalid key or value; the message
            names the line.
    """
    remedy = "make one with: crosscue vehicle init LOG"
    vehicle = parse(read_text(path, MAX_BYTES, VehicleError, remedy), str(path))
    return vehicle.with_files(lambda name: str((path.parent / unspelled(name)).resolve()))


def vehicle_given(given: Vehicle | Path | str | None) -> Vehicle:
    """Return the settings, loaded from a file if a path is passed; the defaults for None."""
    if given is None:
        return Vehicle(version=1)
    return given if isinstance(given, Vehicle) else load(Path(given))


def parse(text: str, where: str) -> Vehicle:
    """Parse and validate the text of a vehicle file; ``where`` names it in errors.

    Raises:
        VehicleError: As for ``load``.
    """
    return parse_model(text, where, Vehicle, VehicleError)
