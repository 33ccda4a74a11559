"""World of one run: static scenery, labelled objects and moving cars."""

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.random import Generator

from crosscue.datasets.scenes.rendering.ground import (
    Ground,
    Patch,
    along_curve,
    cast_shadows,
    paint,
    unpainted,
    with_levels,
)
from crosscue.datasets.scenes.rendering.mesh import Mesh, merge_meshes
from crosscue.datasets.scenes.rendering.scenery import (
    Shadows,
    building,
    bush,
    crown,
    light_head,
    mast,
    post,
    sign_back,
    sign_face,
    tree,
    utility_pole,
    wire,
)
from crosscue.datasets.scenes.rendering.textures import Atlas, make_atlas
from crosscue.datasets.scenes.rendering.weather import Daylight, daylight
from crosscue.replay.columns import Floats

from .cars import Look, any_look, car
from .layout import NEAR_KERB_M, Layout
from .motion import ApproachMotion, Conditions, approach, lane_y_m

Category = Literal[
    "car", "stop_sign", "traffic_light", "one_way_left", "one_way_right", "do_not_enter"
]
CATEGORIES: Final[tuple[Category, ...]] = (
    "car", "stop_sign", "traffic_light", "one_way_left", "one_way_right", "do_not_enter",
)  # fmt: skip
Role = Literal["cross", "parked_cross", "oncoming", "outgoing", "parked_past", "other", "furniture"]
ALWAYS: Final = (-1e9, 1e9)


