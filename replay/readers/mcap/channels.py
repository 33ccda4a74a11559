"""Mapping of channels to topics.

Channels with the same name, message type and encoding are one topic, whatever their numbers. If a
name is used with different types or encodings, the first one keeps the name. The others become
separate topics ``name#2``, ``name#3`` and so on, with a notice.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Final

from crosscue.replay.columns import Topic
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.chunks.rows import Definition

from .records import BrokenRecordError, Channel, Op, Schema, read_channel, read_schema

# Topic of messages whose channel is not declared.
UNKNOWN: Final = ""
# Name of a topic whose stored name is empty.
UNNAMED: Final = "(unnamed)"


class TopicBook:
    """All topics of a log, in order of their discovery; topics are only added."""

    def __init__(self, limits: Limits) -> None:
        self.topics: list[Topic] = []
        self.notices: dict[str, None] = {}
        self._limits = limits
        self._names: dict[Topic, str] = {}
        self._used: set[str] = set()
        self._variants: Counter[str] = Counter()

    def name(self, channel: Channel, schema: Schema | None) -> str:
        """Return the name of the topic of ``channel``, and add a new topic if necessary."""
        topic = self._topic(channel, schema)
        if topic not in self._names:
            self._names[topic] = name = self._free_name(topic)
            self._used.add(name)
            self.topics.append(replace(topic, name=name))
        return self._names[topic]

    def _topic(self, channel: Channel, schema: Schema | None) -> Topic:
        called = channel.topic or UNNAMED
        if schema is None:
            if channel.schema_id:
                self._report(f"{called}: its schema {channel.schema_id} is not in the file")
            return Topic(
                called, "", channel.message_encoding, converted_from=channel.converted_from
            )
        text = schema.text
        if len(text) > self._limits.schema_bytes:
            self._report(
                f"{called}: its schema has {len(text)} bytes, the limit is "
                f"{self._limits.schema_bytes}; messages are read without it"
            )
            text = b""
        return Topic(
            called,
            schema.name,
            channel.message_encoding,
            text,
            schema.encoding,
            converted_from=channel.converted_from,
        )

    def _free_name(self, topic: Topic) -> str:
        name = topic.name
        while name in self._used:
            self._variants[topic.name] += 1
            name = f"{topic.name}#{self._variants[topic.name] + 1}"
        if name != topic.name:
            what = topic.type_name or topic.encoding or "no type"
            self._report(f"{topic.name} has several message types; {what} becomes {name}")
        return name

    def _report(self, sentence: str) -> None:
        self.notices[sentence] = None


class Declarations:
    """The schemas and channels that are valid at a position of a file."""

    def __init__(
        self, book: TopicBook, schemas: Iterable[Schema] = (), channels: Iterable[Channel] = ()
    ) -> None:
        self._book = book
        self._schemas = {schema.id: schema for schema in schemas}
        self._channels = {channel.id: channel for channel in channels}
        self._seen: set[tuple[int, bytes]] = set()
        self._names: dict[int, str] = {}
        self.redefined: set[int] = set()

    @property
    def schemas(self) -> tuple[Schema, ...]:
        """The valid schemas."""
        return tuple(self._schemas.values())

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The valid channels."""
        return tuple(self._channels.values())

    @property
    def complete(self) -> frozenset[int]:
        """Numbers of the channels whose schema is declared too."""
        known = self._schemas.keys() | {0}
        return frozenset(c.id for c in self._channels.values() if c.schema_id in known)

    def changed_by(self, found: Definition) -> bool:
        """Return whether ``found`` changes the meaning of a declared number.

        Raises:
            BrokenRecordError: It is not a valid schema or channel.
        """
        if (found.opcode, found.content) in self._seen:
            return False
        if found.opcode == Op.CHANNEL:
            channel = read_channel(found.content)
            return self._channels.get(channel.id, channel) != channel
        schema = read_schema(found.content)
        return self._schemas.get(schema.id, schema) != schema

    def has(self, found: Definition) -> bool:
        """Return whether ``found`` repeats a valid schema or channel."""
        try:
            if found.opcode == Op.CHANNEL:
                channel = read_channel(found.content)
                return self._channels.get(channel.id) == channel
            schema = read_schema(found.content)
        except BrokenRecordError:
            return False
        return self._schemas.get(schema.id) == schema

    def declare(self, found: Definition) -> None:
        """Declare a schema or channel from here on.

        Raises:
            BrokenRecordError: It is not a valid schema or channel.
        """
        key = (found.opcode, found.content)
        if key in self._seen:
            return
        self._names.clear()
        if found.opcode == Op.CHANNEL:
            channel = read_channel(found.content)
            if self._channels.get(channel.id, channel) != channel:
                self.redefined.add(channel.id)
                self._seen.clear()
            self._channels[channel.id] = channel
        else:
            schema = read_schema(found.content)
            if self._schemas.get(schema.id, schema) != schema:
                self.redefined |= {
                    c.id for c in self._channels.values() if c.schema_id == schema.id
                }
                self._seen.clear()
            if schema.id:  # the format requires readers to ignore number 0
                self._schemas[schema.id] = schema
        self._seen.add(key)

    def declare_missing(self, channel: Channel, schema: Schema | None) -> None:
        """Declare a channel and its schema from a summary, unless the data section has them."""
        self._names.clear()
        self._channels.setdefault(channel.id, channel)
        if schema is not None:
            self._schemas.setdefault(schema.id, schema)

    def topic(self, channel_id: int) -> str:
        """Return the topic of a channel; ``UNKNOWN`` if it is not declared."""
        if channel_id not in self._names:
            channel = self._channels.get(channel_id)
            if channel is None:
                return UNKNOWN
            schema = self._schemas.get(channel.schema_id)
            self._names[channel_id] = self._book.name(channel, schema)
        return self._names[channel_id]

    def topics(self) -> Iterator[tuple[int, str]]:
        """Yield the number and the topic of every declared channel."""
        for channel_id in sorted(self._channels):
            yield channel_id, self.topic(channel_id)
