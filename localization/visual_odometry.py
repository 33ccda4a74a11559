"""Odometry from successive pictures of one camera: standstill, rotation, and speed over the ground.

* **Standstill**: corners of the static scene (followed by Lucas and Kanade's method, forwards and
  back) do not move in the picture.
* **Rotation**, and the direction of travel where parallax determines it: fitted to the epipolar
  planes of the corners.
* **Speed**: both pictures are resampled on level ground, from the camera's height and attitude.
  There the car's motion is one shift, the same for all patches of the ground. Each patch votes with
  its normalised correlation as a function of the shift, so a patch without texture has no vote.
* **Pitch** relative to the road, filtered over the drive, from the direction of travel and from the
  ground: with a wrong pitch, far patches seem to move further than near ones. An error of 0.01 rad
  changes the speed by a tenth.

Hartley and Zisserman, Multiple View Geometry, chapters 9 and 13. Moving vehicles must be masked.
"""

import math
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.ranging.ground_plane import GroundPlane, turned
from crosscue.replay.columns import Bytes, Floats
from crosscue.replay.vehicle.camera import Camera

# Corners followed from each picture, and their min distance in pixels of the reduced picture.
CORNERS: Final = 500
APART_PX: Final = 10
MIN_CORNERS: Final = 20
TRAVEL_CORNERS: Final = 60
# Width above which a picture is reduced by halves.
WIDEST_PX: Final = 1300
# Max distance between a corner and where it returns when followed back.
RETURNS_PX: Final = 0.3
# Movement of three quarters of all corners below which the car stands.
STANDS_PX: Final = 0.4
# Median movement, without that by rotation, from which the essential matrix is determined.
PARALLAX_PX: Final = 2.0
# Ground: length and half width of the resampled area, its cell, and rows and columns of a patch.
LENGTH_M: Final = 14.0
HALF_WIDTH_M: Final = 2.5
CELL_M: Final = 0.05
ROWS, COLUMNS = 30, 20
# Max shift between two pictures, and min shift, in reverse.
AHEAD_M: Final = 5.0
BACK_M: Final = 0.3
# Min standard deviation of a patch in grey levels, and min height of the peak of the votes; half of
# it where the last speed, not older than a second, leads one to expect the shift this closely.
MIN_TEXTURE: Final = 1.5
MIN_PEAK: Final = 0.15
EXPECTED_M: Final = 0.2
MIN_PATCHES: Final = 4
# Time after which a speed is forgotten, and longest time between pictures that are compared.
KEPT_NS: Final = 1_000_000_000
# S.d. of the pitch before any motion, of its change from pair to pair as the road's slope changes,
# of the direction of travel in one pair, and of the pitch by the ground in one pair.
PITCH_SD: Final = 0.03
PITCH_CHANGE_SD: Final = 0.001
DIRECTION_SD: Final = 0.01
SLOPE_SD: Final = 0.004
# Min shift from which the ground tells the pitch.
LEAST_M: Final = 0.1
# Min tangent of the angle from the direction of travel at which the scene's growth is measured.
AWAY: Final = 0.05
# S.d. of the direction of travel to either side, and of a corner that is followed, in pixels.
ASIDE_SD: Final = 0.1
FOLLOWED_PX: Final = 0.2
# S.d. of the change of heading in one pair of pictures.
TURN_SD_RAD: Final = math.radians(0.05)
# S.d. of the distance where the car stands.
STANDS_SD_M: Final = 0.003
# S.d. of the camera's height as a fraction, which is that of the distance.
HEIGHT_SD: Final = 0.05
# Optical axes (right, down, ahead) to the camera's body (forward, left, up).
BODY: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class VisualStep(NamedTuple):
    """Motion between two successive pictures.

    Attributes:
        start_ns: Time of the earlier picture.
        t_ns: Time of the later picture.
        distance_m: Distance of the rear axle; NaN where the ground does not show it.
        distance_sd_m: Its standard deviation.
        turn_rad: Change of heading, counter-clockwise; NaN without enough corners.
        turn_sd_rad: Its standard deviation.
        pitch_rad: Pitch of the camera relative to the direction of travel, so far.
        is_standing: True if nothing in the static scene moves.
        corners: Number of corners followed.
        patches: Number of patches of the ground that agree.
    """

    start_ns: int
    t_ns: int
    distance_m: float
    distance_sd_m: float
    turn_rad: float
    turn_sd_rad: float
    pitch_rad: float
    is_standing: bool
    corners: int
    patches: int


