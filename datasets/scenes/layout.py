"""Layouts of intersections: the eight of Table 6, and any number of others from seeds.

Layouts ``M`` are mixed: thirteen kinds in turn, five of which are not intersections, so that every
feature of an intersection has positives and negatives in any thirteen consecutive layouts.

Local frame: x ahead along the approach road, y to the left. The origin is on the centre line of the
approach road at the start of the intersection (stop line, and stop sign if any). The near kerb of
the crossroad is at ``NEAR_KERB_M``; the intersection ends at ``end_m``, where traffic lights hang.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

import numpy as np

from crosscue.replay.columns import Floats

Control = Literal["stop_sign", "traffic_light", "none"]
Kind = Literal[
    "crossing", "light", "open", "t_both", "t_left", "t_right",
    "one_way", "one_way_t", "straight", "bend", "driveways", "lot", "curve",
]  # fmt: skip
Side = Literal["left", "right"]

NEAR_KERB_M: Final = 4.5
PARKING_LANE_M: Final = 2.05
CURVE_FROM_M: Final = -45.0
CURVE_SLOPE: Final = 0.35
SCORED: Final = "ABCDEFGH"


@dataclass(frozen=True, slots=True)
class Layout:
    """Properties of an intersection that are constant in all runs.

    Attributes:
        name: Letter of Table 6, or ``L`` or ``M`` and the layout's seed.
        seed: Seed of random buildings and plants.
        control: Traffic control of the approach road.
        has_left: True if there is a road to the left; likewise ``has_right`` and ``has_ahead``.
        one_way: Direction of the crossroad's traffic, if it is one-way with a sign.
        do_not_enter: True if signs forbid the road ahead, or entering the one-way street.
        ahead_is_closed: True if the road ahead has only oncoming traffic.
        half_width_m: Half the width of the approach road, from kerb to centre line.
        cross_width_m: Width of the crossroad, from kerb to kerb.
        cross_traffic: Cars per minute and direction on the crossroad, at usual traffic.
        parked_cross: Approximate number of cars parked on each side of the crossroad.
        parked_past: Approximate number of cars parked along the road past the intersection.
        vegetation: True if bushes and branches hide signs and roads.
        is_town: True for shops, False for houses.
        has_lot: True if there is a parking lot next to the approach road.
        curve_per_m: Curvature of a gentle curve of the approach road, positive to the left.
        traffic: Side of the road on which traffic drives.
    """

    name: str
    seed: int
    control: Control = "stop_sign"
    has_left: bool = True
    has_right: bool = True
    has_ahead: bool = True
    one_way: Side | None = None
    do_not_enter: bool = False
    ahead_is_closed: bool = False
    half_width_m: float = 5.0
    cross_width_m: float = 10.0
    cross_traffic: float = 4.0
    parked_cross: int = 0
    parked_past: int = 0
    vegetation: bool = False
    is_town: bool = False
    has_lot: bool = True
    curve_per_m: float = 0.0
    traffic: Side = "right"

    @property
    def own(self) -> float:
        """Sign of y on the ego vehicle's half of the road."""
        return 1.0 if self.traffic == "left" else -1.0

    def aside_m(self, x_m: Floats) -> Floats:
        """Return the lateral position of the road's centre line, to the left of the x axis.

        It is a parabola from ``CURVE_FROM_M`` to a slope of ``CURVE_SLOPE``, and a straight line
        from there.
        """
        if self.curve_per_m == 0.0:
            return np.zeros_like(x_m)
        into_m = np.maximum(x_m - CURVE_FROM_M, 0.0)
        bends_m = np.minimum(into_m, CURVE_SLOPE / abs(self.curve_per_m))
        return np.asarray(self.curve_per_m * bends_m * (into_m - bends_m / 2.0))

    @property
    def is_intersection(self) -> bool:
        """True if more than one road continues; otherwise the road is straight or bends."""
        return self.has_left + self.has_right + self.has_ahead > 1

    @property
    def features(self) -> dict[str, bool]:
        """Return the true features of the layout, where known.

        Without an intersection, turning is impossible. A road that merely continues is not a choice
        of direction, so straight is omitted, and so is the side to which a road bends.
        """
        if self.is_intersection:
            ways = {"left": self.goes_left, "right": self.goes_right, "straight": self.goes_ahead}
            return {"intersection": True, **ways}
        sides = {"left": self.has_left, "right": self.has_right}
        return {
            "intersection": False,
            **{name: False for name, bends in sides.items() if not bends},
        }

    @property
    def has_parking_lane(self) -> bool:
        """True if there is room to park, marked by a white line."""
        return self.half_width_m > 4.6

    @property
    def far_kerb_m(self) -> float:
        """Position of the crossroad's far kerb."""
        return NEAR_KERB_M + self.cross_width_m

    @property
    def end_m(self) -> float:
        """Position of the end of the intersection."""
        return self.far_kerb_m + 1.5

    @property
    def goes_left(self) -> bool:
        """True if turning left is allowed."""
        return self.has_left and self.one_way != "right"

    @property
    def goes_right(self) -> bool:
        """True if turning right is allowed."""
        return self.has_right and self.one_way != "left"

    @property
    def goes_ahead(self) -> bool:
        """True if driving straight is allowed."""
        return self.has_ahead and not self.ahead_is_closed


