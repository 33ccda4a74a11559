"""The true track that a recording shows."""

from dataclasses import dataclass

from crosscue.replay.columns import Floats, Int64s


@dataclass(frozen=True, slots=True, eq=False)
class TruthTrack:
    """The true track on the log clock, in the map frame.

    Attributes:
        t_ns: Shape (N,), int64.
        x_m: Shape (N,).
        y_m: Shape (N,).
    """

    t_ns: Int64s
    x_m: Floats
    y_m: Floats
