"""One topic of a log over a span of time, decoded: what a plot or a notebook asks for.

Only what the log's index says may hold it is read; see ``Log.read``.
"""

from __future__ import annotations

from dataclasses import dataclass

from crosscue.replay.remote.logs import name_of

from .columns import Block, Topic
from .decode import decoder_for
from .errors import UsageError
from .ledger import Ledger
from .log import Log, Selection


@dataclass(frozen=True, slots=True, eq=False)
class TopicPart:
    """Rows of one topic.

    Attributes:
        topic: Which.
        blocks: Its rows in stored order, in columns where the type is known, else as messages.
        ledger: What became of every row of the log in this pass.
    """

    topic: Topic
    blocks: tuple[Block, ...]
    ledger: Ledger

    def __len__(self) -> int:
        return sum(map(len, self.blocks))


def read_topic(
    log: Log, name: str, start_ns: int | None = None, end_ns: int | None = None
) -> TopicPart:
    """The rows of one topic with ``start_ns <= log time < end_ns``; all of it is held in memory.

    Args:
        log: An open log.
        name: Of the topic.
        start_ns: First log time wanted, or None for the log's beginning.
        end_ns: First log time no longer wanted, or None for the log's end.

    Raises:
        UsageError: The log has no such topic; the message lists those there are.
        SchemaError: The log's definition of the type is damaged.
    """
    topic = next((one for one in log.topics if one.name == name), None)
    if topic is None:
        known = ", ".join(one.name for one in log.topics)
        raise UsageError(f"{name_of(log)}: no topic {name!r}; there are: {known}")
    ledger, decode = Ledger(name_of(log)), decoder_for(topic)
    blocks = log.read(ledger, Selection(frozenset({name}), start_ns, end_ns))
    if decode is None:
        return TopicPart(topic, tuple(blocks), ledger)
    return TopicPart(topic, tuple(decode(block, ledger) for block in blocks), ledger)