class _View(NamedTuple):
    """One picture, reduced, with the boxes of what may move."""

    t_ns: int
    grey: Bytes
    boxes_px: Floats


class Travel(NamedTuple):
    """Motion of a camera between two pictures, in the axes half-way between both.

    Attributes:
        left_rad: Angle of its axis to the left of the direction of travel.
        below_rad: Angle of its axis below the direction of travel.
        turned_rad: Rotation between the pictures, to the left.
        points: Number of corners followed.
        per_turn: Error of ``left_rad`` for an error of ``turned_rad``: far from the camera, a turn
            looks like a movement to the side.
        seconds: Time between the pictures.
    """

    left_rad: float
    below_rad: float
    turned_rad: float
    points: int
    per_turn: float = 0.0
    seconds: float = 0.0


def travel_between(
    before: Bytes, after: Bytes, focal_px: float, center_px: tuple[float, float]
) -> Travel | None:
    """Estimate a camera's direction of travel: while a car drives straight, the vanishing point.

    Args:
        before: Grey picture, shape (H, W), uint8.
        after: The next one, of the same size.
        focal_px: Focal length in pixels of these pictures.
        center_px: Optical center in them.

    Returns:
        The motion, or None if too few corners can be followed or they do not move.
    """
    nothing = np.empty((0, 4))
    first, second = _followed(_View(0, before, nothing), _View(0, after, nothing))
    if len(first) < TRAVEL_CORNERS or np.median(np.hypot(*(second - first).T)) < PARALLAX_PX:
        return None
    before_rays, after_rays = (_rays(one, focal_px, center_px) for one in (first, second))
    ahead = np.array([1.0, 0.0, 0.0])
    rotation, _, _ = _fitted(before_rays, after_rays, np.eye(3), ahead, focal_px, is_free=False)
    rotation, along, weights = _fitted(
        before_rays, after_rays, rotation, ahead, focal_px, is_free=True, direction_sd=ASIDE_SD
    )
    x, y, z = _rotated(0.5 * np.asarray(cv2.Rodrigues(rotation)[0], np.float64)) @ along
    turned_rad = -math.atan2(rotation[1, 0], rotation[0, 0])
    shared = np.linalg.inv(weights)[2]
    per_turn = float(shared[3] / shared[2]) - 0.5
    left_rad, below_rad = -math.atan2(y, x), math.atan2(z, math.hypot(x, y))
    return Travel(left_rad, below_rad, turned_rad, len(first), per_turn)


