"""Blocks of any log to ROS 2 messages: the way back from ``crosscue.replay.decode``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import Block, CanFrames, Images, Ledger, Messages, Table, Topic
from crosscue.replay.decode import Decoder, decoder_for
from crosscue.replay.decode.ros.definition import definitions_of
from crosscue.replay.decode.ros.type_names import ros2_spelling

from .can import can_messages
from .definitions import completed, standard_text
from .images import image_messages
from .outgoing import Encoder, Outgoing, Ros2Type, without_odd_times
from .ros1 import ros1_to_cdr
from .tables import OwnTypes, table_messages

__all__ = ["Encoder", "Encoders", "Outgoing", "Ros2Type"]


@runtime_checkable
class Walking(Protocol):
    """A decoder that can tell which messages fit their definition."""

    def walked(
        self, block: Block, messages: Messages, ledger: Ledger
    ) -> tuple[object, NDArray[np.intp]]:
        """Fields of the messages that fit, and which of the block they are."""
        ...


@dataclass(slots=True)
class Encoders:
    """Encoders of the topics of one file, which share the types made for it."""

    types: OwnTypes = field(default_factory=OwnTypes)

    def encoder_for(self, topic: Topic) -> Encoder | None:
        """The encoder of ``topic``; None if its type is not known, so that ROS 2 cannot hold it.

        Raises:
            SchemaError: Its definition is damaged.
        """
        if topic.encoding == "cdr":
            return _cdr(topic)
        if topic.encoding == "ros1":
            return ros1_to_cdr(topic)
        decoder = decoder_for(topic)
        return None if decoder is None else _Columns(decoder, self.types)


def _cdr(topic: Topic) -> Encoder | None:
    decoder = decoder_for(topic)
    if not isinstance(decoder, Walking):
        return None
    name, encoding = ros2_spelling(topic.type_name), topic.schema_encoding
    if not topic.schema.strip() and not encoding:
        kind = Ros2Type(name, standard_text(name).encode())
    elif encoding == "ros2msg":
        known = definitions_of(name, topic.schema, encoding)
        kind = Ros2Type(name, completed(name, topic.schema, known))
    else:
        kind = Ros2Type(name, topic.schema, encoding)
    return _AsStored(kind, decoder)


@dataclass(frozen=True, slots=True)
class _AsStored:
    """CDR messages stay as they are, byte for byte, if they fit their definition.

    Those that do not would make other readers refuse the whole file.
    """

    type: Ros2Type
    decoder: Walking

    def __call__(self, block: Block, ledger: Ledger) -> list[Outgoing]:
        assert isinstance(block.rows, Messages)
        _, kept = self.decoder.walked(block, block.rows, ledger)
        if not len(kept):
            return []
        return [Outgoing(self.type, block if len(kept) == len(block) else block.take(kept))]


@dataclass(frozen=True, slots=True)
class _Columns:
    """Decode to columns first, then write them in ROS 2's types."""

    decoder: Decoder
    types: OwnTypes

    def __call__(self, block: Block, ledger: Ledger) -> list[Outgoing]:
        columns = without_odd_times(self.decoder(block, ledger), ledger)
        if not len(columns):
            return []
        rows = columns.rows
        if isinstance(rows, CanFrames):
            return can_messages(columns, rows, ledger)
        if isinstance(rows, Images):
            return image_messages(columns, rows, ledger)
        assert isinstance(rows, Table)
        return table_messages(columns, rows, self.types, ledger)
