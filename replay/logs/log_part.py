"""Selection of a part of open logs: topics, and a time range in seconds after the first row."""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Final

from crosscue.replay.base import Log, Selection, start_ns
from crosscue.replay.errors import MissingTopicError, UsageError
from crosscue.verb import Option


def select_part(
    logs: Sequence[Log],
    start_s: float | None = None,
    end_s: float | None = None,
    topics: Iterable[str] | None = None,
) -> Selection:
    """Select the rows of ``topics`` from ``start_s`` to ``end_s`` (exclusive).

    Args:
        logs: Open logs of one drive; seconds count from the first row of the earliest log.
        start_s: Seconds after the first row, or None for the beginning.
        end_s: Seconds after the first row, exclusive, or None for the end.
        topics: Names of topics, or None for all.

    Raises:
        UsageError: A time is not finite, or the time range is empty.
        MissingTopicError: No log has a topic of that name, or no log has a row.
    """
    wanted = None if topics is None else named_topics(logs, topics)
    if start_s is None and end_s is None:
        return Selection(wanted)
    for name, value in (("start_s", start_s), ("end_s", end_s)):
        if value is not None and not math.isfinite(value):
            raise UsageError(f"{name}: {value}; expected seconds after the first row, 12.5")
    if start_s is not None and end_s is not None and end_s <= start_s:
        raise UsageError(f"end_s: {end_s} is not after start_s, {start_s}; try a later time")
    begin_ns = first_ns(logs)
    start_ns, end_ns = (
        None if value is None else begin_ns + round(value * 1e9) for value in (start_s, end_s)
    )
    return Selection(wanted, start_ns, end_ns)


@dataclass(frozen=True, slots=True)
class LogPart:
    """The part of a drive to read, as the command line names it.

    Attributes:
        begin: Start time: seconds from the first message (12.5), or absolute nanoseconds (17...ns).
        end: End time, exclusive, in the same form.
        topics: Read only these topics.
    """

    begin: Annotated[str | None, Option("--from", metavar="T")] = None
    end: Annotated[str | None, Option("--to", metavar="T")] = None
    topics: Sequence[str] | None = None

    def selected(self, logs: Sequence[Log]) -> Selection:
        """Return the selection of this part in open logs of one drive.

        Raises:
            UsageError: A time cannot be parsed, or the time range is empty.
            MissingTopicError: No log has a topic of that name, or no log has a row.
        """
        wanted = named_topics(logs, self.topics) if self.topics else None
        if self.begin is None and self.end is None:
            return Selection(wanted)
        start_ns = _time_ns("begin", self.begin, logs)
        end_ns = _time_ns("end", self.end, logs)
        if start_ns is not None and end_ns is not None and end_ns <= start_ns:
            raise UsageError(f"end: {self.end}, not after {self.begin}; try a later time")
        return Selection(wanted, start_ns, end_ns)


EVERY_PART: Final = LogPart()


def _time_ns(name: str, text: str | None, logs: Sequence[Log]) -> int | None:
    if text is None:
        return None
    if re.fullmatch(r"-?\d+ns", text):
        return int(text[:-2])
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise UsageError(
            f"{name}: {text}, expected seconds after the start (12.5) or absolute time (17...ns)"
        )
    return first_ns(logs) + round(seconds * 1e9)


def named_topics(logs: Sequence[Log], names: Iterable[str]) -> frozenset[str]:
    """Check that each name is a topic of one of the logs, and return the names.

    Raises:
        MissingTopicError: A topic is in no log; the message lists the available topics.
    """
    known = {topic.name for log in logs for topic in log.topics}
    wanted = frozenset(names)
    for name in sorted(wanted - known):
        raise MissingTopicError(
            f"topics: {name}, no such topic; there are: {', '.join(sorted(known))}"
        )
    return wanted


def first_ns(logs: Sequence[Log]) -> int:
    """Return the log time of the first stored row of the earliest log.

    Raises:
        MissingTopicError: No log contains a row.
    """
    starts = [start for start in map(start_ns, logs) if start is not None]
    if not starts:
        raise MissingTopicError(
            "begin, end: the log holds no row, so it has no start; leave them out"
        )
    return min(starts)
