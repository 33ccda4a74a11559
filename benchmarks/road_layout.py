"""Train the network of ``detectors/cues/road_layout.py`` on masks of simulated road layouts.

Run it as ``python benchmarks/road_layout.py OUT [STEPS [SIZE [SEED [FILE]]]]``. It draws layouts on
the ground, sees each with a random camera, spoils the mask as a road network does, and trains on so
many batches of SIZE and their mirror images, from the network of FILE on if there is one; then it
prints recall and false positives on masks that were not used, and writes ``road_layout.onnx``.

The shipped file comes from ``500 64 2 FILE`` on one core (32,000 masks, half an hour). FILE is that
of 42839e70: 2,443 steps of 512 from nothing, by an earlier form without motorways, torn masks and
verges taken for road. What these look like was taken from false roads of development.

On 44 real drives of development (19.6 minutes; 71 roads to a side that are there, 112 that are not
in 5,929 frames) it shows, above these log odds:

    before  1.25: 43 there, 6 not (100 frames)  1.75: 40, 2 (18)  2.5: 27, 0 (0)
    now     1.0:  43 there, 2 not (6 frames)    1.5:  40, 0 (0)   2.5: 23, 0 (0)

By the first limits, 6 openings were beside roads without an intersection, now 2; 7 and 9 are in
frames that nobody annotated. Intervals over the 28 places: the area under the curve grows by 0.009
(-0.004 to 0.029), its mean height up to a tenth of false ones by 0.05 (-0.01 to 0.13). A first
trial, of 200 steps with other numbers, gave 43 and 0 above 1.25. Simulated roads are told apart as
well as before: with 5 and 1 % false ones, 0.51 and 0.30 are found (0.51 and 0.32) in 1,280 masks,
and 0.54 and 0.36 (0.54 and 0.39) in 2,048 of the earlier form; all log odds are lower.

No help: weights of the last layer fitted to real masks (at places left out the area falls from 0.89
to 0.83 or less), and the mean over crops of the mask. By the whole estimate on 41 of these drives
(legs there of 121, not there of 116, intersections of 58, false ones):

    before, above 1.25: 85, 5, 49, 10   with kerbs 86, 1, 49, 6
    now, above 1.25:    81, 1, 49, 5    with kerbs 79, 1, 48, 5
    now, above 1.0:     85, 2, 50, 6    with kerbs 85, 2, 50, 6

With kerbs, roads to the sides lose 1.25 where the road network shows none, as on motorways, and
gain up to 0.25 where it shows many: that told what these weights tell. To open an approach by log
odds of 1.5 and hold its legs to 1.0 loses three intersections (79, 1, 46, 5).

No help: networks' features of the whole picture, in 12 or 24 cells; a ridge regression adds them to
the log odds (places left out; 74 drives, 27.6 minutes). Area in frames 0.80; layers of the road
network and detector 0.85, EfficientNet-Lite0 0.87, Cityscapes classes 0.79, optical flow 0.82.
Weight and limit with the fewest false ones at no fewer intersections, chosen on all drives (legs
there of 162, not there of 153, intersections of 82, false ones, change in these over places):

    now 112, 3, 68, 19; layers 119, 3, 68, 16 (-7 to 1); EfficientNet 117, 3, 68, 14 (-13 to 1)

Lights alone make 9 of the 19; if no road were seen away from intersections, 10 would be left.
"""

from __future__ import annotations

import copy
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import onnx
import torch
import torch._inductor.config
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional

ROWS, COLUMNS = 128, 160
# Rows of the picture that one row of the mask averages.
FINER: Final = 2
# A road to a side that begins nearer than the first is ahead; up to the second it is not scored.
AHEAD_M: Final = 30.0
UNSURE_M: Final = 48.0
# Ground further away is not drawn.
HORIZON_M: Final = 300.0
NAMES: Final = ("left", "right", "straight", "intersection")
MIRRORED: Final = [1, 0, 2, 3]


class Batch(NamedTuple):
    """Simulated masks: inputs (N, 3, rows, columns), labels and weights (N, 4) as ``NAMES``."""

    inputs: Tensor
    labels: Tensor
    weights: Tensor


@dataclass(frozen=True)
class Draw:
    """Random numbers, one for each mask of a batch, shape (N, 1, 1)."""

    n: int
    device: str

    def uniform(self, low: float = 0.0, high: float = 1.0) -> Tensor:
        """Uniform between two bounds."""
        return low + (high - low) * torch.rand((self.n, 1, 1), device=self.device)

    def log_uniform(self, low: float, high: float) -> Tensor:
        """Uniform in the logarithm."""
        return torch.exp(self.uniform(math.log(low), math.log(high)))

    def normal(self, sd: float = 1.0) -> Tensor:
        """Normal around 0."""
        return sd * torch.randn((self.n, 1, 1), device=self.device)

    def chance(self, p: float) -> Tensor:
        """True with a probability."""
        return self.uniform() < p

    def sign(self) -> Tensor:
        """A side: 1 or -1."""
        return torch.where(self.chance(0.5), 1.0, -1.0)

    def field(self, rows: int, columns: int, size: tuple[int, int]) -> Tensor:
        """Smooth noise over a picture, shape (N, *size)."""
        coarse = torch.randn((self.n, 1, rows, columns), device=self.device)
        return functional.interpolate(coarse, size, mode="bicubic", align_corners=False)[:, 0]


