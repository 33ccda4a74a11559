"""Write the blocks of any log as one MCAP file with ROS 2 types, and account for every row."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, CanFrames, Images, Messages, Table, Topic
from crosscue.replay.decode import Decoder, decoder_for
from crosscue.replay.decode.interfaces import why_not_decoded
from crosscue.replay.decode.ros.definition import definitions_of
from crosscue.replay.decode.ros.type_names import ros2_spelling
from crosscue.replay.encode.can import can_messages
from crosscue.replay.encode.definitions import completed, standard_text
from crosscue.replay.encode.images import image_messages
from crosscue.replay.encode.outgoing import Encoder, Outgoing, Ros2Type, without_odd_times
from crosscue.replay.encode.ros1 import ros1_to_cdr
from crosscue.replay.encode.tables import OwnTypes, table_messages
from crosscue.replay.errors import SchemaError
from crosscue.replay.ledger import Ledger
from crosscue.replay.vehicle.roles import OF_TABLES

from .mcap import ChannelMessages, McapWriter

NO_TYPE: Final = "unknown type, which ROS 2 cannot store"
BAD_SCHEMA: Final = "its definition is damaged"
TOO_EARLY: Final = "time before 1970"


class LogWriter:
    """Writer of one log, to be used as a context manager.

    Call ``add_topic`` for every topic, then ``write`` blocks in any order: they are merged by log
    time within a window. ROS 2 messages are stored unchanged, ROS 1 messages are transcoded, and
    everything else is written with the types documented in ``crosscue.replay.encode``.
    """

    def __init__(
        self,
        path: Path,
        ledger: Ledger,
        *,
        overwrite: bool = False,
        beside: Sequence[str] = (),
    ) -> None:
        """Create a file, which has its final name once the writer is closed.

        Args:
            path: Final path of the file.
            ledger: Ledger of the log that is read; rows that cannot be written are skipped in it.
            overwrite: Replace an existing file.
            beside: As in ``McapWriter``.

        Raises:
            OutputError: ``path`` or a file beside it exists, or it cannot be written.
        """
        self.written: Counter[str] = Counter()
        """Number of messages by topic name in the file."""
        self.kept: Counter[str] = Counter()
        """Number of messages by topic name in the log."""
        self.types: dict[str, str] = {}
        """Types by topic name in the file."""
        self._ledger = ledger
        self._types = OwnTypes()
        self._known: dict[str, Encoder | str] = {}
        self._details: dict[str, str] = {}
        self._from: dict[str, str] = {}
        self._mcap = McapWriter(path, overwrite=overwrite, beside=beside)

    def add_topic(self, topic: Topic) -> bool:
        """Prepare a topic; False if ROS 2 cannot represent it, so that its rows will be skipped.

        A topic without rows is not written.
        """
        if topic.name in self._known:
            return not isinstance(self._known[topic.name], str)
        try:
            encoder: Encoder | str = encoder_for(topic, self._types) or why_not_decoded(
                topic, NO_TYPE
            )
            self._details[topic.name] = f"{topic.type_name} ({topic.encoding})"
            self._from[topic.name] = topic.converted_from or (
                topic.type_name if topic.encoding == "columns" else ""
            )
        except SchemaError as error:
            encoder = why_not_decoded(topic, BAD_SCHEMA)
            self._details[topic.name] = str(error)
        self._known[topic.name] = encoder
        return not isinstance(encoder, str)

    def write(self, block: Block) -> int:
        """Write a block of a topic that was added, and return the number of messages written.

        Raises:
            OutputError: The disk is full.
        """
        if not len(block):
            return 0
        encoder = self._known[block.topic]
        if isinstance(encoder, str):
            first = int(block.log_ns[0])
            self._ledger.skip(block.topic, encoder, len(block), self._details[block.topic], first)
            return 0
        block = self._without_early(block)
        count = 0
        for outgoing in encoder(block, self._ledger):
            self._put(outgoing)
            count += len(outgoing.block)
        self.kept[block.topic] += count
        return count

    def _without_early(self, block: Block) -> Block:
        """Return the block without times before 1970, which MCAP cannot store."""
        early = block.log_ns < 0
        if block.publish_ns is not None:
            early |= block.publish_ns < 0
        if not early.any():
            return block
        first = int(block.log_ns[early][0])
        self._ledger.skip(block.topic, TOO_EARLY, int(early.sum()), "", first)
        return block.take(~early)

    def _put(self, outgoing: Outgoing) -> None:
        block, kind = outgoing.block, outgoing.type
        assert isinstance(block.rows, Messages)
        of = self._from.get(block.topic, "")
        channel = self._mcap.add_channel(
            block.topic,
            kind.name,
            kind.schema,
            kind.schema_encoding,
            of if of in OF_TABLES and of != kind.name else "",
        )
        self.types[block.topic] = kind.name
        sequence = block.sequence
        if sequence is None:
            sequence = np.zeros(len(block), np.uint32)
        publish_ns = block.log_ns if block.publish_ns is None else block.publish_ns
        self._mcap.write(ChannelMessages(channel, block.log_ns, publish_ns, sequence, block.rows))
        self.written[block.topic] += len(block)

    def close(self) -> Mapping[str, int]:
        """Finish the file, and return the number of messages by topic.

        Raises:
            OutputError: The disk is full.
        """
        self._mcap.close()
        return self.written

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        self._mcap.__exit__(kind, *rest)


@runtime_checkable
class Walking(Protocol):
    """Decoder that can tell which messages fit their definition."""

    def walked(
        self, block: Block, messages: Messages, ledger: Ledger
    ) -> tuple[object, NDArray[np.intp]]:
        """Return the fields of the messages that fit, and their row numbers in the block."""


def encoder_for(topic: Topic, types: OwnTypes) -> Encoder | None:
    """Return the encoder of ``topic``; None if its type is unknown, so ROS 2 cannot store it.

    Raises:
        SchemaError: Its definition is damaged.
    """
    if topic.encoding == "cdr":
        return _cdr(topic)
    if topic.encoding == "ros1":
        return ros1_to_cdr(topic)
    decoder = decoder_for(topic)
    return None if decoder is None else _Columns(decoder, types)


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
    """Encoder that keeps CDR messages unchanged if they fit their definition.

    Messages that do not fit would make other readers refuse the complete file.
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
    """Encoder that decodes to columns first, then encodes them with types of ROS 2."""

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