@dataclass(slots=True)
class VisualOdometry:
    """Motion of the car from picture to picture; it holds the previous picture.

    Attributes:
        camera: Focal length, centre, height and mounting of the camera.
        expansion: Median growth of the static scene in the last pair, in proportion to the distance
            and without noise's bias at a standstill; NaN with few corners.
    """

    camera: Camera
    _before: _View | None = None
    _pitch: float = field(init=False)
    _pitch_var: float = PITCH_SD**2
    _speed_mps: float = 0.0
    _seen_ns: int = -KEPT_NS
    expansion: float = math.nan

    def __post_init__(self) -> None:
        self._pitch = self.camera.pitch_rad

    def __call__(self, t_ns: int, grey: Bytes, boxes_px: Floats) -> VisualStep | None:
        """Return the motion since the previous picture; None for the first, or after a gap.

        Args:
            t_ns: Time of the picture.
            grey: Shape (height, width), uint8.
            boxes_px: Shape (N, 4): x0, y0, x1, y1 of everything that may move.
        """
        scale = 1
        size_px = (grey.shape[1], grey.shape[0])
        while size_px[0] / scale > WIDEST_PX:
            scale *= 2
        if scale > 1:
            small = (size_px[0] // scale, size_px[1] // scale)
            grey = np.asarray(cv2.resize(grey, small, interpolation=cv2.INTER_AREA), np.uint8)
        now = _View(t_ns, grey, boxes_px / scale)
        before, self._before = self._before, now
        if before is None or before.grey.shape != now.grey.shape:
            return None
        if not 0 < t_ns - before.t_ns <= KEPT_NS:
            return None
        return self._between(before, now, GroundPlane.of(self.camera, size_px), scale)

    def _between(self, before: _View, now: _View, plane: GroundPlane, scale: int) -> VisualStep:
        focal_px = plane.focal_px / scale
        center_px = (plane.center_px[0] / scale, plane.center_px[1] / scale)
        first, second = _followed(before, now)
        nothing = VisualStep(
            before.t_ns, now.t_ns, math.nan, math.nan, math.nan, math.nan, self._pitch, False,
            len(first), 0,
        )  # fmt: skip
        self.expansion = math.nan
        if len(first) < MIN_CORNERS:
            return nothing
        moved_px = np.linalg.norm(second - first, axis=1)
        is_standing = bool(np.quantile(moved_px, 0.75) < STANDS_PX)
        standing = nothing._replace(
            distance_m=0.0,
            distance_sd_m=STANDS_SD_M,
            turn_rad=0.0,
            turn_sd_rad=0.1 * TURN_SD_RAD,
            is_standing=True,
        )
        if not math.isfinite(focal_px):
            return standing if is_standing else nothing
        to_body = [_rays(points, focal_px, center_px) for points in (first, second)]
        ahead = self._attitude().T @ np.array([1.0, 0.0, 0.0])
        if is_standing:
            self.expansion = _expansion(to_body[0], to_body[1], ahead)
            return standing
        rotation, direction = _rotation(to_body[0], to_body[1], focal_px, self._attitude())
        self.expansion = _expansion(to_body[0] @ rotation.T, to_body[1], rotation @ ahead)
        self._pitch_var += PITCH_CHANGE_SD**2
        if direction is not None:
            self._learn_pitch(math.atan2(direction[2], direction[0]), DIRECTION_SD)
        resampled_at = self._pitch
        attitude = self._attitude()
        in_car = attitude @ rotation @ attitude.T
        turn_rad = -math.atan2(in_car[1, 0], in_car[0, 0])
        tilt = in_car @ turned(turn_rad, 0.0, 0.0)
        planes = [
            GroundPlane(focal_px, center_px, (0.0, 0.0, self.camera.z_m), to_level)
            for to_level in (attitude, tilt.T @ attitude)
        ]
        lever_m = (turned(turn_rad, 0.0, 0.0) - np.eye(3))[:2, :2] @ np.array(
            [self.camera.x_m, self.camera.y_m]
        )
        seconds = (now.t_ns - before.t_ns) * 1e-9
        is_recent = now.t_ns - self._seen_ns < KEPT_NS
        expected_m = self._speed_mps * seconds if is_recent else None
        shift = _ground_shift(before, now, planes, turn_rad, lever_m, expected_m)
        step = nothing._replace(turn_rad=turn_rad, turn_sd_rad=TURN_SD_RAD, pitch_rad=self._pitch)
        if shift is None:
            return step
        self._speed_mps, self._seen_ns = shift.shift_m / seconds, now.t_ns
        # A point at x seems to move by s (1 + 2 x e / h) with an error e of the pitch.
        per_pitch = 2.0 * shift.shift_m / self.camera.z_m
        if shift.shift_m > LEAST_M:
            error, error_sd = shift.slope / per_pitch, shift.slope_sd / per_pitch
            self._learn_pitch(self._pitch + error, math.hypot(error_sd, SLOPE_SD))
        lever = per_pitch * shift.distance_m
        distance_m = shift.shift_m - lever * (self._pitch - resampled_at)
        spread_m = math.hypot(
            shift.sd_m, lever * math.sqrt(self._pitch_var), HEIGHT_SD * shift.shift_m, 0.2 * CELL_M
        )
        return step._replace(
            distance_m=distance_m,
            distance_sd_m=spread_m,
            pitch_rad=self._pitch,
            patches=shift.patches,
        )

    def _attitude(self) -> Floats:
        return turned(self.camera.yaw_rad, self._pitch, self.camera.roll_rad)

    def _learn_pitch(self, measured: float, sd: float) -> None:
        """Update the pitch with one measurement."""
        gain = self._pitch_var / (self._pitch_var + sd * sd)
        self._pitch += gain * (measured - self._pitch)
        self._pitch_var *= 1.0 - gain


def _followed(before: _View, now: _View) -> tuple[Floats, Floats]:
    """Follow corners of the static scene to the next picture and back; shape (N, 2) each."""
    free = np.full(before.grey.shape, 255, np.uint8)
    for x0, y0, x1, y1 in before.boxes_px.astype(np.int64).tolist():
        free[max(y0 - 2, 0) : y1 + 3, max(x0 - 2, 0) : x1 + 3] = 0
    corners = cv2.goodFeaturesToTrack(before.grey, CORNERS, 0.005, APART_PX, mask=free)
    if corners is None:
        return np.empty((0, 2)), np.empty((0, 2))
    start = np.asarray(corners, np.float32)
    size, levels = (15, 15), 4
    there, good, _ = cv2.calcOpticalFlowPyrLK(
        before.grey, now.grey, start, start.copy(), winSize=size, maxLevel=levels
    )
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        now.grey, before.grey, there, np.asarray(there).copy(), winSize=size, maxLevel=levels
    )
    off_px = np.linalg.norm((np.asarray(back) - start).reshape(-1, 2), axis=1)
    keep = (
        (np.asarray(good).ravel() == 1)
        & (np.asarray(returned).ravel() == 1)
        & (off_px < RETURNS_PX)
    )
    first, second = (
        np.asarray(points).reshape(-1, 2)[keep].astype(np.float64) for points in (start, there)
    )
    inside = np.zeros(len(second), np.bool_)
    for x0, y0, x1, y1 in now.boxes_px.tolist():
        x, y = second.T
        inside |= (x > x0 - 2) & (x < x1 + 2) & (y > y0 - 2) & (y < y1 + 2)
    return first[~inside], second[~inside]