@dataclass(frozen=True)
class View:
    """The camera, and the ground point of each pixel."""

    size: tuple[int, int]
    aspect: Tensor
    focal: Tensor
    height_m: Tensor
    curve: Tensor
    roll: Tensor
    row: Tensor
    column: Tensor
    aside: Tensor
    below: Tensor
    level: Tensor
    is_ground: Tensor
    ahead_m: Tensor


def view(d: Draw) -> View:
    """Draw cameras: focal length in picture widths, height, horizon, roll; ground may be curved."""
    rows, columns = ROWS * FINER, COLUMNS
    aspect = torch.where(d.chance(0.12), d.uniform(2.4, 3.4), d.uniform(1.2, 2.3))
    focal = d.log_uniform(0.45, 1.4)
    height_m = d.uniform(1.05, 2.2)
    horizon = torch.where(aspect > 2.4, d.uniform(0.35, 0.55), d.uniform(0.22, 0.68))
    centre = 0.5 + d.normal(0.05)
    roll = torch.tan(d.normal(math.radians(1.2)))
    curve = d.normal(1.0) * torch.where(d.chance(0.3), 1.0 / 700, 1.0 / 4000)
    row = ((torch.arange(rows, device=d.device) + 0.5) / rows).view(1, rows, 1)
    column = ((torch.arange(columns, device=d.device) + 0.5) / columns).view(1, 1, columns)
    aside = (column - centre) / focal
    level = (row - horizon) / (aspect * focal)
    below = level + roll * aside
    square = below * below + 2 * curve * height_m
    denominator = below + square.clamp(min=0).sqrt()
    ahead_m = 2 * height_m / denominator.clamp(min=1e-4)
    is_ground = (square > 0) & (denominator > 1e-4) & (ahead_m < HORIZON_M)
    return View(
        (rows, columns),
        aspect,
        focal,
        height_m,
        curve,
        roll,
        row,
        column,
        aside,
        below,
        level,
        is_ground,
        ahead_m.clamp(max=HORIZON_M),
    )


@dataclass(frozen=True)
class Road:
    """The carriageway: half its width, where the camera is on it, and its axis."""

    half_m: Tensor
    camera_m: Tensor
    side: Tensor
    slope: Tensor
    bend: Tensor
    bends_at_m: Tensor
    is_motorway: Tensor

    def axis(self, ahead_m: Tensor) -> Tensor:
        """Distance of the axis to the right of the camera."""
        past = (ahead_m - self.bends_at_m).clamp(min=0)
        return -self.camera_m + self.slope * ahead_m + 0.5 * self.bend * past**2


def road(d: Draw) -> Road:
    kind = d.uniform()
    narrow, wide = kind < 0.3, kind > 0.7
    width = torch.where(
        narrow, d.uniform(3.5, 7.0), torch.where(wide, d.uniform(9.0, 20.0), d.uniform(6.0, 10.5))
    )
    is_motorway = d.chance(0.16)
    lane_m, lanes = d.uniform(3.2, 3.9), torch.floor(d.uniform(2.0, 5.0))
    width = torch.where(is_motorway, lanes * lane_m, width)
    side = d.sign()
    camera = torch.where(narrow, d.uniform(-0.2, 0.4), d.uniform(0.05, 0.42)) * width * side
    in_lane = (torch.floor(d.uniform() * lanes) + 0.5 - lanes / 2) * lane_m + d.normal(0.2)
    camera = torch.where(is_motorway, in_lane, camera)
    camera = torch.minimum(torch.maximum(camera, -width / 2 + 1.0), width / 2 - 1.0)
    slope = torch.tan(torch.where(d.chance(0.15), d.normal(0.16), d.normal(0.03)))
    bend = torch.where(d.chance(0.4), d.normal(1 / 90), d.normal(1 / 500))
    bend = bend * torch.where(d.chance(0.07), 3.0, 1.0)
    bend = torch.where(d.chance(0.15), d.sign() / d.log_uniform(30, 500), bend)
    bend = torch.where(is_motorway, d.sign() / d.log_uniform(250, 4000), bend)
    slope = torch.where(is_motorway, 0.4 * slope, slope)
    at = torch.where(d.chance(0.5), d.uniform(0, 40), torch.zeros_like(bend))
    return Road(width / 2, camera, side, slope, bend, at, is_motorway)


