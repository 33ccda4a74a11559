"""Decoder for ROS 2 CDR and ROS 1 messages: whole blocks at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, Messages, Topic
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger
from crosscue.replay.roles import ros2_spelling

from .definition import Definitions, definitions_of, well_known
from .fields import Fields, Part
from .plan import Plan, plan_of
from .standard import Doubt, Kind, header_ns, kind_of
from .walk import Bools, Rows, gather, walk

CDR_BE: Final = 0x0000
CDR_LE: Final = 0x0001
MISFIT: Final = "does not fit its schema"
WRONG_CODING: Final = "CDR representation not supported"


@dataclass(frozen=True, slots=True)
class RosDecoder:
    """From blocks of CDR or ROS 1 messages of one type to columns.

    Attributes:
        plan: How the type is walked.
        kind: What becomes of it.
    """

    plan: Plan
    kind: Kind

    def __call__(self, block: Block, ledger: Ledger) -> Block:
        """Decode; messages that do not fit are skipped in ``ledger`` with reason and time."""
        if not isinstance(block.rows, Messages):
            return block
        fields, kept = self.walked(block, block.rows, ledger)
        if self.kind.doubts is not None:
            good = _without_doubts(self.kind.doubts(fields), block, kept, ledger)
            fields, kept = fields.take(good), kept[good]
        rows = self.kind.build(fields)
        picked = block if len(kept) == len(block) else block.take(kept)
        return replace(picked, rows=rows, header_ns=header_ns(fields))

    def walked(self, block: Block, messages: Messages, ledger: Ledger) -> tuple[Fields, Rows]:
        """Fields of the messages that fit, and which of the block they are.

        The others are skipped in ``ledger`` with reason and time.
        """
        parts, rows = [], []
        for little, index in self._by_order(block, messages, ledger):
            whole = len(index) == len(messages)
            found = walk(self.plan, messages if whole else messages.take(index), little=little)
            for refused in found.refused:
                _skip(ledger, block, index[refused.rows], MISFIT, refused.why)
            fits = np.flatnonzero(found.ok)
            parts.append(Part(found, fits))
            rows.append(index[fits])
        kept = rows[0] if len(rows) == 1 else np.concatenate(rows)
        order = None
        if len(parts) > 1:
            order = np.argsort(kept, kind="stable")
            kept = kept[order]
        return Fields(self.plan, messages.buffer, tuple(parts), order), kept

    def _by_order(
        self, block: Block, messages: Messages, ledger: Ledger
    ) -> Iterator[tuple[bool, Rows]]:
        """Messages by byte order; those coded in a way that we cannot read are skipped."""
        everything = np.arange(len(messages))
        if not self.plan.is_cdr:
            yield True, everything
            return
        has_head = messages.stop - messages.start >= 4
        head = np.full(len(messages), 0xFFFF, np.int64)
        head[has_head] = gather(messages.buffer, ">u2", 0, messages.start[has_head])
        little, big = head == CDR_LE, head == CDR_BE
        _skip(ledger, block, everything[~has_head], MISFIT, "shorter than its encapsulation")
        other = has_head & ~little & ~big
        if other.any():
            code = int(head[other][0])
            _skip(ledger, block, everything[other], WRONG_CODING, f"representation 0x{code:04x}")
        if little.any() or not big.any():
            yield True, everything[little]
        if big.any():
            yield False, everything[big]


def _without_doubts(doubts: Iterable[Doubt], block: Block, kept: Rows, ledger: Ledger) -> Bools:
    good = np.ones(len(kept), np.bool_)
    for bad, reason in doubts:
        _skip(ledger, block, kept[bad & good], reason, "")
        good &= ~bad
    return good


def _skip(ledger: Ledger, block: Block, rows: Rows, reason: str, why: str) -> None:
    if len(rows):
        ledger.skip(block.topic, reason, len(rows), why, int(block.log_ns[rows[0]]))


def ros_decoder(topic: Topic) -> RosDecoder | None:
    """The decoder of a topic with encoding ``cdr`` or ``ros1``; None if its type is not known.

    Raises:
        SchemaError: The definition does not parse, or lacks what its type's name promises.
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
        plan = plan_of(name, known, is_cdr=topic.encoding == "cdr")
        kind = kind_of(name)
        kind.check(plan)
    except SchemaError as error:
        raise SchemaError(f"{topic.name}: {error}") from None
    return RosDecoder(plan, kind)
