"""Encode CAN frames as ``can_msgs/msg/Frame``, and CAN FD frames as a type of crosscue.

``can_msgs/msg/Frame`` holds 8 bytes and has no flag for CAN FD. CAN FD frames are written to the
topic ``<topic>/fd`` with the type ``crosscue_msgs/msg/CanFdFrame``.
"""

from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import ERROR, LENGTH_UNKNOWN, REMOTE, Block, CanFrames
from crosscue.replay.decode.ros.plan import ParsingPlan
from crosscue.replay.ledger import Ledger

from .outgoing import Outgoing, Ros2Type, own_type, stamps, standard_type, with_rows
from .template import filled, template_of

FD_TYPE: Final = "crosscue_msgs/msg/CanFdFrame"
FD_TEXT: Final = """\
std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
bool is_fd
uint8[] data
"""
FD_SUFFIX: Final = "/fd"


@cache
def _fd_type() -> tuple[Ros2Type, ParsingPlan]:
    return own_type(FD_TYPE, FD_TEXT)


def can_messages(block: Block, frames: CanFrames, ledger: Ledger) -> list[Outgoing]:
    """Return CAN frames as messages; the header's frame_id is the bus."""
    unknown = frames.length == LENGTH_UNKNOWN
    if unknown.any():
        ledger.notice(
            f"{block.topic}: the log does not record the lengths of frames; they are written with "
            f"{frames.data.shape[1]} bytes, the padded length"
        )
        length = np.where(unknown, frames.data.shape[1], frames.length).astype(np.uint8)
        frames = replace(frames, length=length)
    fd = frames.is_fd | (frames.length > 8)
    out: list[Outgoing] = []
    if not fd.all() or not len(fd):
        classic = block if not fd.any() else block.take(~fd)
        out.append(_classic(classic, frames if not fd.any() else frames.take(~fd)))
    if fd.any():
        ledger.notice(
            f"{block.topic}: CAN FD frames do not fit can_msgs/msg/Frame; they are written to "
            f"{block.topic}{FD_SUFFIX} as {FD_TYPE}"
        )
        out += _fd(block.take(fd), frames.take(fd))
    return out


def _values(block: Block, frames: CanFrames) -> dict[str, NDArray[np.generic]]:
    return {
        "header.stamp": stamps(block),
        "id": frames.arbitration_id,
        "is_rtr": frames.kind == REMOTE,
        "is_extended": frames.is_extended,
        "is_error": frames.kind == ERROR,
    }


def _classic(block: Block, frames: CanFrames) -> Outgoing:
    kind, plan = standard_type("can_msgs/msg/Frame")
    values = {**_values(block, frames), "dlc": frames.length, "data": frames.data[:, :8]}
    template = template_of(plan, {"header.frame_id": block.topic})
    rows = filled(plan, template, len(block), values)
    return Outgoing(kind, with_rows(block, rows))


def _fd(block: Block, frames: CanFrames) -> list[Outgoing]:
    kind, plan = _fd_type()
    out: list[Outgoing] = []
    for length in np.unique(frames.length).tolist():
        which = frames.length == length
        part, some = block.take(which), frames.take(which)
        rows = filled(
            plan,
            template_of(plan, {"header.frame_id": block.topic}, {"data": length}),
            len(part),
            {**_values(part, some), "is_fd": some.is_fd},
            {"data": some.data[:, :length]} if length else {},
        )
        named = replace(with_rows(part, rows), topic=block.topic + FD_SUFFIX)
        out.append(Outgoing(kind, named))
    return out