def _rotation(
    first: Floats, second: Floats, focal_px: float, attitude: Floats
) -> tuple[Floats, Floats | None]:
    """Rotation of the camera's body from rays, and the direction of travel if it is determined.

    Gauss and Newton's method on the sines between rays and epipolar planes, reweighted after
    Cauchy. Where the corners' parallax determines the direction of travel, it is fitted too, near
    the one expected: many corners on one plane, the road, would allow for a second solution.
    """
    ahead = attitude.T @ np.array([1.0, 0.0, 0.0])
    rotation, _, _ = _fitted(first, second, np.eye(3), ahead, focal_px, is_free=False)
    turned_rays = first @ rotation.T
    parallax = turned_rays[:, 1:] / turned_rays[:, :1] - second[:, 1:] / second[:, :1]
    if np.median(np.linalg.norm(parallax, axis=1)) * focal_px < PARALLAX_PX:
        return rotation, None
    return _fitted(first, second, rotation, ahead, focal_px, is_free=True)[:2]


def _fitted(
    first: Floats,
    second: Floats,
    rotation: Floats,
    ahead: Floats,
    focal_px: float,
    *,
    is_free: bool,
    direction_sd: float = DIRECTION_SD,
) -> tuple[Floats, Floats, Floats]:
    """Fit the rotation, and the direction of travel if it is free; also the normal matrix."""
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    # The direction of travel in the second body's axes.
    along = rotation @ ahead
    for _ in range(15):
        rays = first @ rotation.T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        normals = np.cross(np.broadcast_to(along, second.shape), second)
        lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        normals /= lengths
        error = (normals * rays).sum(axis=1)
        scale = max(FOLLOWED_PX / focal_px, float(np.median(np.abs(error))))
        slope = np.cross(rays, normals)
        weight = np.minimum(lengths.ravel() / 0.02, 1.0) / (1.0 + (error / scale) ** 2)
        if is_free:
            aside, up = np.array([-along[1], along[0], 0.0]), np.array([-along[2], 0.0, along[0]])
            by_direction = np.cross(second, rays) / lengths
            prior = np.zeros((2, 5))
            prior[0, 3], prior[1, 4] = scale / ASIDE_SD, scale / direction_sd
            off = along - rotation @ ahead
            slope = np.vstack(
                [np.column_stack([slope, by_direction @ aside, by_direction @ up]), prior]
            )
            error = np.append(error, [prior[0, 3] * off @ aside, prior[1, 4] * off @ up])
            weight = np.append(weight, [1.0, 1.0])
        left = (slope * weight[:, None]).T @ slope + 1e-12 * np.eye(slope.shape[1])
        change = np.linalg.solve(left, -(slope * weight[:, None]).T @ error)
        rotation = _rotated(change[:3]) @ rotation
        if is_free:
            along = along + change[3] * aside + change[4] * up
            along /= np.linalg.norm(along)
        else:
            along = rotation @ ahead
        if np.linalg.norm(change) < 1e-7:
            break
    return rotation, rotation.T @ along, left