@dataclass(frozen=True)
class Crossing:
    """The intersection: whether it is there, its legs, and where they are along the road."""

    is_there: Tensor
    at_m: Tensor
    left: Tensor
    right: Tensor
    straight: Tensor
    width_m: tuple[Tensor, Tensor]
    right_at_m: Tensor
    tilt: tuple[Tensor, Tensor]
    radius_m: Tensor
    curves: tuple[Tensor, Tensor]

    @property
    def far_m(self) -> Tensor:
        """Distance of the furthest far kerb."""
        none = torch.full_like(self.at_m, -1e6)
        left = torch.where(self.left, self.at_m + self.width_m[0] / 2, none)
        right = torch.where(self.right, self.right_at_m + self.width_m[1] / 2, none)
        return torch.maximum(left, right)


def crossing(d: Draw, own: Road) -> Crossing:
    is_there = d.chance(0.72) & ~own.is_motorway
    at = torch.where(d.chance(0.7), d.uniform(4.0, 36.0), d.uniform(-14.0, 75.0))
    legs = d.uniform()
    left = is_there & ((legs < 0.29) | (legs > 0.58))
    right = is_there & (legs >= 0.29)
    both = left & right
    straight = torch.where(both, d.chance(0.55), d.chance(0.92)) | ~is_there
    width = d.log_uniform(3.4, 13.0) * torch.where(d.chance(0.15), 1.6, 1.0)
    other_width = torch.where(d.chance(0.7), width, d.log_uniform(4.0, 13.0))
    right_at = torch.where(both & d.chance(0.25) & straight, at + d.normal(9.0), at)
    tilt = torch.where(d.chance(0.35), d.normal(0.42), d.normal(0.12)).clamp(-0.75, 0.75)
    other_tilt = torch.where(d.chance(0.7), -tilt, d.normal(0.3).clamp(-0.75, 0.75))
    radius = d.log_uniform(0.3, 14.0)
    return Crossing(
        is_there,
        at,
        left,
        right,
        straight,
        (width, other_width),
        right_at,
        (tilt, other_tilt),
        radius,
        (d.normal(1 / 120), d.normal(1 / 120)),
    )


Span = tuple[Tensor, Tensor]


def smooth_min(a: Tensor, b: Tensor, radius_m: Tensor) -> Tensor:
    """Union of two areas given by signed distances, with rounded corners."""
    near = (radius_m - (a - b).abs()).clamp(min=0.0) / radius_m
    return torch.minimum(a, b) - near * near * radius_m * 0.25


def rectangle(u: Tensor, z: Tensor, across: Span, along: Span) -> Tensor:
    """About the signed distance of a rectangle."""
    aside = torch.maximum(across[0] - u, u - across[1])
    return torch.maximum(aside, torch.maximum(along[0] - z, z - along[1]))


def leg(u: Tensor, z: Tensor, there: Crossing, side: int) -> Tensor:
    """Signed distance of the road to a side, -1 for the left."""
    one = 0 if side < 0 else 1
    at = there.at_m if side < 0 else there.right_at_m
    tilt, curve = there.tilt[one], there.curves[one]
    out, on = side * u, z - at
    along = out * torch.cos(tilt) + on * torch.sin(tilt)
    across = on * torch.cos(tilt) - out * torch.sin(tilt) - 0.5 * curve * along * along
    distance = torch.maximum(across.abs() - there.width_m[one] / 2, -along)
    nowhere = torch.full_like(at, 1e6)
    return torch.where(there.left if side < 0 else there.right, distance, nowhere)


