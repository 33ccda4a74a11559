"""Roads at the intersection ahead by the shape of the road mask, whatever the camera.

A small convolutional network, trained on masks of simulated layouts seen by random cameras
(``benchmarks/road_layout.py``), tells from the mask and the boxes of vehicles whether a road to the
left or to the right begins within about 30 m, and whether the road goes on behind it. It gives no
distance. Its log odds are averaged over time; a road that they do not show is not seen, because
traffic or a house may hide it.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.base import RoadMask, bars_beside
from crosscue.replay.columns import Floats
from crosscue.replay.errors import VehicleError

from .road_openings import Legs

if TYPE_CHECKING:
    from crosscue.detectors.networks.backends import Network

WEIGHTS: Final = Path(__file__).parents[1] / "checkpoints" / "road_layout.onnx"
SHA256: Final = "42428bd35150bf59889d51934a48fd28c54cc2862e21de224979f79a6b6a3d17"
# Rows and columns of the network's input.
SHAPE: Final = (128, 160)
# Parts of a picture's width, each of which shows road in some frame or in none.
_PARTS: Final = 320
# Order of the network's outputs with left and right exchanged.
MIRRORED: Final = (1, 0, 2, 3)
# Time over which log odds are averaged.
MEAN_S: Final = 0.6
# Least mean log odds of a road; above it, 1.9 % of the simulated roads to a side that are not there
# are seen (2.3 to 2.8 % above 1.25 with the first weights). At this limit, 43 of 71 roads to a side
# and 31 of 48 straight on are seen on drives used in development, and 2 of 116 that are not there.
SEEN: Final = 1.0
# Log odds of a road straight on in the simulated layouts: three of four go on.
USUALLY_ON: Final = 1.0
# Log odds that an intersection which is believed begins within about 30 m (assumed): the road seen
# behind one that is further away may be the road before it.
BELIEVED: Final = 2.0


class LogOdds(NamedTuple):
    """Log odds of one frame, or their mean: roads that begin within about 30 m.

    Attributes:
        left: A road to the left.
        right: A road to the right.
        straight: The road goes on behind the intersection, if there is one.
        intersection: A road to either side.
    """

    left: float
    right: float
    straight: float
    intersection: float

    def goes_on(self, is_believed: bool) -> float:
        """An intersection, which other evidence may show, and a road straight on behind it."""
        return min(self.straight - USUALLY_ON, self.intersection + BELIEVED * is_believed)


@dataclass(slots=True)
class RoadLayout:
    """Roads over the frames of a drive.

    Attributes:
        mean: Mean log odds after the newest frame; None until it is one of enough frames.
        is_believed: Whether an intersection is believed already, by any evidence.
    """

    mean: LogOdds | None = None
    is_believed: bool = False
    _has_road: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(_PARTS, np.bool_))
    _mean: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))
    _first_ns: int | None = None
    _last_ns: int = 0

    def __call__(self, t_ns: int, road: RoadMask, boxes_px: Floats) -> Legs:
        """Process the next frame; return 1 for roads that are seen, NaN for the others.

        Args:
            t_ns: Time of the frame.
            road: Its mask.
            boxes_px: Shape (N, 4): boxes of everything that hides the road.

        Raises:
            ValueError: The mask is damaged.
            VehicleError: The network's file is damaged.
        """
        # Where no frame shows road, at both sides alike, there are bars beside the picture.
        is_road = road.pixels()
        has_road = np.asarray(is_road.any(axis=0))
        self._has_road |= has_road[np.arange(_PARTS) * len(has_road) // _PARTS]
        beside = bars_beside(~self._has_road) / _PARTS
        found = np.array(log_odds(is_road, road.size_px, boxes_px, beside))
        if self._first_ns is None:
            self._first_ns, gain = t_ns, 1.0
        else:
            gain = -math.expm1(-max(t_ns - self._last_ns, 0) * 1e-9 / MEAN_S)
        self._last_ns = t_ns
        self._mean = self._mean + gain * (found - self._mean)
        if t_ns - self._first_ns < MEAN_S * 1e9:
            return Legs(math.nan, math.nan, math.nan)
        self.mean = mean = LogOdds(*self._mean.tolist())
        roads = (mean.left, mean.goes_on(self.is_believed), mean.right)
        return Legs(*(1.0 if one > SEEN else math.nan for one in roads))

    def restart(self) -> None:
        """Forget all frames."""
        self._first_ns = self.mean = None
        self._has_road[:] = False
        self.is_believed = False


def log_odds(
    is_road: NDArray[np.bool_], size_px: tuple[int, int], boxes_px: Floats, beside: float
) -> LogOdds:
    """Return the log odds of one frame, the mean of those of the picture and of its mirror image.

    Args:
        is_road: Shape (height, width): pixels of its mask.
        size_px: Width and height of the picture.
        boxes_px: Shape (N, 4): boxes of everything that hides the road.
        beside: Fraction of the picture's width that each of two bars beside it takes.

    Raises:
        VehicleError: The network's file is damaged.
    """
    import cv2

    width, height = size_px
    rows, columns = SHAPE
    hidden = np.zeros((2 * rows, 2 * columns), np.float32)
    scale = np.array([columns, rows, columns, rows]) * 2.0 / (width, height, width, height)
    for left, top, right, bottom in np.maximum(np.round(boxes_px * scale), 0.0).astype(int):
        hidden[top:bottom, left:right] = 1.0
    planes = [
        cv2.resize(
            one[:, left : one.shape[1] - left], (columns, rows), interpolation=cv2.INTER_AREA
        )
        for one in (is_road.astype(np.float32), hidden)
        for left in (round(beside * one.shape[1]),)
    ]
    shape = height / (width * (1.0 - 2.0 * beside))
    picture = np.stack([*planes, np.full(SHAPE, shape, np.float32)]).astype(np.float32)
    both = np.stack([picture, picture[..., ::-1]])
    given, mirrored = next(iter(network()(both).values())).astype(np.float64)
    return LogOdds(*((given + mirrored[list(MIRRORED)]) / 2.0))


@cache
def network() -> Network:
    """Load the network that comes with the package.

    Raises:
        VehicleError: Its file is damaged.
    """
    from crosscue.detectors.networks.backends import load_network
    from crosscue.detectors.networks.weights import Weights

    content = WEIGHTS.read_bytes()
    if hashlib.sha256(content).hexdigest() != SHA256:
        raise VehicleError(f"{WEIGHTS}: damaged; install crosscue again")
    return load_network(Weights(name=WEIGHTS.name, content=content))
