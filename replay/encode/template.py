"""Write CDR messages of one layout as rows of a byte array.

Strings and sequence lengths are equal in all rows, so that every value has a fixed position. A
template is written once and repeated, and the columns are then written into it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.decode.ros.plan import FixedFields, Items, ParsingPlan, Text

ENCAPSULATION: Final = b"\x00\x01\x00\x00"


@dataclass(frozen=True, slots=True)
class Template:
    """A message without its numbers.

    Attributes:
        row: Bytes of the message.
        places: First byte of each value, by path.
        items: First byte of each sequence's items, by path.
    """

    row: bytes
    places: Mapping[str, int]
    items: Mapping[str, int]


def template_of(
    plan: ParsingPlan,
    texts: Mapping[str, str] | None = None,
    counts: Mapping[str, int] | None = None,
) -> Template:
    """Create the template of a message.

    Args:
        plan: Plan of the type in CDR.
        texts: Strings by path; others are empty.
        counts: Lengths of sequences of numbers by path; others are empty.
    """
    making = _Builder()
    for step in plan.steps:
        if isinstance(step, FixedFields):
            making.run(step)
        elif isinstance(step, Text):
            making.text((texts or {}).get(step.path, ""))
        else:
            making.sequence(step, (counts or {}).get(step.path, 0))
    return Template(ENCAPSULATION + bytes(making.body), making.places, making.items)


@dataclass(slots=True)
class _Builder:
    body: bytearray = field(default_factory=bytearray)
    places: dict[str, int] = field(default_factory=dict)
    items: dict[str, int] = field(default_factory=dict)

    def run(self, run: FixedFields) -> None:
        modulo, begin = len(self.body) & 7, len(self.body) + len(ENCAPSULATION)
        for k, value in enumerate(run.values):
            self.places[value.path] = begin + int(run.place[modulo, k])
        self.body += bytes(int(run.size[modulo]))

    def text(self, text: str) -> None:
        raw = text.encode("utf-8") + b"\x00"
        self._length(len(raw))
        self.body += raw

    def sequence(self, step: Items, count: int) -> None:
        if step.count is not None or (count and not step.code):
            raise ValueError(f"{step.path}: only sequences of numbers are supported")
        self._length(count)
        width = int(step.code[1]) if step.code else 1
        if count:
            self.body += bytes(-len(self.body) % width)
        self.items[step.path] = len(self.body) + len(ENCAPSULATION)
        self.body += bytes(count * width)

    def _length(self, length: int) -> None:
        self.body += bytes(-len(self.body) % 4)
        self.body += length.to_bytes(4, "little")


def filled(
    plan: ParsingPlan,
    template: Template,
    size: int,
    values: Mapping[str, NDArray[np.generic]],
    items: Mapping[str, NDArray[np.generic]] | None = None,
) -> NDArray[np.uint8]:
    """Return ``size`` messages with their numbers, shape (size, bytes of one message).

    Args:
        plan: Plan of the template.
        template: Template of the messages.
        size: Number of messages.
        values: Columns by path, shape (size,) or (size, k); times as int64 nanoseconds.
        items: Contents of sequences by path, shape (size, count).
    """
    rows = np.tile(np.frombuffer(template.row, np.uint8), (size, 1))
    for path, column in values.items():
        code = plan.values[path].code
        if code == "time":
            _put_time(rows, template.places[path], column)
        else:
            _put(rows, template.places[path], column, "<" + code)
    for path, content in (items or {}).items():
        _put(rows, template.items[path], content, "<" + plan.sequences[path].code)
    return rows


def _put(rows: NDArray[np.uint8], at: int, column: NDArray[np.generic], code: str) -> None:
    raw = np.ascontiguousarray(column.astype(code)).view(np.uint8).reshape(len(rows), -1)
    rows[:, at : at + raw.shape[1]] = raw


def _put_time(rows: NDArray[np.uint8], at: int, t_ns: NDArray[np.generic]) -> None:
    seconds, rest = np.divmod(t_ns.astype(np.int64), 1_000_000_000)
    _put(rows, at, seconds, "<i4")
    _put(rows, at + 4, rest, "<u4")