def paved(d: Draw, seen: View, own: Road, there: Crossing) -> tuple[Tensor, Tensor]:
    """Draw the road network: pixels that are road, and offsets from the carriageway's axis."""
    z = seen.ahead_m
    u = seen.aside * z - own.axis(z)
    half, has, straight, far = own.half_m, there.is_there, there.straight, there.far_m
    nowhere = torch.full_like(half, 1e6)
    sides = leg(u, z, there, -1), leg(u, z, there, 1)
    skew = z + torch.where(there.left & there.right, u * torch.tan(there.tilt[0]), 0 * u)
    end = torch.where(straight, nowhere, far)
    area = u.abs() - half
    area = torch.where(straight, area, torch.maximum(area, skew - end))
    # Behind the intersection the road may be wider or narrower, and shifted.
    shift = torch.where(has & d.chance(0.35), d.normal(1.5), 0 * half)
    grow = torch.where(has & d.chance(0.35), d.uniform(0.6, 1.5), 0 * half + 1)
    beyond = torch.maximum((u - shift).abs() - half * grow, far - z)
    area = torch.where(has & straight & (z > far), beyond, area)
    # A lane to turn from.
    side = d.sign()
    before = (there.at_m - d.uniform(15, 50), there.at_m)
    lane = rectangle(u * side, z, (0 * half, half + 3.2), before)
    area = torch.where(has & d.chance(0.15), torch.minimum(area, lane), area)
    # The other carriageway.
    is_divided = d.chance(0.22) | (own.is_motorway & d.chance(0.5))
    gap, width = d.log_uniform(0.8, 8.0), d.uniform(5.5, 14.0)
    out = -own.side * u
    other = torch.maximum(half + gap - out, out - half - gap - width)
    other = torch.where(straight, other, torch.maximum(other, skew - end))
    for one in sides:
        area = smooth_min(area, one, there.radius_m)
    area = torch.where(is_divided, torch.minimum(area, other), area)
    # An island in the legs.
    has_island = d.chance(0.12)
    island = torch.maximum((z - there.at_m).abs() - d.uniform(0.4, 2.0), half + 3 - u.abs())
    area = torch.where(has_island & has, torch.maximum(area, -island), area)
    # Another intersection further on, or one that was passed.
    is_more = d.chance(0.25)
    at = torch.where(has, there.at_m + d.uniform(55, 110), d.uniform(60, 110))
    at = torch.where(d.chance(0.5), at, -d.uniform(8, 20))
    side = d.sign()
    more_width, one_side = d.log_uniform(4.0, 12.0), d.chance(0.5)
    reach = torch.where(one_side, -u * side, -half - 60 + 0 * u)
    more = torch.maximum((z - at).abs() - more_width / 2, reach)
    area = torch.where(is_more & straight, smooth_min(area, more, there.radius_m), area)
    area = others(d, seen, own, there, (area, u, skew - end))
    return (area < 0) & seen.is_ground, u


def others(
    d: Draw, seen: View, own: Road, there: Crossing, so_far: tuple[Tensor, Tensor, Tensor]
) -> Tensor:
    """Add what is no road: driveways, lay-bys, yards, footways taken for road, slip roads."""
    area, u, past_end = so_far
    z, half = seen.ahead_m, own.half_m
    for _ in range(4):
        side, at = d.sign(), d.uniform(3, 45)
        width, depth = d.uniform(2.2, 4.2), d.log_uniform(1.5, 9.0)
        along = (at - width / 2, at + width / 2)
        drive = rectangle(u * side, z, (half - 1, half + depth), along)
        area = torch.where(d.chance(0.14), torch.minimum(area, drive), area)
    for _ in range(2):
        side, at = d.sign(), d.uniform(-10, 40)
        along = (at, at + d.log_uniform(6, 60))
        bay = rectangle(u * side, z, (half - 1, half + d.uniform(1.6, 3.4)), along)
        area = torch.where(d.chance(0.16), smooth_min(area, bay, torch.ones_like(at)), area)
    side, at = d.sign(), d.uniform(2, 40)
    along = (at, at + d.uniform(10, 40))
    yard = rectangle(u * side, z, (half - 1, half + d.uniform(5, 14)), along)
    area = torch.where(d.chance(0.03), torch.minimum(area, yard), area)
    for one in (-1, 1):
        away, width = d.uniform(-0.2, 2.5), d.log_uniform(0.8, 4.0)
        footway = torch.maximum(half + away - u * one, u * one - half - away - width)
        footway = torch.where(there.straight, footway, torch.maximum(footway, past_end))
        parts = d.field(24, 30, seen.size) + d.normal(0.8) > 0
        area = torch.where(d.chance(0.18) & parts, torch.minimum(area, footway), area)
    angle, at, side = d.uniform(0.05, 0.3), d.uniform(-30, 50), d.sign()
    middle = u * side - half - (z - at) * angle
    slip = torch.maximum(middle.abs() - d.uniform(2, 4), at - z)
    area = torch.where(~there.is_there & d.chance(0.12), torch.minimum(area, slip), area)
    return beside_motorway(d, own, area, u, z)


def beside_motorway(d: Draw, own: Road, area: Tensor, u: Tensor, z: Tensor) -> Tensor:
    """Add hard shoulders that widen and narrow, lay-bys, and ramps that leave or join."""
    for side in (-1, 1):
        out = u * side - own.half_m
        first, length, taper = d.uniform(-40, 60), d.log_uniform(8, 80), d.log_uniform(0.5, 30)
        grown = (torch.minimum(z - first, first + length - z) / taper).clamp(0, 1)
        wide = d.uniform(0, 3.5) * d.chance(0.6) + d.uniform(1, 4.5) * d.chance(0.4) * grown
        shoulder = torch.maximum(out - wide, -1 - out)
        area = torch.where(own.is_motorway, torch.minimum(area, shoulder), area)
        at, angle, width = d.uniform(-40, 80), d.uniform(0.04, 0.2), d.uniform(3.2, 8)
        way = torch.where(d.chance(0.6), z - at, at - z)
        ramp = torch.maximum((out - way * angle).abs() - width / 2, -way)
        area = torch.where(own.is_motorway & d.chance(0.3), torch.minimum(area, ramp), area)
    return area


