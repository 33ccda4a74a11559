"""Which way lanes in ROS messages are positive, found from the sides they must be on."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.mobileye.settings import LaneSign

VOTES_WANTED: Final = 50
"""Some 3 s of lanes on both sides: longer than a change of lanes puts them on the wrong ones."""
USABLE_QUALITY: Final = 2
CLEAR_OF_MIDDLE_M: Final = 0.3


class LaneSignVotes:
    """Each usable lane beside the vehicle votes for the sign that puts it on its own side."""

    def __init__(self, says: str, sign: LaneSign) -> None:
        self._says = says
        self.is_decided = sign != "auto"
        self.is_left_positive = sign == "left"
        self._right = self._left = 0
        self._was_set = sign != "auto"

    def add(self, side: int, c0_m: NDArray[np.float64], quality: NDArray[np.float64]) -> None:
        """Lanes of one side (1 left, -1 right), as the messages have them."""
        clear = c0_m[(quality >= USABLE_QUALITY) & (np.abs(c0_m) > CLEAR_OF_MIDDLE_M)]
        left = int((clear * side > 0).sum())
        self._left += left
        self._right += len(clear) - left
        if not self.is_decided and self._left + self._right >= VOTES_WANTED:
            self.close()

    def close(self) -> None:
        """Decide by the votes there are; without any, as on the wire."""
        if not self.is_decided:
            self.is_decided = True
            self.is_left_positive = self._left > self._right

    def notices(self) -> list[str]:
        """What a person should know at the end."""
        total = self._left + self._right
        if not total:
            return []
        against = self._right if self.is_left_positive else self._left
        said = "left" if self.is_left_positive else "right"
        if 2 * against > total:
            return [
                f"{self._says} are read as positive to the {said}, but most then lie on the "
                "wrong side; check ros_lane_sign"
            ]
        if self._was_set or not self.is_left_positive:
            return []
        return [
            f"{self._says} in the messages are positive to the left, unlike on the wire; read so"
        ]