def _rays(points: Floats, focal_px: float, center_px: tuple[float, float]) -> Floats:
    """Rays of pixels in the axes of the camera's body, with 1 ahead."""
    flat = (points - np.array(center_px)) / focal_px
    return np.asarray(np.column_stack([flat, np.ones(len(points))]) @ BODY.T, np.float64)


def _expansion(first: Floats, second: Floats, ahead: Floats) -> float:
    """Median growth of the rays' distances from the direction of travel; rotation is removed."""
    center = ahead[1:] / ahead[0]
    away = first[:, 1:] / first[:, :1] - center
    moved = second[:, 1:] / second[:, :1] - center - away
    far = np.linalg.norm(away, axis=1) > AWAY
    if far.sum() < MIN_CORNERS:
        return math.nan
    return float(np.median((moved * away).sum(axis=1)[far] / (away**2).sum(axis=1)[far]))


def _rotated(vector: Floats) -> Floats:
    """Rotation by a vector (Rodrigues)."""
    return np.asarray(cv2.Rodrigues(vector)[0], np.float64)


class _Shift(NamedTuple):
    """Shift of the ground by all patches together, and its slope over their distances.

    With a wrong pitch, far patches seem to move further than near ones, or less far.
    """

    shift_m: float
    sd_m: float
    patches: int
    distance_m: float
    slope: float
    slope_sd: float


def _ground_shift(
    before: _View,
    now: _View,
    planes: list[GroundPlane],
    turn_rad: float,
    lever_m: Floats,
    expected_m: float | None,
) -> _Shift | None:
    """Find the shift of the ground along the chord of the turn; None without enough texture."""
    height_px, width_px = before.grey.shape
    ((near_m, _),) = planes[0].unproject(np.array([[0.5 * width_px, height_px - 3.0]]))
    if not 0.0 < near_m < 15.0:
        return None
    rows_m = near_m + CELL_M * np.arange(round(LENGTH_M / CELL_M))
    across_m = np.arange(HALF_WIDTH_M, -HALF_WIDTH_M, -CELL_M)
    grid = np.stack(np.meshgrid(rows_m, across_m, indexing="ij"), axis=-1).reshape(-1, 2)
    chord = grid @ turned(0.5 * turn_rad, 0.0, 0.0)[:2, :2].T
    later = (chord - lever_m) @ turned(-turn_rad, 0.0, 0.0)[:2, :2].T
    shape = (len(rows_m), len(across_m))
    first, first_seen = _resampled(before, planes[0].project(chord), shape)
    second, _ = _resampled(now, planes[1].project(later), shape)
    votes, places = _votes(first, first_seen, second)
    if len(votes) < MIN_PATCHES:
        return None
    enough = np.isfinite(votes).sum(axis=0) >= MIN_PATCHES
    total = np.where(enough, np.nansum(votes, axis=0), 0.0) / np.maximum(
        np.isfinite(votes).sum(axis=0), 1
    )
    best = int(np.argmax(total))
    is_expected = expected_m is not None and abs(CELL_M * best - BACK_M - expected_m) < EXPECTED_M
    least = 0.5 * MIN_PEAK if is_expected else MIN_PEAK
    if total[best] < least or not 0 < best < len(total) - 1:
        return None
    peak = best + _vertex(total[best - 1], total[best], total[best + 1])
    own = [_nearest_peak(vote, best) for vote in votes]
    agreeing = np.array([one for one in own if one is not None])
    if len(agreeing) < MIN_PATCHES:
        return None
    used = [place for place, one in zip(places, own, strict=True) if one is not None]
    away_m = near_m + CELL_M * (np.array(used) + 0.5 * ROWS)
    line = _line(away_m, CELL_M * agreeing - BACK_M)
    spread_m = 1.4826 * float(np.median(np.abs(agreeing - np.median(agreeing)))) * CELL_M
    return _Shift(
        CELL_M * peak - BACK_M,
        spread_m / math.sqrt(len(agreeing)),
        len(agreeing),
        float(away_m.mean()),
        *line,
    )