def spoiled(d: Draw, seen: View, own: Road, mask: Tensor, u: Tensor) -> Tensor:
    """Add errors that stay on the ground, spill and holes, and lose the road far away."""
    z = seen.ahead_m
    has_errors = d.chance(0.45)
    for _ in range(7):
        aside, at = d.normal(1.0) * (own.half_m + 2.0), d.log_uniform(4.5, 55.0)
        across, along = d.log_uniform(0.4, 3.5), d.log_uniform(0.5, 9.0)
        inside = ((u - aside) / across) ** 2 + ((z - at) / along) ** 2 < 1
        here = has_errors & d.chance(0.3) & inside & seen.is_ground
        mask = torch.where(here, d.chance(0.5), mask)
    # A verge is taken for road, in ragged pieces.
    for one in (-1, 1):
        first, size = d.uniform(-10, 45), (30, 40)
        inside = (z > first) & (z < first + d.log_uniform(4, 70)) & (mask | seen.is_ground)
        inside &= (u * one > own.half_m - 1) & (u * one < own.half_m + d.log_uniform(1, 12))
        is_taken = d.field(*size, seen.size) + d.normal(0.5).clamp(max=0.4) > 0.0
        mask |= d.chance(0.12) & inside & is_taken
    reach = torch.where(d.chance(0.3), d.log_uniform(16.0, 90.0), torch.full_like(own.half_m, 1e6))
    return mask & (z < reach * (1 + 0.15 * d.field(3, 12, seen.size)))


def torn(d: Draw, seen: View, mask: Tensor) -> Tensor:
    """Add errors of the picture: sides and pieces that are missing, strips at the horizon."""
    ragged = d.field(40, 6, seen.size)
    for one in (-1, 1):
        # Reflections in the windscreen end the road at an upright edge.
        edge = 0.5 - d.uniform(0.02, 0.3) + 0.01 * ragged
        is_out = ((seen.column - 0.5) * one > edge) & (seen.level > d.uniform(0.0, 0.12))
        mask &= ~(d.chance(0.09) & is_out) | (d.field(12, 16, seen.size) > d.uniform(0.8, 2.5))
        # Fields, water, rails and walls far away.
        first, thick = d.uniform(-0.05, 0.02), d.log_uniform(0.004, 0.03)
        strip = (seen.below > first) & (seen.below < first + thick * (1 + 0.4 * ragged))
        strip &= (seen.column - 0.5) * one > d.uniform(-0.1, 0.4)
        mask |= d.chance(0.1) & strip & (d.field(6, 20, seen.size) > d.uniform(-1.5, 0.8))
    missing = d.field(12, 16, seen.size) > d.uniform(1.2, 2.2)
    return mask & ~(d.chance(0.12) & missing)


def behind_walls(d: Draw, seen: View, own: Road, there: Crossing, u: Tensor) -> Tensor:
    """Return the pixels of ground that walls, houses and hedges beside the road hide."""
    hidden = torch.zeros_like(seen.is_ground)
    legs = ((-1, there.left, there.at_m), (1, there.right, there.right_at_m))
    for (side, is_there, at), width in zip(legs, there.width_m, strict=True):
        away = own.half_m + d.log_uniform(0.5, 12.0)
        height = torch.where(d.chance(0.7), 10.0, 1.0) * d.uniform(0.4, 2.5)
        is_barrier = own.is_motorway & d.chance(0.6)
        away = torch.where(is_barrier, own.half_m + d.uniform(0.2, 4.0), away)
        height = torch.where(is_barrier, d.uniform(0.5, 1.3), height)
        part = (away - own.camera_m * side) / ((u - own.camera_m) * side).clamp(min=1e-3)
        meets = part * seen.ahead_m
        near = at - width / 2 - d.log_uniform(0.5, 12.0)
        far = at + width / 2 + d.log_uniform(0.5, 12.0)
        first = d.chance(0.65) & (meets < torch.where(is_there, near, d.uniform(5, 200)))
        then = d.chance(0.65) & (meets > torch.where(is_there, far, d.uniform(0, 60)))
        is_crossed = (u * side > away) & (part > 0) & (part < 1)
        hidden |= is_crossed & (first | then) & (seen.height_m * (1 - part) < height)
    return hidden


