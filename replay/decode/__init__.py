"""Decode messages into columns, with one decoder per message encoding.

``decoder_for(topic)`` returns a function from a block of ``Messages`` to a block of ``CanFrames``,
``Table`` or ``Images`` with ``header_ns``. Messages that cannot be decoded are counted in the
ledger.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Final, Protocol, cast

from crosscue.replay.columns import Block, Topic
from crosscue.replay.ledger import Ledger

from .interfaces import is_feedback, is_service_event

__all__ = ["Decoder", "decoder_for"]


class Decoder(Protocol):
    """Function from a block as read to a block of columns of the decoded rows."""

    def __call__(self, block: Block, ledger: Ledger, /) -> Block:
        """Decode a block; blocks that are columns already are returned unchanged.

        Messages that do not fit are skipped in ``ledger`` with reason, count and time.
        """


# Factories by message encoding, as ``module:function``. Each maps a topic to a decoder or None.
BY_ENCODING: Final[Mapping[str, str]] = {
    "columns": "crosscue.replay.decode:_as_it_is",
    "cdr": "crosscue.replay.decode.ros.decoder:ros_decoder",
    "ros1": "crosscue.replay.decode.ros.decoder:ros_decoder",
    "protobuf": "crosscue.replay.decode.protobuf:protobuf_decoder",
    "json": "crosscue.replay.decode.json_text:json_decoder",
}


def decoder_for(topic: Topic) -> Decoder | None:
    """Return the decoder of ``topic``, or None if its encoding or type is unsupported.

    Service events have none; ``interfaces.why_not_decoded`` returns the reason.

    Raises:
        SchemaError: The log defines the type, but the definition is damaged, too large, or
            contradicts the type's name.
    """
    maker = BY_ENCODING.get(topic.encoding)
    if is_service_event(topic) or (is_feedback(topic) and not topic.schema.strip()):
        maker = None
    if maker is None:
        return None
    module, _, function = maker.partition(":")
    make = cast("Callable[[Topic], Decoder | None]", getattr(import_module(module), function))
    return make(topic)


def _as_it_is(topic: Topic) -> Decoder:
    return _unchanged


def _unchanged(block: Block, ledger: Ledger) -> Block:
    return block