def _line(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope of a line through points, and its standard deviation; reweighted after Cauchy."""
    weight = np.ones(len(x))
    for _ in range(10):
        mean = (weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()
        spread = (weight * (x - mean[0]) ** 2).sum()
        slope = float((weight * (x - mean[0]) * (y - mean[1])).sum() / max(spread, 1e-9))
        rest = y - mean[1] - slope * (x - mean[0])
        scale = max(1.4826 * float(np.median(np.abs(rest))), 0.1 * CELL_M)
        weight = 1.0 / (1.0 + (rest / scale) ** 2)
    return slope, scale / math.sqrt(max(spread, 1e-9))


def _resampled(
    view: _View, points_px: Floats, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Sample a picture at ground points; cells out of view, or behind a box, are not seen."""
    x, y = (np.nan_to_num(points_px[:, i], nan=-1.0).reshape(shape) for i in (0, 1))
    soft = cv2.GaussianBlur(view.grey, (3, 3), 0)
    sampled = cv2.remap(soft, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR)
    height, width = view.grey.shape
    seen = (x >= 0.0) & (x <= width - 1) & (y >= 0.0) & (y <= height - 1)
    for x0, y0, x1, y1 in view.boxes_px.tolist():
        seen &= ~((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))
    return sampled.astype(np.float32), seen


def _votes(
    first: NDArray[np.float32], seen: NDArray[np.bool_], second: NDArray[np.float32]
) -> tuple[Floats, list[int]]:
    """Correlation of each patch by shift, less its median, NaN out of reach; and its row."""
    back, ahead = round(BACK_M / CELL_M), round(AHEAD_M / CELL_M)
    votes, places = [], []
    for row in range(0, first.shape[0] - ROWS - back, ROWS // 2):
        for column in range(0, first.shape[1] - COLUMNS + 1, COLUMNS):
            patch = first[row : row + ROWS, column : column + COLUMNS]
            where = seen[row : row + ROWS, column : column + COLUMNS]
            if where.mean() < 0.95 or patch.std() < MIN_TEXTURE:
                continue
            top = max(row - ahead, 0)
            strip = second[top : row + back + ROWS, column : column + COLUMNS]
            curve = cv2.matchTemplate(strip, patch, cv2.TM_CCOEFF_NORMED).ravel()[::-1]
            vote = np.full(back + ahead + 1, np.nan)
            vote[: len(curve)] = curve - np.median(curve)
            votes.append(vote)
            places.append(row)
    return np.array(votes), places


def _nearest_peak(vote: Floats, best: int, within: int = 5) -> float | None:
    """Index of a patch's own peak near the common one; None if it has none there."""
    low = max(best - within, 1)
    part = vote[low : best + within + 1]
    if not np.isfinite(part).all() or len(part) < 3:
        return None
    at = low + int(np.argmax(part))
    if vote[at] < MIN_PEAK or at in (low, best + within) or at + 1 >= len(vote):
        return None
    return at + _vertex(vote[at - 1], vote[at], vote[at + 1])


def _vertex(left: float, middle: float, right: float) -> float:
    """Place of a parabola's vertex relative to its middle point."""
    curvature = left - 2.0 * middle + right
    return 0.0 if curvature >= 0.0 else 0.5 * (left - right) / curvature