@dataclass
class Boxes:
    """Boxes of vehicles and people: rows and columns that each hides, and where it is detected."""

    d: Draw
    seen: View
    own: Road
    rows: list[Tensor] = field(default_factory=list)
    columns: list[Tensor] = field(default_factory=list)
    found_rows: list[Tensor] = field(default_factory=list)
    found_columns: list[Tensor] = field(default_factory=list)

    def add(self, place: Span, size: tuple[Tensor, Tensor, Tensor], is_there: Tensor) -> None:
        """Add one by its offset from the axis and distance; size: across, along, upwards."""
        d, seen, (offset, at), (width, length, height) = self.d, self.seen, place, size
        near, far = (at - length / 2).clamp(min=0.8), (at + length / 2).clamp(min=1.5)
        corners = [
            (self.own.axis(q) + offset + e * width / 2) / q for q in (near, far) for e in (-1, 1)
        ]
        ends = torch.cat(corners, 2)
        first, last = ends.amin(2, keepdim=True), ends.amax(2, keepdim=True)
        middle, half = (first + last) / 2, (last - first) / 2
        tilt = seen.roll * middle
        ground = (seen.height_m - 0.5 * seen.curve * near**2) / near - tilt
        back = (seen.height_m - 0.5 * seen.curve * far**2 - height) / far - tilt
        top = torch.minimum(ground - height / near, back)
        is_there = is_there & (at - length / 2 > 2.0)
        below = seen.level > top
        self.rows.append(((seen.level < ground) & below & is_there)[:, :, 0])
        self.columns.append(((seen.aside - middle).abs() < half)[:, 0])
        is_found = is_there & d.chance(0.85)
        bottom = ground + d.normal(0.06) * (ground - top)
        self.found_rows.append(((seen.level < bottom) & below & is_found)[:, :, 0])
        wide = half * (1 + d.normal(0.05))
        self.found_columns.append(((seen.aside - middle).abs() < wide)[:, 0])

    def car(self, offset: Tensor, at: Tensor, is_there: Tensor) -> None:
        """Add a car along the road."""
        d = self.d
        size = (d.uniform(1.6, 2.2), d.uniform(3.5, 6.0), d.uniform(1.4, 2.4))
        self.add((offset, at), size, is_there)

    def together(self) -> tuple[Tensor, Tensor]:
        """Return the pixels that are hidden, and those of the boxes that are found."""
        return _union(self.rows, self.columns), _union(self.found_rows, self.found_columns)


def _union(rows: list[Tensor], columns: list[Tensor]) -> Tensor:
    kind = torch.float16 if rows[0].is_cuda else torch.float32
    r, c = torch.stack(rows, 1).to(kind), torch.stack(columns, 1).to(kind)
    return torch.einsum("nkr,nkc->nrc", r, c) > 0.5


def traffic(d: Draw, seen: View, own: Road, there: Crossing) -> tuple[Tensor, Tensor]:
    """Draw a car ahead, others on the road, parked rows, crossing cars, people."""
    boxes, half, busy = Boxes(d, seen, own), own.half_m, d.uniform()
    size = (d.uniform(1.6, 2.5), d.uniform(3.5, 8.0), d.uniform(1.4, 3.5))
    boxes.add((own.camera_m + d.normal(0.3), d.log_uniform(7, 70)), size, d.chance(0.35))
    for _ in range(3):
        offset, at = d.uniform(-1, 1) * (half - 1), d.log_uniform(6, 80)
        is_clear = ((offset - own.camera_m).abs() > 2.4) | (at > 20)
        boxes.car(offset, at, d.chance(0.35) & (busy > 0.2) & is_clear)
    for _ in range(2):
        # A lorry beside the camera or further on hides an edge.
        offset = own.camera_m + d.sign() * d.uniform(2.6, 9.0)
        size = (d.uniform(2.0, 2.6), d.uniform(5.0, 16.0), d.uniform(2.4, 4.0))
        boxes.add((offset, d.log_uniform(5, 60)), size, d.chance(0.14) & (offset.abs() < half + 9))
    for side in (-1, 1):
        is_parked, offset = d.chance(0.35), side * (half + d.uniform(-1.4, 1.5))
        start, step = d.uniform(0, 12), d.uniform(5.5, 9)
        for k in range(5):
            at = start + k * step + d.normal(0.3)
            margin = there.width_m[0] / 2 + d.uniform(-0.5, 6)
            in_mouth = ((at - there.at_m).abs() < margin) & there.is_there
            boxes.car(offset, at, is_parked & ~in_mouth & d.chance(0.75))
    for _ in range(2):
        at = there.at_m + d.uniform(-0.4, 0.4) * there.width_m[0]
        size = (d.uniform(3.8, 5), d.uniform(1.6, 2), d.uniform(1.4, 2.4))
        is_there = there.is_there & d.chance(0.22) & (there.at_m > 7)
        boxes.add((d.normal(9.0), at), size, is_there)
    for _ in range(2):
        place = (d.normal(1.0) * (half + 3), d.log_uniform(4, 40))
        size = (d.uniform(0.3, 0.7), d.uniform(0.3, 0.7), d.uniform(1.5, 3.0))
        boxes.add(place, size, d.chance(0.15))
    hidden, found = boxes.together()
    # A false box.
    middle, half_width = d.uniform(), d.uniform(0.05, 0.3)
    top, bottom = d.uniform(0, 0.5), d.uniform(0.5, 1.0)
    inside = ((seen.column - middle).abs() < half_width) & (seen.row > top) & (seen.row < bottom)
    found |= d.chance(0.06) & inside
    # The bonnet, taken for a car.
    inside = ((seen.column - middle).abs() < 0.2 + half_width) & (seen.row > 0.35 + 0.5 * bottom)
    return hidden, found | (d.chance(0.06) & inside)