TABLE_6: Final = {
    layout.name: layout
    for layout in (
        Layout("A", 101, has_ahead=False, cross_traffic=24.0, is_town=True),
        Layout("B", 102, has_ahead=False, parked_cross=5, cross_width_m=11.0, cross_traffic=3.0,
               half_width_m=4.4),
        Layout("C", 103, parked_past=6, cross_traffic=5.0, half_width_m=5.8),
        Layout("D", 104, cross_traffic=3.0, has_lot=False, half_width_m=4.2, cross_width_m=9.0),
        Layout("E", 105, control="traffic_light", cross_traffic=26.0, parked_cross=1, is_town=True,
               half_width_m=5.6, cross_width_m=12.0, parked_past=1),
        Layout("F", 106, has_ahead=False, one_way="right", do_not_enter=True, cross_traffic=20.0,
               is_town=True, cross_width_m=9.0),
        Layout("G", 107, vegetation=True, cross_traffic=5.0, parked_past=1),
        Layout("H", 108, control="none", cross_traffic=1.0, cross_width_m=9.0,
               half_width_m=4.3),
    )
}  # fmt: skip


def any_layout(seed: int) -> Layout:
    """Return a random intersection that is not in Table 6, for training and variety."""
    rng = np.random.default_rng([seed, 0x1A])
    arms = str(rng.choice(["all", "t", "no_left", "no_right"], p=[0.5, 0.26, 0.12, 0.12]))
    kinds = get_args(Control)
    control: Control = kinds[int(rng.choice(3, p=[0.5, 0.35, 0.15]))]
    one_way = str(rng.choice(["", "left", "right"], p=[0.6, 0.2, 0.2]))
    if arms in ("no_left", "no_right"):
        one_way = ""
    parked = int(rng.choice([0, 0, 2, 4, 6]))
    closed = arms != "t" and not one_way and bool(rng.random() < 0.22)
    return Layout(
        name=f"L{seed}",
        seed=1000 + seed,
        control=control,
        has_left=arms != "no_left",
        has_right=arms != "no_right",
        has_ahead=arms != "t",
        one_way="left" if one_way == "left" else "right" if one_way == "right" else None,
        do_not_enter=closed or bool(arms == "t" and one_way and rng.random() < 0.5),
        ahead_is_closed=closed,
        **_roads(rng, parked),
        vegetation=bool(rng.random() < 0.2),
        is_town=bool(rng.random() < 0.45),
        has_lot=bool(rng.random() < 0.6),
    )


KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
# Missing roads by kind; a bend has exactly one of the sides.
WITHOUT: Final[Mapping[Kind, tuple[str, ...]]] = {
    "t_both": ("ahead",), "t_left": ("right",), "t_right": ("left",), "one_way_t": ("ahead",),
    "straight": ("left", "right"), "driveways": ("left", "right"), "lot": ("left", "right"),
    "curve": ("left", "right"),
}  # fmt: skip


# Possible traffic controls by kind.
CONTROLS: Final[Mapping[Kind, tuple[Control, ...]]] = {
    "crossing": ("stop_sign",), "light": ("traffic_light",), "open": ("none",),
    "t_both": ("stop_sign", "stop_sign", "none"), "t_left": ("stop_sign", "stop_sign", "none"),
    "t_right": ("stop_sign", "stop_sign", "none"), "one_way": ("stop_sign", "traffic_light"),
    "one_way_t": ("stop_sign",), "straight": ("none",), "bend": ("none",), "driveways": ("none",),
    "lot": ("none",), "curve": ("none",),
}  # fmt: skip


def mixed_kind(seed: int) -> Kind:
    """Return the kind of layout ``M`` with a seed."""
    return KINDS[seed % len(KINDS)]


def mixed_layout(seed: int) -> Layout:
    """Return an intersection of one of the kinds in turn, or a road without one."""
    rng = np.random.default_rng([seed, 0x4D])
    kind = mixed_kind(seed)
    side: Side = "left" if rng.random() < 0.5 else "right"
    missing = WITHOUT.get(kind, ())
    if kind == "bend":
        missing = ("ahead", "right" if side == "left" else "left")
    controls = CONTROLS[kind]
    control = controls[int(rng.integers(len(controls)))]
    closed = kind in ("crossing", "light") and bool(rng.random() < 0.25)
    parked = int(rng.choice([0, 0, 2, 4, 6])) if len(missing) < 2 else 0
    return Layout(
        name=f"M{seed}",
        seed=5000 + seed,
        control=control,
        has_left="left" not in missing,
        has_right="right" not in missing,
        has_ahead="ahead" not in missing,
        one_way=side if kind.startswith("one_way") else None,
        do_not_enter=closed or (kind == "one_way_t" and bool(rng.random() < 0.5)),
        ahead_is_closed=closed,
        **_roads(rng, parked),
        vegetation=bool(rng.random() < 0.15),
        # Only houses have driveways.
        is_town=kind not in ("driveways", "lot") and bool(rng.random() < 0.5),
        has_lot=kind == "lot" or (kind not in ("straight", "curve") and bool(rng.random() < 0.3)),
        curve_per_m=_curve(rng, side) if kind == "curve" else 0.0,
    )


def _curve(rng: np.random.Generator, side: Side) -> float:
    return (1.0 if side == "left" else -1.0) / float(rng.uniform(130.0, 250.0))


def _roads(rng: np.random.Generator, parked: int) -> dict[str, Any]:
    """Draw the widths of both roads, and their traffic."""
    return {
        "half_width_m": float(rng.uniform(4.2, 6.4)),
        "cross_width_m": float(rng.uniform(11.0 if parked else 8.0, 13.0)),
        "cross_traffic": float(rng.choice([1.0, 5.0, 12.0, 26.0])),
        "parked_cross": parked,
        "parked_past": int(rng.choice([0, 0, 2, 5])),
    }


def layout_named(name: str) -> Layout:
    """Return the layout named ``A`` to ``H``, or ``L`` or ``M`` with a seed.

    Raises:
        ValueError: There is no such layout.
    """
    if name in TABLE_6:
        return TABLE_6[name]
    makers = {"L": any_layout, "M": mixed_layout}
    if name[:1] in makers and name[1:].isdecimal() and len(name) < 11:
        return makers[name[:1]](int(name[1:]))
    raise ValueError(
        f"{name!r} is not a layout; there are: A to H, and L0, L1, ..., M0, M1, ... from seeds"
    )
