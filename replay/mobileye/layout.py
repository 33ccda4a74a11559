"""Table of the messages and signals of a Mobileye 560 on CAN, stored in ``layout.toml``."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.errors import SchemaError
from crosscue.replay.files.tree_text import toml_tree

Column: TypeAlias = NDArray[np.generic]
# Columns of a message's fields, or of a table, by name.
Columns: TypeAlias = dict[str, Column]
Kind: TypeAlias = Literal["real", "code", "flag"]
Beyond: TypeAlias = Literal["refuse", "clip", "drop"]

# Variants named by ``only``; a frame's variant is an index in this tuple, or ``UNKNOWN``.
VARIANTS: Final = ("classic", "2.32", "extended", "tsr", "basic")
# Messages whose frames together are an obstacle, or a lane, by table.
OBSTACLE_PARTS: Final = ("obstacle_a", "obstacle_b", "obstacle_c")
LANE_PARTS: Final = {"lanes": ("lane_a", "lane_b"), "next_lanes": ("next_lane_a", "next_lane_b")}
UNKNOWN: Final = -1
# Variant of each frame as an index in ``VARIANTS``, or ``UNKNOWN``; shape (N,).
Variant: TypeAlias = NDArray[np.int8]
WORD_BITS: Final = 64


@dataclass(frozen=True, slots=True)
class BitField:
    """One signal: the position of its bits and their meaning.

    Value on the wire = (raw - zero) * scale / per. The head of ``layout.toml`` explains each key.
    """

    name: str
    start: int
    bits: int
    signed: bool = False
    order: Literal["little", "big"] = "little"
    scale: float = 1.0
    per: float = 1.0
    zero: float = 0.0
    unit: str = ""
    missing: tuple[int, ...] = ()
    missing_with: str = ""
    needs: str = ""
    low: float | None = None
    high: float | None = None
    beyond: Beyond = "refuse"
    only: str = ""
    flip: bool = False
    fill: int = 0
    default: int = 0
    ros: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        """Refuse an invalid field."""
        whole_bytes = self.start % 8 == 0 and self.bits % 8 == 0
        if self.bits < 1 or self.start < 0 or self.start + self.width > WORD_BITS:
            raise SchemaError(f"{self.name}: bits {self.start}+{self.width} do not fit 8 bytes")
        if self.order == "big" and not whole_bytes:
            raise SchemaError(f"{self.name}: a big-endian field must consist of complete bytes")
        if self.only and self.only not in VARIANTS:
            raise SchemaError(f"{self.name}: only {self.only!r}; there are: {', '.join(VARIANTS)}")

    @property
    def kind(self) -> Kind:
        """Kind of its column: float64, int16 or a flag."""
        if self.unit:
            return "real"
        return "flag" if self.bits == 1 else "code"

    @property
    def width(self) -> int:
        """Number of bits written when encoding."""
        return max(self.bits, self.fill)

    @property
    def may_be_missing(self) -> bool:
        """True if it may be missing in a frame."""
        return bool(self.missing or self.missing_with or self.needs or self.only)

    @property
    def raw_range(self) -> tuple[int, int]:
        """Smallest and largest raw number without codes for a missing value."""
        lowest, highest = 0, (1 << self.bits) - 1
        if self.signed:
            lowest, highest = -(1 << (self.bits - 1)), (1 << (self.bits - 1)) - 1
        if self.low is not None:
            lowest = round(self.low * self.per / self.scale + self.zero)
        if self.high is not None:
            highest = round(self.high * self.per / self.scale + self.zero)
        while lowest in self.missing:
            lowest += 1
        while highest in self.missing:
            highest -= 1
        return lowest, highest


@dataclass(frozen=True, slots=True)
class Message:
    """One kind of frame, with one or several instances.

    Attributes:
        name: Name in this table.
        about: Short description of its content.
        table: Table of its columns.
        ids: Identifier of each instance (obstacle slot, lane side, position of a sign).
        lengths: Valid payload lengths.
        fields: Its signals.
        variant: Property that selects among fields with ``only``.
        variants: Variant by length, if the length selects it.
        ros_type: Message of ``mobileye_560_660_msgs`` with the same content, or empty.
    """

    name: str
    about: str
    table: str
    ids: tuple[int, ...]
    lengths: tuple[int, ...]
    fields: tuple[BitField, ...]
    variant: Literal["", "length", "revision", "family"] = ""
    variants: Mapping[int, str] = field(default_factory=dict)
    ros_type: str = ""

    def __post_init__(self) -> None:
        """Refuse fields that overlap or do not fit the shortest payload that contains them."""
        for variant in {"", *(f.only for f in self.fields)}:
            taken = 0
            for f in self.fields:
                if f.only not in ("", variant):
                    continue
                mask = ((1 << f.width) - 1) << f.start
                if taken & mask:
                    raise SchemaError(f"{self.name}.{f.name}: its bits overlap another field")
                if f.start + f.bits > 8 * self._shortest(f.only):
                    raise SchemaError(f"{self.name}.{f.name}: does not fit the payload")
                taken |= mask

    def _shortest(self, only: str) -> int:
        lengths = [n for n in self.lengths if self.variants.get(n, only) == only or not only]
        return min(lengths, default=0)

    def length_of(self, variant: str) -> int:
        """Return the payload length for encoding ``variant``, which is the longest that fits."""
        named = [n for n, name in self.variants.items() if name == variant]
        return max(named or self.lengths)


class LayoutRow(NamedTuple):
    """One row of the printed table: a field in all instances of its message."""

    ids: str
    lengths: str
    table: str
    column: str
    bits: str
    value: str
    unit: str
    missing: str
    only: str
    note: str


@cache
def layout() -> Mapping[str, Message]:
    """Return all messages by name, in the order of the file, which is read once.

    Raises:
        SchemaError: The installed file is damaged.
    """
    text = files(__package__).joinpath("layout.toml").read_text(encoding="utf-8")
    try:
        return parse_layout(text)
    except (ValueError, KeyError, TypeError) as error:
        raise SchemaError(f"layout.toml: {error}; install crosscue again") from None


def parse_layout(text: str) -> Mapping[str, Message]:
    """Parse a layout from TOML text.

    Raises:
        SchemaError: Fields overlap or are invalid.
        KeyError: A message lacks a key.
        TypeError: A message or field has an unknown key.
    """
    entries: list[dict[str, Any]] = toml_tree(text)["message"]
    messages: dict[str, Message] = {}
    for entry in entries:
        messages[entry["name"]] = _message(dict(entry), messages)
    claimed = [i for m in messages.values() for i in m.ids]
    if len(set(claimed)) != len(claimed):
        raise SchemaError("layout.toml: two messages have the same identifier")
    return MappingProxyType(messages)


def _message(entry: dict[str, Any], earlier: Mapping[str, Message]) -> Message:
    ids = entry.pop("ids", None)
    if ids is None:
        first, stride = entry.pop("id"), entry.pop("stride", 1)
        ids = [first + k * stride for k in range(entry.pop("count", 1))]
    if "same_as" in entry:
        other = earlier[entry.pop("same_as")]
        fields, entry["ros_type"] = other.fields, other.ros_type
    else:
        fields = tuple(_field(f) for f in entry.pop("fields"))
    variants = {int(k): str(v) for k, v in entry.pop("variants", {}).items()}
    lengths = tuple(entry.pop("lengths"))
    return Message(
        ids=tuple(ids), lengths=lengths, fields=fields, variants=MappingProxyType(variants), **entry
    )


def _field(entry: Mapping[str, Any]) -> BitField:
    missing = tuple(entry.get("missing", ()))
    return BitField(**{**entry, "missing": missing})


def describe() -> Iterator[LayoutRow]:
    """Yield the layout for display, one row for each field."""
    for message in layout().values():
        ids = ", ".join(f"0x{i:03X}" for i in message.ids[:3]) + (
            f", ... 0x{message.ids[-1]:03X}" if len(message.ids) > 3 else ""
        )
        for f in message.fields:
            yield LayoutRow(
                ids,
                "/".join(str(n) for n in message.lengths),
                message.table,
                f.name,
                f"{f.start}+{f.bits}{' signed' if f.signed else ''}",
                _formula(f),
                f.unit,
                ", ".join(str(code) for code in f.missing),
                f.only,
                f.note,
            )


def _formula(f: BitField) -> str:
    raw = "raw" if not f.zero else f"(raw - {f.zero:g})"
    scaled = raw if f.scale == 1.0 else f"{raw} * {f.scale:g}"
    return scaled if f.per == 1.0 else f"{scaled} / {f.per:g}"


def unit_of(f: BitField) -> str:
    """Return the unit of a column unless its name includes it, as for ``Table.units``."""
    return f.unit.rstrip("?") + " (unverified)" if f.unit.endswith("?") else ""


def variant_number(name: str) -> int:
    """Return the index of a variant in ``VARIANTS``, or ``UNKNOWN``."""
    return VARIANTS.index(name) if name in VARIANTS else UNKNOWN
