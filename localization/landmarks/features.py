"""Features of pictures, and the interface of matchers.

A matcher is ``orb`` or ``module:factory``. It extracts ``Keypoints`` from a grey
picture and scores two ``Keypoints``. ORB is built in; a learned matcher can replace it, because
descriptors are bytes that only their matcher interprets.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Bytes
from crosscue.replay.errors import UsageError
from crosscue.replay.plugins import imported

ORB: Final = "crosscue.localization.landmarks.matcher:orb"


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """N keypoints of one picture.

    Attributes:
        width_px: Width of the picture.
        height_px: Height of the picture.
        points_px: Shape (N, 2), float32: x right, y down, from the top-left pixel.
        descriptors: Shape (N, B), uint8: B bytes per point, which only their matcher interprets.
    """

    width_px: int
    height_px: int
    points_px: NDArray[np.float32]
    descriptors: Bytes

    def __post_init__(self) -> None:
        """Reject columns of unequal length.

        Raises:
            ValueError: A shape is wrong; the message has column, expected and actual shape.
        """
        n = len(self.descriptors)
        if self.descriptors.ndim != 2 or self.descriptors.dtype != np.uint8:
            raise ValueError(f"descriptors: expected uint8 (N, B), got {self.descriptors.shape}")
        if self.points_px.shape != (n, 2):
            raise ValueError(f"points_px: expected ({n}, 2), got {self.points_px.shape}")
        if not np.isfinite(self.points_px).all():
            raise ValueError("points_px: expected finite numbers")

    def __len__(self) -> int:
        return len(self.descriptors)


class Match(NamedTuple):
    """Similarity of two pictures.

    Attributes:
        score: Score of the match, higher for a more certain one; ``crosscue fit landmarks``
            calibrates it.
        pairs: Number of points with similar descriptors.
        agreeing: Number of those that are consistent with one rigid scene.
    """

    score: float
    pairs: int
    agreeing: int


class CameraGeometry(NamedTuple):
    """Geometry of a pinhole camera, where known.

    Attributes:
        focal_px: Focal length, or None.
        center_px: Principal point (x, y), or None for the centre of the picture.
    """

    focal_px: float | None = None
    center_px: tuple[float, float] | None = None


class Matcher(Protocol):
    """Extracts and compares features."""

    @property
    def kind(self) -> str:
        """Name stored in the database; features of other kinds cannot be compared."""
        ...

    def describe(self, grey: Bytes, /) -> Keypoints:
        """Extract the features of a grey picture, shape (H, W), uint8; zero points are valid."""
        ...

    def match(self, seen: Keypoints, known: Keypoints, /) -> Match:
        """Compare two pictures; the result is deterministic."""
        ...


def make_matcher(name: str, camera: CameraGeometry = CameraGeometry()) -> Matcher:  # noqa: B008
    """Build the matcher ``orb`` or ``module:factory``.

    Raises:
        UsageError: The name, module or factory does not exist, or the result is not a matcher.
    """
    target = ORB if name == "orb" else name
    module, colon, factory = target.partition(":")
    if not (colon and module and factory):
        raise UsageError(f"matcher {name!r}: expected orb, or module:factory of your own")
    build = cast("Callable[[CameraGeometry], Matcher]", imported(target, "matcher"))
    try:
        made = build(camera)
    except TypeError as error:
        raise UsageError(
            f"matcher {name!r}: {error}; a factory accepts a CameraGeometry and returns a Matcher"
        ) from error
    lacks = [part for part in ("kind", "describe", "match") if not hasattr(made, part)]
    if lacks:
        raise UsageError(
            f"matcher {name!r}: the factory's result has no {lacks[0]}; expected a Matcher"
        )
    return made
