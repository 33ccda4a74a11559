"""Output of encoders: CDR messages of one topic with the definition of their type."""

from dataclasses import dataclass, replace
from functools import cache
from typing import Final, Protocol

import numpy as np

from crosscue.replay.columns import Block, Bytes, Int64s, Messages
from crosscue.replay.decode.ros.definition import Definitions, definitions_of, well_known
from crosscue.replay.decode.ros.plan import ParsingPlan, compile_plan
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger

from .definitions import standard_text, text_of

TIME_MISFIT: Final = "time does not fit a ROS 2 stamp"


@dataclass(frozen=True, slots=True)
class Ros2Type:
    """A ROS 2 message type.

    Attributes:
        name: Name in ROS 2 spelling.
        schema: Complete definition.
        schema_encoding: ``ros2msg`` or ``ros2idl``.
    """

    name: str
    schema: bytes
    schema_encoding: str = "ros2msg"


@dataclass(frozen=True, slots=True, eq=False)
class Outgoing:
    """Encoded messages ready to be stored.

    Attributes:
        type: Type of the messages.
        block: Topic, times and CDR messages.
    """

    type: Ros2Type
    block: Block


class Encoder(Protocol):
    """Function from a block as read to CDR messages."""

    def __call__(self, block: Block, ledger: Ledger, /) -> list[Outgoing]:
        """Encode a block; other rows are skipped in ``ledger`` with reason and time."""


@cache
def standard_type(name: str) -> tuple[Ros2Type, ParsingPlan]:
    """Return a type that ROS 2 or crosscue defines, with the plan of its CDR form."""
    known = well_known(name)
    if known is None:
        raise SchemaError(f"{name}: unknown type")
    return Ros2Type(name, standard_text(name).encode()), compile_plan(name, known, is_cdr=True)


def own_type(name: str, text: str) -> tuple[Ros2Type, ParsingPlan]:
    """Return a type of crosscue; the definitions of standard types in ``text`` are added."""
    known: dict[str, Definitions] = {}
    own = dict(definitions_of(name, text.encode(), "ros2msg"))
    for fields in list(own.values()):
        for field in fields:
            if "/" in field.type_name and field.type_name not in own:
                known[field.type_name] = well_known(field.type_name) or {}
    for definitions in known.values():
        own.update(definitions)
    return Ros2Type(name, text_of(name, own).encode()), compile_plan(name, own, is_cdr=True)


def with_rows(block: Block, rows: Bytes) -> Block:
    """Return the block with messages of one length, shape (N, bytes of one message)."""
    start = np.arange(len(rows), dtype=np.int64) * rows.shape[1]
    return replace(block, rows=Messages(rows.reshape(-1), start, start + rows.shape[1]))


def stamps(block: Block) -> Int64s:
    """Return the sensor's own times where known, else log times."""
    return block.log_ns if block.header_ns is None else block.header_ns


def without_odd_times(block: Block, ledger: Ledger) -> Block:
    """Return the rows whose stamps fit 32-bit seconds; the others are skipped."""
    seconds = stamps(block) // 1_000_000_000
    odd = (seconds < -(1 << 31)) | (seconds >= 1 << 31)
    if not odd.any():
        return block
    first = int(block.log_ns[odd][0])
    ledger.skip(block.topic, TIME_MISFIT, int(odd.sum()), "", first)
    return block.take(~odd)
