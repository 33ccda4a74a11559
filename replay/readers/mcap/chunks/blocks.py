"""Conversion of rows to blocks, with an account of every message."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.base import Selection
from crosscue.replay.columns import BLOCK_ROWS, Block, Int64s, Messages
from crosscue.replay.ledger import MESSAGE_TOO_LARGE, NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.mcap.channels import UNKNOWN, Declarations
from crosscue.replay.readers.mcap.checks import Checks
from crosscue.replay.readers.mcap.chunks.rows import Rows
from crosscue.replay.readers.mcap.records import MESSAGE_HEAD, BrokenRecordError, MessageIndex

UNDECLARED: Final = "message of a channel that the file does not declare"
TIME_TOO_LATE: Final = "log time after the year 2262 (2^63 ns or later)"
NO_PUBLISH_TIME: Final = (
    "publish times of 2^63 ns or later count as not available; the log time is used instead"
)
LATEST: Final = np.uint64((1 << 63) - 1)
Uint64s: TypeAlias = NDArray[np.uint64]


@dataclass(eq=False)
class BlockBuilder:
    """Converts the messages of one recording to blocks.

    Attributes:
        met: Number of messages found, by channel number.
        dropped: Number of messages known to be dropped, by channel number.
    """

    _ledger: Ledger
    _selection: Selection
    _limits: Limits
    declarations: Declarations
    met: Counter[int] = field(default_factory=Counter)
    dropped: Counter[int] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self._is_timeless = not self._selection.is_timed

    def build(self, rows: Rows, checks: Checks, at: int) -> Iterator[Block]:
        """Yield the messages of ``rows``, one block per topic, by the channels valid there.

        Args:
            rows: Messages and definitions of a chunk or a run, with verified bytes.
            checks: Records definitions that cannot be read.
            at: Offset of the chunk or run in the file.
        """
        begin = 0
        for found in rows.definitions:
            try:
                if self.declarations.changed_by(found):
                    rows = rows.in_stored_order()
                    end = int(np.searchsorted(rows.offset, found.at))
                    yield from self._build_part(rows.take(slice(begin, end)))
                    begin = end
                self.declarations.declare(found)
            except BrokenRecordError as error:
                checks.bad_definitions.add(f"in the chunk or record at byte {at}: {error}")
        yield from self._build_part(rows.take(slice(begin, None)) if begin else rows)

    def drop(self, rows: Rows, reason: str, detail: str) -> None:
        """Drop all messages of ``rows``."""
        channels, counts = np.unique(rows.channel, return_counts=True)
        for channel_id, count in zip(channels.tolist(), counts.tolist(), strict=True):
            self.drop_of_channel(channel_id, reason, count, detail, None)

    def drop_of_channel(
        self, channel_id: int, reason: str, count: int, detail: str, t_ns: int | None
    ) -> None:
        """Drop ``count`` messages of a channel."""
        self.dropped[channel_id] += count
        self._ledger.drop(self.declarations.topic(channel_id), reason, count, detail, t_ns)

    def wants(self, index: MessageIndex) -> bool:
        """Return whether any of these messages is selected."""
        if not self._selection.wants(self.declarations.topic(index.channel_id)):
            return False
        return self._is_timeless or bool(self._in_time(index.entries["log"]).any())

    def skip_unread(self, index: MessageIndex) -> None:
        """Account for unselected messages without reading them."""
        count = index.count
        self.met[index.channel_id] += count
        self._account(self.declarations.topic(index.channel_id), index.entries["log"])

    def skip_counted(self, channel_id: int, count: int) -> None:
        """Account for messages in unread chunks, by the counts of the statistics."""
        self.met[channel_id] += count
        self._selection.leave(self.declarations.topic(channel_id), count, self._ledger)

    def skip_oversized(self, channel_id: int, log: int, size: int, at: int) -> None:
        """Account for a message outside chunks that exceeds the size limit."""
        self.met[channel_id] += 1
        topic = self.declarations.topic(channel_id)
        kept = self._account(topic, np.array([log], dtype=np.uint64))
        if kept is None or len(kept):
            self._ledger.skip(topic, MESSAGE_TOO_LARGE, 1, self._too_large(size, at), log)

    def _build_part(self, rows: Rows) -> Iterator[Block]:
        if not len(rows):
            return
        rows, parts = self._by_topic(rows)
        start = rows.offset + MESSAGE_HEAD.itemsize
        for topic, index in parts:
            yield from self._blocks(topic, rows, start, index)

    def _by_topic(self, rows: Rows) -> tuple[Rows, list[tuple[str, NDArray[np.intp] | slice]]]:
        """Group the messages by topic, in stored order and by each topic's first message."""
        if rows.groups:
            parts = {self.declarations.topic(number): part for number, part in rows.groups}
            if len(parts) == len(rows.groups):
                for channel_id, part in rows.groups:
                    self.met[channel_id] += part.stop - part.start
                names = sorted(parts, key=lambda topic: int(rows.offset[parts[topic].start]))
                return rows, [(topic, parts[topic]) for topic in names]
            rows = rows.in_stored_order()
        channel = rows.channel.astype(np.intp)
        counts = np.bincount(channel)
        numbers: dict[str, int] = {}
        number_of = np.empty(len(counts), dtype=np.uint16)
        for channel_id in np.flatnonzero(counts).tolist():
            self.met[channel_id] += int(counts[channel_id])
            topic = self.declarations.topic(channel_id)
            number_of[channel_id] = numbers.setdefault(topic, len(numbers))
        if len(numbers) == 1:
            return rows, [(next(iter(numbers)), slice(None))]
        number = number_of[channel]
        order = np.argsort(number, kind="stable")
        edges = [0, *np.cumsum(np.bincount(number)).tolist()]
        picked = [(topic, order[edges[k] : edges[k + 1]]) for topic, k in numbers.items()]
        picked.sort(key=lambda one: int(one[1][0]))
        return rows, list(picked)

    def _blocks(
        self, topic: str, rows: Rows, starts: Int64s, index: NDArray[np.intp] | slice
    ) -> Iterator[Block]:
        log, publish, sequence = rows.log[index], rows.publish[index], rows.sequence[index]
        start, stop = starts[index], rows.stop[index]
        if topic == UNKNOWN:
            named = ", ".join(str(i) for i in np.unique(rows.channel)[:10].tolist())
            self._ledger.drop(UNKNOWN, UNDECLARED, len(log), f"among the channels {named}")
            return
        kept = self._account(topic, log)
        if kept is not None:
            log, publish, start, stop = log[kept], publish[kept], start[kept], stop[kept]
            sequence = sequence[kept]
        if len(rows.buffer) > self._limits.message_bytes:
            small = stop - start <= self._limits.message_bytes
            for i in np.flatnonzero(~small).tolist():
                detail = self._too_large(int(stop[i] - start[i]), None)
                self._ledger.skip(topic, MESSAGE_TOO_LARGE, 1, detail, int(log[i]))
            log, publish, start, stop = log[small], publish[small], start[small], stop[small]
            sequence = sequence[small]
        if len(publish) and np.maximum.reduce(publish) > LATEST:
            self._ledger.notice(f"{topic}: {NO_PUBLISH_TIME}")
            publish = np.where(publish > LATEST, log, publish)
        for i in range(0, len(log), BLOCK_ROWS):
            part = slice(i, i + BLOCK_ROWS)
            yield Block(
                topic,
                log[part].view(np.int64),
                Messages(rows.buffer, start[part], stop[part]),
                publish[part].view(np.int64),
                sequence=sequence[part],
            )

    def _account(self, topic: str, log: Uint64s) -> NDArray[np.intp] | None:
        """Account for messages of one topic; return the selected indices, or None for all."""
        self._ledger.find(topic, len(log))
        if not self._selection.wants(topic):
            self._ledger.skip(topic, NOT_ASKED_TOPIC, len(log))
            return np.empty(0, dtype=np.intp)
        if self._is_timeless and np.maximum.reduce(log) <= LATEST:
            return None
        late = int((log > LATEST).sum())
        if late:
            self._ledger.skip(
                topic, TIME_TOO_LATE, late, f"the first: {int(log[log > LATEST][0])} ns"
            )
        kept = np.flatnonzero(self._in_time(log))
        self._ledger.skip(topic, NOT_ASKED_TIME, len(log) - late - len(kept))
        return kept

    def _in_time(self, log: Uint64s) -> NDArray[np.bool_]:
        """Return a mask of the log times that are valid and selected."""
        return (log <= LATEST) & self._selection.inside(log)

    def _too_large(self, size: int, at: int | None) -> str:
        where = "" if at is None else f" at byte {at}"
        return f"{size} bytes{where}, the limit is {self._limits.message_bytes}"