def under_bonnet(d: Draw, seen: View, mask: Tensor) -> Tensor:
    """Draw the car's own bonnet, on which a network may see spots of road."""
    row = torch.where(d.chance(0.45), d.uniform(0.7, 0.98), 1e6 * torch.ones_like(seen.focal))
    row = row + d.uniform(-0.1, 0.35) * (seen.column - d.uniform(0.3, 0.7)) ** 2
    is_bonnet = seen.row > row + 0.006 * d.field(3, 24, seen.size)
    spots = d.chance(0.35) & (d.field(20, 12, seen.size) > d.uniform(0.8, 2.2))
    return torch.where(is_bonnet, spots, mask)


def averaged(mask: Tensor) -> Tensor:
    return functional.avg_pool2d(mask.float()[:, None], (FINER, 1))


def softened(d: Draw, mask: Tensor) -> Tensor:
    """Move the edges and round the corners as a network does."""
    pad, pool, size = functional.pad, functional.avg_pool2d, (ROWS, COLUMNS)
    sharp = averaged(mask)
    soft = pool(pad(sharp, (2, 2, 1, 1), mode="replicate"), (3, 5), 1)
    softer = pool(pad(soft, (3, 3, 2, 2), mode="replicate"), (5, 7), 1)
    kind, sd = d.uniform(), d.uniform(0.0, 0.3)
    moved = (sd * (d.field(12, 30, size) + 0.6 * d.field(32, 64, size))).clamp(-0.4, 0.4)
    edge = torch.where(kind < 0.5, soft[:, 0], softer[:, 0]) - 0.5 + moved
    out = (edge * d.uniform(4, 14) + 0.5).clamp(0, 1)
    confused = d.chance(0.04) & (d.field(6, 8, size) > 1.6)
    out = torch.where(confused, (d.field(30, 60, size) > 0).float(), out)
    return (torch.where(kind < 0.25, sharp[:, 0], out) * 255).round() / 255


def simulated(n: int, device: str) -> Batch:
    """Draw a batch of masks."""
    d = Draw(n, device)
    seen, own = view(d), road(d)
    there = crossing(d, own)
    mask, u = paved(d, seen, own, there)
    mask = spoiled(d, seen, own, mask, u) & ~behind_walls(d, seen, own, there, u)
    hidden, found = traffic(d, seen, own, there)
    mask = softened(d, under_bonnet(d, seen, torn(d, seen, mask) & ~hidden))
    shape = (1.0 / seen.aspect).expand(n, ROWS, COLUMNS)
    left = _ahead(there.left, there.at_m, there.width_m[0])
    right = _ahead(there.right, there.right_at_m, there.width_m[1])
    either = left[0] | right[0]
    labels = (left[0], right[0], there.straight.view(n), either)
    is_unsure = (left[1] | right[1]) & ~either
    weights = (~left[1], ~right[1], either, ~is_unsure)
    return Batch(
        torch.stack([mask, averaged(found)[:, 0], shape], 1),
        torch.stack(labels, 1).float(),
        torch.stack(weights, 1).float(),
    )


def _ahead(is_there: Tensor, at: Tensor, width: Tensor) -> tuple[Tensor, Tensor]:
    """Return whether a leg is ahead, and whether that is unsure: too far, or just passed."""
    start, stop = at - width / 2, at + width / 2
    is_ahead = is_there & (start < AHEAD_M) & (stop > 6.0)
    is_far = (start >= AHEAD_M) & (start < UNSURE_M)
    is_passed = (stop <= 6.0) & (stop > -2.0)
    return is_ahead.flatten(), (is_there & (is_far | is_passed)).flatten()


