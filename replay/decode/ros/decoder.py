"""Decode ROS 2 CDR and ROS 1 messages, a block at a time."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, Bytes, Messages, Topic
from crosscue.replay.decode.refuse import MISFIT, WRONG_CODING, refuse
from crosscue.replay.decode.ros.definition import Definitions, definitions_of, well_known
from crosscue.replay.decode.ros.fields import FieldColumns, MessageBatch
from crosscue.replay.decode.ros.plan import ParsingPlan, compile_plan
from crosscue.replay.decode.ros.standard import Doubt, RosConversion, conversion_for, header_ns
from crosscue.replay.decode.ros.type_names import ros2_spelling
from crosscue.replay.decode.ros.walk import Bools, Rows, gather, heads_of, locate_fields
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger

CDR_BE: Final = 0x0000
CDR_LE: Final = 0x0001
# Encapsulations that DDS defines and that are not supported; any other number means damage.
OTHER_CODINGS: Final = (0x0002, 0x0003, *range(0x0006, 0x000C))


@dataclass(frozen=True, slots=True)
class RosDecoder:
    """Decoder of CDR or ROS 1 messages of one type into columns.

    Attributes:
        plan: Parsing plan of the type.
        kind: Conversion of the type to columns.
    """

    plan: ParsingPlan
    kind: RosConversion

    def __call__(self, block: Block, ledger: Ledger) -> Block:
        """Decode a block; messages that do not fit are counted in ``ledger``."""
        if not isinstance(block.rows, Messages):
            return block
        fields, kept = self.walked(block, block.rows, ledger)
        if self.kind.doubts is not None:
            good = _without_doubts(self.kind.doubts(fields), block, kept, ledger)
            if np.count_nonzero(good) < len(good):
                fields, kept = fields.take(good), kept[good]
        rows = self.kind.build(fields)
        picked = block if len(kept) == len(block) else block.take(kept)
        return Block(
            picked.topic, picked.log_ns, rows, picked.publish_ns, header_ns(fields), picked.sequence
        )

    def walked(self, block: Block, messages: Messages, ledger: Ledger) -> tuple[FieldColumns, Rows]:
        """Return the fields of the messages that fit, and their row numbers in the block.

        The others are dropped or skipped in ``ledger``, with reason and time.
        """
        parts, rows = [], []
        heads = heads_of(messages)
        for little, index in self._by_order(block, messages, heads, ledger):
            these = (messages, heads)
            if len(index) != len(messages):
                these = messages.take(index), heads[index]
            found = locate_fields(self.plan, *these, little=little)
            for refused, why in found.refused:
                _refuse(ledger, block, index[refused], MISFIT, why)
            fits = np.flatnonzero(found.ok) if found.refused else np.arange(len(index))
            parts.append(MessageBatch(found, fits))
            rows.append(index[fits] if found.refused else index)
        kept = rows[0] if len(rows) == 1 else np.concatenate(rows)
        order = None
        if len(parts) > 1:
            order = np.argsort(kept, kind="stable")
            kept = kept[order]
        return FieldColumns(self.plan, messages.buffer, tuple(parts), order), kept

    def _by_order(
        self, block: Block, messages: Messages, heads: Bytes, ledger: Ledger
    ) -> Iterator[tuple[bool, Rows]]:
        """Yield messages by byte order, and refuse those with an unsupported encapsulation."""
        everything = np.arange(len(messages))
        if not self.plan.is_cdr:
            yield True, everything
            return
        if heads.shape[1] >= 4 and not np.count_nonzero(heads[:, :2].view("<u2") != CDR_LE << 8):
            yield True, everything
            return
        has_head = messages.stop - messages.start >= 4
        head = np.full(len(messages), 0xFFFF, np.int64)
        head[has_head] = gather(messages.buffer, ">u2", 0, messages.start[has_head])
        little, big = head == CDR_LE, head == CDR_BE
        _refuse(ledger, block, everything[~has_head], MISFIT, "shorter than its encapsulation")
        other = has_head & ~little & ~big
        foreign = other & np.isin(head, OTHER_CODINGS)
        for which, reason in ((foreign, WRONG_CODING), (other & ~foreign, MISFIT)):
            if which.any():
                code = int(head[which][0])
                _refuse(ledger, block, everything[which], reason, f"representation 0x{code:04x}")
        if little.any() or not big.any():
            yield True, everything[little]
        if big.any():
            yield False, everything[big]


def _without_doubts(doubts: Iterable[Doubt], block: Block, kept: Rows, ledger: Ledger) -> Bools:
    good = np.ones(len(kept), np.bool_)
    for bad, reason in doubts:
        if not np.count_nonzero(bad):
            continue
        _refuse(ledger, block, kept[bad & good], reason, "")
        good &= ~bad
    return good


def _refuse(ledger: Ledger, block: Block, rows: Rows, reason: str, why: str) -> None:
    if len(rows):
        refuse(ledger, block, int(rows[0]), reason, why, len(rows))


def ros_decoder(topic: Topic) -> RosDecoder | None:
    """Return the decoder of a topic with encoding ``cdr`` or ``ros1``; None for unknown types.

    Raises:
        SchemaError: The definition does not parse, or contradicts its type's name.
    """
    name = ros2_spelling(topic.type_name)
    known: Definitions | None
    if topic.schema.strip():
        known = definitions_of(name, topic.schema, topic.schema_encoding)
    elif topic.schema_encoding:
        known = {name: ()}
    else:
        known = well_known(name) if topic.encoding == "cdr" else None
    if known is None:
        return None
    try:
        plan = compile_plan(name, known, is_cdr=topic.encoding == "cdr")
        kind = conversion_for(name)
        kind.check(plan)
    except SchemaError as error:
        raise SchemaError(f"{topic.name}: {error}") from None
    return RosDecoder(plan, kind)
