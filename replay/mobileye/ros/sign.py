"""Determine the sign of lanes in ROS messages from the sides of the left and the right lane."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.mobileye.settings import LaneSign

# Number of votes required, about 3 s of lanes on both sides. That is longer than a lane change, in
# which lanes are on the wrong side.
VOTES_WANTED: Final = 50
USABLE_QUALITY: Final = 2
CLEAR_OF_MIDDLE_M: Final = 0.3


class LaneSignVotes:
    """Votes of all usable lanes next to the vehicle for the sign that puts them on their side."""

    def __init__(self, label: str, sign: LaneSign) -> None:
        self._label = label
        self.is_decided = sign != "auto"
        self.is_left_positive = sign == "left"
        self._right = self._left = 0
        self._was_set = sign != "auto"

    def add(self, side: int, c0_m: NDArray[np.float64], quality: NDArray[np.float64]) -> None:
        """Add lanes of one side (1 left, -1 right), with the sign of the messages."""
        clear = c0_m[(quality >= USABLE_QUALITY) & (np.abs(c0_m) > CLEAR_OF_MIDDLE_M)]
        left = int((clear * side > 0).sum())
        self._left += left
        self._right += len(clear) - left
        if not self.is_decided and self._left + self._right >= VOTES_WANTED:
            self.close()

    def close(self) -> None:
        """Decide by the available votes; without votes, the sign is that of the wire."""
        if not self.is_decided:
            self.is_decided = True
            self.is_left_positive = self._left > self._right

    def notices(self) -> list[str]:
        """Return notices for the end of the log."""
        total = self._left + self._right
        if not total:
            return []
        against = self._right if self.is_left_positive else self._left
        side = "left" if self.is_left_positive else "right"
        if 2 * against > total:
            return [
                f"{self._label} are read as positive to the {side}, but most of them are then on "
                "the wrong side; check ros_lane_sign"
            ]
        if self._was_set or not self.is_left_positive:
            return []
        return [f"{self._label} in the messages are positive to the left, unlike on the wire"]