def network(has_norms: bool = True) -> nn.Sequential:
    """Return the network: 162,116 parameters; from (N, 3, rows, columns) to four log odds."""
    channels = (3, 16, 24, 48, 72, 96)
    layers: list[nn.Module] = []

    def norm(after: int) -> list[nn.Module]:
        return [*([nn.BatchNorm2d(after)] if has_norms else []), nn.ReLU()]

    for i, (before, after) in enumerate(pairwise(channels)):
        layers += [nn.Conv2d(before, after, 3, 2, 1, bias=not has_norms), *norm(after)]
        if i in (1, 2, 3):
            layers += [
                nn.Conv2d(after, after, 3, 1, 1, groups=after, bias=False),
                nn.Conv2d(after, after, 1, bias=not has_norms),
                *norm(after),
            ]
    layers += [nn.Conv2d(96, 32, 1), nn.ReLU(), nn.Flatten(), nn.Linear(32 * 4 * 5, 64)]
    return nn.Sequential(*layers, nn.ReLU(), nn.Dropout(0.1 * has_norms), nn.Linear(64, 4))


def read(path: str) -> nn.Sequential:
    """Return the network of a file, in which the norms are part of the convolutions."""
    model, graph = network(has_norms=False), onnx.load(path).graph
    values = {one.name: numpy_helper.to_array(one) for one in graph.initializer}
    kinds = ("Conv", "Gemm")
    names = [name for node in graph.node if node.op_type in kinds for name in node.input[1:]]
    with torch.no_grad():
        for parameter, name in zip(model.parameters(), names, strict=True):
            parameter.copy_(torch.from_numpy(values[name].copy()))
    return model


def loss_of(logits: Tensor, batch: Batch) -> Tensor:
    each = functional.binary_cross_entropy_with_logits(logits, batch.labels, reduction="none")
    return (each * batch.weights).sum() / batch.weights.sum().clamp(min=1)


def trained(
    model: nn.Sequential, rate: float, steps: int, draw: Callable[[], Batch]
) -> nn.Sequential:
    """Train on masks and their mirror images; return the moving mean of the network."""
    mean = copy.deepcopy(model)
    optimiser = torch.optim.AdamW(model.parameters(), weight_decay=1e-3)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = (
                rate * min(1.0, 20 * step / steps + 0.01) * (1.001 - max(step / steps, 0.4))
            )
        with torch.no_grad():
            batch = draw()
        loss = loss_of(model(batch.inputs), batch)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(model.parameters(), 2.0)
        optimiser.step()
        keep = min(0.999, step / (step + 20))
        for old, new in zip(mean.state_dict().values(), model.state_dict().values(), strict=True):
            old.copy_(keep * old + (1 - keep) * new if new.dtype.is_floating_point else new)
        if step % 50 == 0:
            print(f"step {step}, loss {loss.item():.3f}", flush=True)
    return mean.eval()


def main(arguments: list[str]) -> None:
    """Train, measure on other masks, and write the network."""
    out, *rest = arguments
    steps, size, seed = (int(one) for one in (*rest[:3], *("2400", "512", "1")[len(rest) :]))
    device = "cuda" if torch.cuda.is_available() else "cpu"
    # The same numbers, drawn three times as fast.
    torch._inductor.config.fallback_random = True
    draws = torch.compile(simulated, dynamic=False) if device == "cpu" else simulated

    def draw() -> Batch:
        one = draws(size, device)
        mirrored = (one.inputs.flip(-1), one.labels[:, MIRRORED], one.weights[:, MIRRORED])
        return Batch(*(torch.cat(both) for both in zip(one, mirrored, strict=True)))

    torch.manual_seed(seed)
    before = read(rest[3]) if len(rest) > 3 else network()
    model = trained(before.to(device), 6e-4 if len(rest) > 3 else 3e-3, steps, draw)
    torch.manual_seed(9999)
    with torch.no_grad():
        tests = [draws(size, device) for _ in range(-(-2048 // size))]
        odds = torch.cat([model(one.inputs) for one in tests]).cpu().numpy()
    labels, weights = (torch.cat([one[i] for one in tests]).cpu().numpy() > 0 for i in (1, 2))
    for i, name in enumerate(NAMES):
        given, is_there = odds[weights[:, i], i], labels[weights[:, i], i]
        for limit in (0, 1, 2, 3):
            recall, false = (np.mean(given[one] > limit) for one in (is_there, ~is_there))
            print(f"{name} above {limit}: recall {recall:.3f}, false {false:.4f}")
    Path(out).mkdir(parents=True, exist_ok=True)
    torch.onnx.export(
        model.cpu(),
        (torch.zeros(1, 3, ROWS, COLUMNS),),
        str(Path(out) / "road_layout.onnx"),
        input_names=["road"],
        output_names=["logits"],
        dynamic_axes={"road": {0: "n"}, "logits": {0: "n"}},
        dynamo=False,
        opset_version=17,
    )


if __name__ == "__main__":
    main(sys.argv[1:])