@dataclass(frozen=True, slots=True, eq=False)
class SceneObject:
    """One labelled object.

    Attributes:
        category: Class of the object.
        role: Role of the object at the intersection.
        mesh: Triangles at time zero; a traffic light is red.
        at: x, y, z of its centre at time zero, local frame.
        heading_rad: Direction of a car, or the viewing direction of a sign's reader.
        size: Length, width and height in metres.
        velocity: Velocity along x and y in metres per second.
        span_s: Interval in which it exists.
        later: Mesh from ``later_s`` on, or None.
        later_s: Start of ``later``.
        curved: Layout whose curve it follows while it moves, or None.
        number: Instance number, which is also its index in ``World.things``.
    """

    category: Category
    role: Role
    mesh: Mesh
    at: tuple[float, float, float]
    heading_rad: float
    size: tuple[float, float, float]
    velocity: tuple[float, float] = (0.0, 0.0)
    span_s: tuple[float, float] = ALWAYS
    later: Mesh | None = None
    later_s: float = 0.0
    curved: Layout | None = None
    number: int = 0

    @property
    def is_fixed(self) -> bool:
        """True if it neither moves nor changes."""
        return self.velocity == (0.0, 0.0) and self.span_s == ALWAYS and self.later is None

    def is_there(self, t_s: float) -> bool:
        """Return whether it exists at this time."""
        return self.span_s[0] <= t_s < self.span_s[1]

    def shift(self, t_s: float) -> Floats:
        """Return the displacement from the mesh's position, shape (3,), in metres."""
        x_m, y_m = self.velocity[0] * t_s, self.velocity[1] * t_s
        if self.curved is not None:
            y_m += float(self.curved.aside_m(np.array(self.at[0] + x_m)))
        return np.array([x_m, y_m, 0.0])

    def mesh_at(self, t_s: float) -> Mesh:
        """Return its mesh at this time."""
        mesh = self.later if self.later is not None and t_s >= self.later_s else self.mesh
        curved = self.curved
        if curved is None:
            return mesh
        # A shear about its centre, which ``shift`` moves, aligns it with the curve.
        moved_m = self.velocity[0] * t_s
        middle_m = curved.aside_m(np.array(self.at[0] + moved_m))
        return mesh.aside(lambda x_m: curved.aside_m(x_m + moved_m) - middle_m)


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Everything visible to a camera in one run.

    Attributes:
        layout: Layout of the intersection.
        conditions: Conditions of the run.
        approach: Motion of the car.
        light: Daylight.
        ground: The painted ground.
        scenery: Unlabelled scenery, and the meshes of the fixed objects.
        things: Labelled objects.
        atlas: Textures.
        patches: Paved ground next to the road: driveways and lots.
    """

    layout: Layout
    conditions: Conditions
    approach: ApproachMotion
    light: Daylight
    ground: Ground
    scenery: Mesh
    things: tuple[SceneObject, ...]
    atlas: Atlas
    patches: tuple[Patch, ...] = ()


class _Flow(NamedTuple):
    """Cars that follow one another: their lane across the heading, and how many a second."""

    role: Role
    heading: float
    lane: float
    rate_hz: float


@dataclass(slots=True)
class _Site:
    layout: Layout
    atlas: Atlas
    lamps_on: bool
    parts: list[Mesh] = field(default_factory=list)
    things: list[SceneObject] = field(default_factory=list)
    patches: list[Patch] = field(default_factory=list)
    shadows: Shadows = field(default_factory=Shadows)
    taken: list[tuple[float, float, float, float]] = field(default_factory=list)

    def is_free(self, x: float, y: float, margin: float) -> bool:
        return all(
            not (x0 - margin < x < x1 + margin and y0 - margin < y < y1 + margin)
            for x0, x1, y0, y1 in self.taken
        )

    def add(self, thing: SceneObject) -> None:
        number = len(self.things)
        later = None if thing.later is None else thing.later.owned_by(number)
        mesh = thing.mesh.owned_by(number)
        self.things.append(replace(thing, number=number, mesh=mesh, later=later))

    def add_car(
        self,
        look: Look,
        role: Role,
        x: float,
        y: float,
        heading: float,
        speed: float = 0.0,
        span_s: tuple[float, float] = ALWAYS,
    ) -> None:
        moving = speed != 0.0
        mesh = car(look, lamps_on=self.lamps_on and moving)
        shape = look.shape
        velocity = (speed * float(np.cos(heading)), speed * float(np.sin(heading)))
        thing = SceneObject(
            "car",
            role,
            mesh.placed(x, y, heading),
            (x, y, shape.height_m / 2),
            heading,
            (shape.length_m, 2 * shape.half_width_m, shape.height_m),
            velocity if moving else (0.0, 0.0),
            span_s,
        )
        self.add(thing)
        if not moving and span_s == ALWAYS:
            c, s = abs(np.cos(heading)), abs(np.sin(heading))
            a = shape.length_m / 2 * c + shape.half_width_m * s
            b = shape.length_m / 2 * s + shape.half_width_m * c
            foot = np.array([(x - a, y - b), (x + a, y - b), (x + a, y + b), (x - a, y + b)])
            self.shadows.solids.append((foot, 1.0))


def _along_curve(thing: SceneObject, layout: Layout) -> SceneObject:
    if layout.curve_per_m == 0.0:
        return thing
    if not thing.is_fixed:
        return replace(thing, curved=layout)
    x, y, z = thing.at
    at = (x, y + float(layout.aside_m(np.array(x))), z)
    return replace(thing, mesh=thing.mesh.aside(layout.aside_m), at=at)


def build_world(layout: Layout, conditions: Conditions, *, is_painted: bool = True) -> World:
    """Build the world of a run, which is determined by layout and conditions.

    Args:
        layout: Layout of the intersection.
        conditions: Conditions of the run.
        is_painted: Paint the ground, which takes most of the time. Otherwise it has no colours.
    """
    fixed = np.random.default_rng([layout.seed, 1])
    varied = np.random.default_rng([conditions.seed, 2])
    light = daylight(conditions, varied)
    drive = approach(layout, conditions, varied)
    site = _Site(layout, make_atlas(fixed), light.lamps_on)
    _lot(site, fixed, varied)
    _buildings(site, fixed, varied)
    _plants(site, fixed)
    _poles(site, fixed)
    _control(site, drive)
    _parked(site, varied)
    _traffic(site, conditions, drive, varied)
    things = tuple(_along_curve(thing, layout) for thing in site.things)
    parts = (
        [part.aside(layout.aside_m) for part in site.parts] if layout.curve_per_m else site.parts
    )
    scenery = merge_meshes([*parts, *(t.mesh for t in things if t.is_fixed)])
    ground = _painted(site, light) if is_painted else unpainted(layout)
    patches = tuple(site.patches)
    return World(layout, conditions, drive, light, ground, scenery, things, site.atlas, patches)


def _painted(site: _Site, light: Daylight) -> Ground:
    rng = np.random.default_rng([site.layout.seed, 3])
    painted, road = paint(site.layout, site.patches, rng)
    cast_shadows(
        painted,
        site.shadows.outlines(light.to_sun),
        site.shadows.blobs(light.to_sun),
        light.in_shadow,
    )
    return with_levels(along_curve(site.layout, painted), along_curve(site.layout, road))


def _lot(site: _Site, fixed: Generator, varied: Generator) -> None:
    if not site.layout.has_lot:
        return
    side = float(fixed.choice([-1.0, 1.0]))
    x0 = -float(fixed.uniform(46.0, 56.0))
    x1, w = x0 + 26.0, site.layout.half_width_m
    y0, y1 = side * (w + 3.3), side * (w + 20.5)
    low, high = min(y0, y1), max(y0, y1)
    site.patches.append(Patch((x0, x1), (low, high)))
    gate = (x0 + 11.0, x0 + 17.0)
    site.patches.append(Patch(gate, (min(side * (w - 0.2), y0), max(side * (w - 0.2), y0))))
    site.taken.append((x0, x1, low, high))
    for k, x in enumerate(np.arange(x0 + 2.4, x1 - 1.5, 2.75)):
        for row_y in (y0 + side * 3.0, y1 - side * 3.0):
            at_gate = gate[0] - 1 < x < gate[1] + 1 and abs(row_y - y0) < 4
            if varied.random() < 0.55 and not at_gate:
                nose = np.pi / 2 if varied.random() < 0.5 else -np.pi / 2
                site.add_car(any_look(varied), "other", float(x), float(row_y), nose)
        if k == 4 and varied.random() < 0.5:
            heading = 0.0 if varied.random() < 0.5 else np.pi
            site.add_car(any_look(varied), "other", float(x), (y0 + y1) / 2, heading)


def _buildings(site: _Site, fixed: Generator, varied: Generator) -> None:
    layout = site.layout
    w, near, far = layout.half_width_m, NEAR_KERB_M, layout.far_kerb_m
    back = 5.0 if layout.is_town else 8.5
    for side in (-1.0, 1.0):
        _row_along(site, fixed, varied, -108.0, near - back, side * (w + back), side)
        has_arm = layout.has_left if side > 0 else layout.has_right
        if layout.has_ahead:
            start = far + back if has_arm else near - back + 2.0
            _row_along(site, fixed, varied, start, 108.0, side * (w + back), side)
        if has_arm:
            first = w + back + 16.0
            _row_across(site, fixed, near - back, -1.0, side, first, 62.0)
            _row_across(
                site, fixed, far + back, 1.0, side, first if layout.has_ahead else 7.0, 62.0
            )
    if not layout.has_ahead:
        _row_across(site, fixed, far + back, 1.0, 1.0, -7.0, 7.0)


def _row_along(
    site: _Site, fixed: Generator, varied: Generator, x0: float, x1: float, y: float, side: float
) -> None:
    shop = site.layout.is_town
    at = x1
    while at > x0 + 8.0:
        wide = float(fixed.uniform(9.0, 13.0))
        deep = float(fixed.uniform(9.0, 12.0))
        gap = float(fixed.uniform(0.3, 1.5) if shop else fixed.uniform(5.0, 9.0))
        ys = (y, y + side * deep)
        low, high = min(ys), max(ys)
        blocked = any(
            at - wide < b and at > a and low < d and high > c for a, b, c, d in site.taken
        )
        if not blocked and fixed.random() < (0.97 if shop else 0.9):
            _place(site, fixed, (at - wide, at), (low, high))
            is_before = at < NEAR_KERB_M
            if not shop and gap > 5.4 and is_before and fixed.random() < 0.6:
                _driveway(site, varied, at - wide - gap / 2, side)
        at -= wide + gap


def _row_across(
    site: _Site, fixed: Generator, x: float, out: float, side: float, y0: float, y1: float
) -> None:
    shop = site.layout.is_town
    at = y0
    while at < y1 - 6.0:
        wide = float(min(fixed.uniform(9.0, 14.0), y1 - at))
        deep = float(fixed.uniform(9.0, 12.0))
        gap = float(fixed.uniform(0.3, 1.2) if shop else fixed.uniform(4.0, 8.0))
        ys = (side * at, side * (at + wide))
        xs = (x, x + out * deep)
        _place(site, fixed, (min(xs), max(xs)), (min(ys), max(ys)))
        at += wide + gap


def _place(site: _Site, fixed: Generator, x: tuple[float, float], y: tuple[float, float]) -> None:
    mesh, high = building(x, y, site.atlas, fixed, is_shop=site.layout.is_town)
    site.parts.append(mesh)
    site.taken.append((*x, *y))
    foot = np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])
    site.shadows.solids.append((foot, high))


def _driveway(site: _Site, varied: Generator, x: float, side: float) -> None:
    w = site.layout.half_width_m
    y0, y1 = side * (w - 0.2), side * (w + 15.0)
    site.patches.append(Patch((x - 1.5, x + 1.5), (min(y0, y1), max(y0, y1)), "concrete"))
    if varied.random() < 0.6:
        nose = np.pi / 2 if varied.random() < 0.5 else -np.pi / 2
        y = side * (w + float(varied.uniform(6.5, 9.0)))
        site.add_car(any_look(varied), "other", x, y, float(nose))
    site.taken.append((x - 1.7, x + 1.7, min(y0, y1), max(y0, y1)))


def _plants(site: _Site, fixed: Generator) -> None:
    layout = site.layout
    w, near, far = layout.half_width_m, NEAR_KERB_M, layout.far_kerb_m
    spots = []
    for side in (-1.0, 1.0):
        for x in np.arange(-100.0, 100.0, 13.0):
            spots.append((x + fixed.uniform(-4, 4), side * (w + fixed.uniform(3.8, 5.5))))
            spots.append((x + fixed.uniform(-4, 4), side * (w + fixed.uniform(20, 34))))
        for y in np.arange(20.0, 62.0, 14.0):
            spots.append((near - fixed.uniform(3.8, 5.0), side * (y + fixed.uniform(-4, 4))))
            spots.append((far + fixed.uniform(3.8, 5.0), side * (y + fixed.uniform(-4, 4))))
    for x, y in spots:
        at_corner = near - 16 < x < far + 9 and abs(y) < w + 12
        on_cross = near - 3.5 < x < far + 3.5 or (not layout.has_ahead and x > far and abs(y) < 12)
        keep = fixed.random() < (0.4 if layout.is_town else 0.72)
        if keep and not at_corner and not on_cross and site.is_free(x, y, 1.0):
            mesh, radius, high = tree(float(x), float(y), site.atlas, fixed)
            site.parts.append(mesh)
            site.shadows.crowns.append((float(x), float(y), radius, high))
    for _ in range(26):
        x, y = fixed.uniform(-95, near - 16), fixed.choice([-1, 1]) * (w + fixed.uniform(6.5, 8.0))
        if site.is_free(x, y, 0.4) and not layout.is_town:
            site.parts.append(
                bush(float(x), float(y), 0.9, float(fixed.uniform(0.9, 1.5)), site.atlas, fixed)
            )
    # Trees close the view beyond the last houses.
    for x in (-112.0, 116.0):
        for y in np.arange(-60.0, 60.0, 5.0):
            if abs(y) > w + 3:
                place = (x + float(fixed.uniform(-2, 2)), float(y), 4.0)
                site.parts.append(crown(place, 4.0, 4.0, 5, site.atlas, fixed))
    if layout.vegetation:
        _overgrowth(site, fixed)


def _overgrowth(site: _Site, fixed: Generator) -> None:
    """Add bushes along the ego side up to the corner, and branches before the stop sign."""
    w, own = site.layout.half_width_m, site.layout.own
    for x in np.arange(-34.0, 2.5, 2.2):
        y = own * (w + float(fixed.uniform(2.0, 3.4)))
        high = float(fixed.uniform(1.9, 3.2))
        site.parts.append(bush(float(x), y, 1.5, high, site.atlas, fixed))
        site.shadows.crowns.append((float(x), y, 1.4, 0.8))
    for x in (-11.5, -9.5, -7.5):
        mesh = crown((x, own * (w + 0.55), 2.75), 0.95, 0.7, 7, site.atlas, fixed)
        site.parts.append(mesh)
    for x, aside_m in ((-10.0, w + 2.2), (-17.0, w + 2.4), (-24.0, w + 2.2)):
        y = own * aside_m
        mesh, radius, high = tree(x, y, site.atlas, fixed)
        site.parts.append(mesh)
        site.shadows.crowns.append((x, y, radius, high))


def _poles(site: _Site, fixed: Generator) -> None:
    layout = site.layout
    side = float(fixed.choice([-1.0, 1.0]))
    # Poles are behind the sidewalk; before it, they would hide the signs for most of the approach.
    y = side * (layout.half_width_m + 3.4)
    xs = np.arange(-101.0, 100.0, 34.0).tolist()
    if not layout.has_ahead:
        xs = [x for x in xs if x < 0]
    xs = [x - 6.0 if NEAR_KERB_M - 7 < x < layout.far_kerb_m + 7 else x for x in xs]
    for x in xs:
        site.parts.append(utility_pole(float(x), y))
    for a, b in pairwise(xs):
        for off in (-1.0, 0.0, 1.0):
            site.parts.append(wire((float(a), y + off, 8.9), (float(b), y + off, 8.9)))
    face = sign_face("speed_limit", site.atlas)
    x, y = -62.0, layout.own * (layout.half_width_m + 0.9)
    site.parts += [face.placed(x, y, 0.0, 2.5), post(x, y, 2.9)]


def _sign(site: _Site, category: Category, x: float, y: float, z: float, turn: float = 0.0) -> None:
    face = sign_face(category, site.atlas)
    flat = face.corners.reshape(-1, 3)
    wide, high = (float(np.ptp(flat[:, k])) for k in (1, 2))
    site.parts += [post(x, y, z + high / 2), sign_back(face).placed(x, y, turn, z)]
    mesh, size = face.placed(x, y, turn, z), (0.02, wide, high)
    site.add(SceneObject(category, "furniture", mesh, (x, y, z), turn, size))


def _control(site: _Site, drive: ApproachMotion) -> None:
    layout = site.layout
    w, far, end = layout.half_width_m, layout.far_kerb_m, layout.end_m
    own = layout.own
    if layout.control == "stop_sign":
        _sign(site, "stop_sign", 0.0, own * (w + 0.95), 2.5)
    if layout.control == "traffic_light":
        _lights(site, drive)
    if layout.one_way:
        kind: Category = "one_way_left" if layout.one_way == "left" else "one_way_right"
        _sign(site, kind, end, -own * ((w + 1.2) if layout.has_ahead else 1.2), 2.45)
        _sign(site, kind, NEAR_KERB_M - 1.0, own * (w + 3.6), 2.45)
    if layout.do_not_enter and layout.ahead_is_closed:
        for side in (-1.0, 1.0):
            _sign(site, "do_not_enter", end + 0.6, side * (w + 0.8), 2.3)
    elif layout.do_not_enter:
        # For drivers turning into the one-way street; the sign is rotated towards the ego vehicle.
        side = 1.0 if layout.one_way == "right" else -1.0
        _sign(site, "do_not_enter", far + 1.0, side * (w + 3.2), 2.3, side * 0.5)


def _lights(site: _Site, drive: ApproachMotion) -> None:
    layout = site.layout
    w, end, own = layout.half_width_m, layout.end_m, layout.own
    site.parts.append(mast(end, own * (w + 1.5), -own * 1.2))
    lane = lane_y_m(layout)
    for y, z in ((lane, 5.45), (lane - own * 3.4, 5.5), (own * (w + 1.2), 3.2)):
        red = light_head("red").placed(end, y, 0.0, z)
        green = light_head("green").placed(end, y, 0.0, z)
        size = (0.24, 0.36, 1.06)
        light = SceneObject("traffic_light", "furniture", green, (end, y, z), 0.0, size)
        if drive.green_s >= 0.0:
            light = replace(light, mesh=red, later=green, later_s=drive.green_s)
        site.add(light)


def _parked(site: _Site, varied: Generator) -> None:
    layout = site.layout
    w, near, far = layout.half_width_m, NEAR_KERB_M, layout.far_kerb_m
    own = layout.own
    for side, has_arm in ((1.0, layout.has_left), (-1.0, layout.has_right)):
        if not has_arm or not layout.parked_cross:
            continue
        for x, heading in ((near + 1.15, own * np.pi / 2), (far - 1.15, -own * np.pi / 2)):
            if layout.one_way:
                heading = np.pi / 2 if layout.one_way == "left" else -np.pi / 2
            y = w + float(varied.uniform(5.5, 8.0))
            for _ in range(layout.parked_cross):
                if varied.random() < 0.6:
                    site.add_car(any_look(varied), "parked_cross", x, side * y, heading)
                y += float(varied.uniform(6.0, 7.5))
    if layout.has_ahead and layout.has_parking_lane:
        for side, heading in ((own, 0.0), (-own, np.pi)):
            if layout.ahead_is_closed:
                heading = np.pi
            x = far + float(varied.uniform(9.0, 13.0))
            for _ in range(layout.parked_past):
                if varied.random() < 0.65:
                    site.add_car(any_look(varied), "parked_past", x, side * (w - 1.05), heading)
                x += float(varied.uniform(6.2, 9.0))
    if layout.has_parking_lane:
        for side, heading in ((own, 0.0), (-own, np.pi)):
            for x in np.arange(-80.0, -16.0, 7.0):
                if varied.random() < 0.14:
                    site.add_car(any_look(varied), "other", float(x), side * (w - 1.05), heading)


def _traffic(site: _Site, conditions: Conditions, drive: ApproachMotion, varied: Generator) -> None:
    layout = site.layout
    w, near, far = layout.half_width_m, NEAR_KERB_M, layout.far_kerb_m
    rate = layout.cross_traffic * conditions.traffic / 60.0
    flows = []
    # Where traffic drives on the right, cars to the right use the near half.
    # With only one arm there is no crossing traffic; turning cars are not simulated.
    halves = (near + 0.27 * (far - near), far - 0.27 * (far - near))
    to_right, to_left = halves if layout.traffic == "right" else halves[::-1]
    if layout.has_left and layout.has_right:
        if layout.one_way != "left":
            flows.append((-np.pi / 2, to_right))
        if layout.one_way != "right":
            flows.append((np.pi / 2, to_left))
    for heading, x in flows:
        _stream(site, _Flow("cross", heading, x, rate), drive, varied)
    if layout.has_ahead:
        rate = 5.0 * conditions.traffic / 60.0
        _stream(site, _Flow("oncoming", np.pi, -lane_y_m(layout), rate), drive, varied)
        if not layout.ahead_is_closed:
            _outgoing(site, conditions, varied)
        if drive.green_s >= 0.0 and varied.random() < 0.7 * conditions.traffic:
            _waiting(site, drive, varied)
    if layout.control == "traffic_light" and drive.green_s < 0.0:
        for heading, x in flows:
            y = (w + 5.5) * (1.0 if heading < 0 else -1.0)
            if varied.random() < 0.8:
                site.add_car(any_look(varied), "cross", x, y, heading)


def _stream(site: _Site, flow: _Flow, drive: ApproachMotion, varied: Generator) -> None:
    role, heading, lane, rate_hz = flow
    length_s, at = len(drive.motion) / 100.0, -9.0
    speed = float(varied.uniform(8.0, 12.0))
    enter, leave = drive.inside_s
    while True:
        at += 1.4 + float(varied.exponential(1.0 / max(rate_hz, 1e-3)))
        if at > length_s + 6.0:
            return
        look = any_look(varied)
        if role == "cross":
            waits_for_red = drive.green_s >= 0.0 and at > drive.green_s - 1.0
            always_green = site.layout.control == "traffic_light" and drive.green_s < 0.0
            if enter - 2.2 < at < leave + 2.2 or waits_for_red or always_green:
                continue
            y = -speed * float(np.sin(heading)) * at
            site.add_car(look, role, lane, y, heading, speed, (at - 9.0, at + 9.0))
        elif drive.green_s < 0.0 or at > drive.green_s + 4.0:
            x = site.layout.far_kerb_m + speed * at
            site.add_car(look, role, x, lane, heading, speed, (at - 16.0, at + 9.0))


def _outgoing(site: _Site, conditions: Conditions, varied: Generator) -> None:
    x = site.layout.far_kerb_m + float(varied.uniform(6.0, 30.0))
    # All have one speed, so that no car passes through another.
    speed = float(varied.uniform(2.5, 5.0))
    for _ in range(int(varied.poisson(0.8 * conditions.traffic))):
        site.add_car(any_look(varied), "outgoing", x, lane_y_m(site.layout), 0.0, speed, (0.0, 1e9))
        x += float(varied.uniform(9.0, 25.0))


def _waiting(site: _Site, drive: ApproachMotion, varied: Generator) -> None:
    """Add an oncoming car that waits at the red light and starts when it turns green."""
    look, lane = any_look(varied), -lane_y_m(site.layout)
    go, speed = drive.green_s + 1.2, 4.5
    x = site.layout.end_m + 4.0 + look.shape.length_m / 2
    site.add_car(look, "oncoming", x, lane, np.pi, 0.0, (-1e9, go))
    site.add_car(look, "oncoming", x + speed * go, lane, np.pi, speed, (go, 1e9))
