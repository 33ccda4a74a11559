"""Read messages and signals directly from the text of a DBC file.

cantools reads everything that a DBC file may hold, but decoding needs a tenth of it. This reader
accepts the statements of DBC editors in their usual form, and extracts what decoding needs. For
anything else (a statement of another form, an escaped quote in a name, an identifier defined twice,
an unused entry) it returns None. cantools then reads the file or reports what is wrong with it.
Both readers produce the same messages.
"""

import re
from dataclasses import dataclass, field
from typing import Final

from .layout import CanMessage, CanSignal, is_integer

_NAME: Final = r"[A-Za-z_]\w*"
_NUM: Final = r"[-+]?\d+\.?\d*(?:[eE][+-]?\d+)?"
_TEXT: Final = r'"[^"\\]*"'
_LONG_TEXT: Final = r'"[^"\\]*+(?:\\[^\\][^"\\]*+)*+"'
_VALUE: Final = rf"(?:{_NUM}|{_LONG_TEXT})"
_KEYWORDS: Final = frozenset(
    {
        "BA_", "BA_DEF_", "BA_DEF_DEF_", "BA_DEF_DEF_REL_", "BA_DEF_REL_", "BA_DEF_SGTYPE_",
        "BA_REL_", "BA_SGTYPE_", "BO_", "BO_TX_BU_", "BS_", "BU_", "BU_BO_REL_", "BU_EV_REL_",
        "BU_SG_REL_", "CAT_", "CAT_DEF_", "CM_", "ENVVAR_DATA_", "EV_", "EV_DATA_", "FILTER",
        "NS_", "NS_DESC_", "SG_", "SG_MUL_VAL_", "SGTYPE_", "SGTYPE_VAL_", "SIG_GROUP_",
        "SIG_TYPE_REF_", "SIG_VALTYPE_", "SIGTYPE_VALTYPE_", "VAL_", "VAL_TABLE_", "VERSION",
    }
)  # fmt: skip
_FREE_NAME: Final = rf"(?!(?:{'|'.join(sorted(_KEYWORDS))})\b){_NAME}"
_STATEMENT: Final = re.compile(
    rf"""[ \r\n\t]+
    | //[^\n]*\n
    | SG_\s+(?P<sg>{_NAME})(?:\s+(?P<mux>M|m\d+M?))?\s*:\s*(?P<start>\d+)\s*\|\s*(?P<size>\d+)
      \s*@\s*(?P<order>\d+)\s*(?P<sign>[-+])\s*\(\s*(?P<scale>{_NUM})\s*,\s*(?P<offset>{_NUM})\s*\)
      \s*\[\s*(?P<min>{_NUM})\s*\|\s*(?P<max>{_NUM})\s*\]\s*(?P<unit>{_TEXT})
      \s*{_FREE_NAME}(?:\s*,\s*{_NAME})*+(?!\s*,)
    | BO_\s+(?P<bo>\d+)\s+(?P<bo_name>{_NAME})\s*:\s*(?P<bytes>0|[1-9]\d*)\s+{_FREE_NAME}
    | BA_\s+(?P<ba>{_TEXT})
      \s*(?:BO_\s+(?P<ba_bo>\d+)\s+|SG_\s+\d+\s+{_NAME}\s+|(?:BU_|EV_)\s+{_NAME}\s+)?
      (?P<ba_value>{_VALUE})\s*;
    | VAL_\s+(?:(?P<val_bo>\d+)\s+)?(?P<val>{_NAME})(?P<pairs>(?:\s*[-+]?\d+\s*{_TEXT})*+)\s*;
    | VAL_TABLE_\s+{_NAME}(?:\s*[-+]?\d+\s*{_LONG_TEXT})*+\s*;
    | CM_\s*(?:(?:SG_\s+\d+\s+{_NAME}|BO_\s+\d+|(?:EV_|BU_)\s+{_NAME})\s*)?{_LONG_TEXT}\s*;
    | SIG_VALTYPE_\s+(?P<type_bo>\d+)\s+(?P<type>{_NAME})\s*:\s*(?P<kind>\d+)\s*;
    | SG_MUL_VAL_\s+(?P<mul_bo>\d+)\s+(?P<mul>{_NAME})\s+(?P<switch>{_NAME})
      (?P<ranges>\s+\d+\s*-\d+(?:\s*,\s*\d+\s*-\d+)*+)\s*;
    | BA_DEF_DEF_\s+(?P<default>{_TEXT})\s*(?P<default_value>{_VALUE})\s*;
    | BA_DEF_\s+(?:(?:SG_|BO_|EV_|BU_)\s+)?(?P<attribute>{_TEXT})\s*(?P<attribute_type>[A-Z]+)
      \s*(?P<attribute_values>{_TEXT}(?:\s*,\s*{_TEXT})*+|(?:\s*{_NUM})*+)\s*;
    | BO_TX_BU_\s+\d+\s*:\s*{_NAME}(?:\s*,\s*{_NAME})*+\s*;
    | SIG_GROUP_\s+\d+\s+{_NAME}\s+\d+\s*:(?:\s*{_NAME})*+\s*;
    | (?:BA_REL_|BA_DEF_REL_|BA_DEF_DEF_REL_)\s+{_TEXT}(?:[^";]++|{_LONG_TEXT})*+;
    | (?P<bu>BU_)\s*:(?:\s*(?<![A-Za-z0-9_]){_FREE_NAME})*+
    | NS_\s*:(?:\s+{_NAME}\b(?!\s*:))*+
    | BS_\s*:
    | VERSION\s*{_TEXT}
    """,
    re.VERBOSE | re.ASCII,
)
_PAIR: Final = re.compile(rf"([-+]?\d+)\s*({_TEXT})", re.ASCII)
_TEXTS: Final = re.compile(_TEXT)
_RANGE: Final = re.compile(r"(\d+)\s*-(\d+)", re.ASCII)
_FLOATS: Final = (1, 2)
_UNUSED: Final = "VECTOR__INDEPENDENT_SIG_MSG"
_FORMAT: Final = "VFrameFormat"
_LONG_NAMES: Final = ("SystemMessageLongSymbol", "SystemSignalLongSymbol")
# Meanings of the numbers of ``VFrameFormat``, where a file declares it as a number.
_FORMATS: Final = (
    "StandardCAN", "ExtendedCAN", "reserved", "J1939PG", *["reserved"] * 10, "StandardCAN_FD",
    "ExtendedCAN_FD",
)  # fmt: skip


class _UnusualError(Exception):
    """A construct that is left to cantools."""


@dataclass(slots=True)
class _Message:
    """One ``BO_`` line, and the ``SG_`` lines of its signals."""

    stored: int
    name: str
    length: int
    lines: list[re.Match[str]] = field(default_factory=list)


@dataclass(slots=True)
class _Found:
    """Contents of all statements of a file."""

    messages: dict[int, _Message] = field(default_factory=dict)
    choices: dict[tuple[int, str], dict[int, str]] = field(default_factory=dict)
    kinds: dict[tuple[int, str], int] = field(default_factory=dict)
    switches: dict[int, dict[str, tuple[str, list[int]]]] = field(default_factory=dict)
    attributes: dict[str, tuple[str, str]] = field(default_factory=dict)
    defaults: dict[str, str] = field(default_factory=dict)
    formats: dict[int, str] = field(default_factory=dict)
    used: set[str] = field(default_factory=set)


def read_dbc(text: str) -> list[CanMessage] | None:
    """Read messages as cantools would, with signals in the order of their bits.

    Their ``source`` is the stored identifier, with its flag bit. ``problem`` is left empty.

    Returns:
        The messages, or None if the file contains anything unusual.
    """
    try:
        found = _statements(text)
        messages = [_message(one, found) for one in found.messages.values() if one.name != _UNUSED]
    except (_UnusualError, ValueError, OverflowError):
        return None
    is_used = not found.choices and not found.kinds and found.used <= found.attributes.keys()
    return messages if is_used else None


def _statements(text: str) -> _Found:
    found = _Found()
    message: _Message | None = None
    at = 0
    for match in _STATEMENT.finditer(text):
        if match.start() != at:
            raise _UnusualError
        at = match.end()
        kind = match.lastgroup
        if kind is None:
            continue
        if kind == "unit":
            if message is None or match["sg"] in _KEYWORDS or match["size"] == "0":
                raise _UnusualError
            message.lines.append(match)
        elif kind == "bytes":
            message = _new_message(match, found)
        else:
            message = None
            if kind == "kind":
                found.kinds[int(match["type_bo"]), match["type"]] = int(match["kind"])
            elif kind == "default_value":
                found.defaults[match["default"][1:-1]] = match["default_value"]
            elif kind != "bu":
                _ADD[kind](match, found)
    if at != len(text):
        raise _UnusualError
    return found


def _new_message(match: re.Match[str], found: _Found) -> _Message:
    stored = int(match["bo"])
    message = _Message(stored, match["bo_name"], int(match["bytes"]))
    if found.messages.setdefault(stored, message) is not message:
        raise _UnusualError
    return message


def _number(text: str) -> float:
    """Parse a number: an int if it is written as an integer, else a float."""
    try:
        return int(text)
    except ValueError:
        return float(text)


def _add_attribute(match: re.Match[str], found: _Found) -> None:
    name = match["ba"][1:-1]
    if name in _LONG_NAMES:
        raise _UnusualError
    found.used.add(name)
    if name == _FORMAT and match["ba_bo"]:
        found.formats[int(match["ba_bo"])] = match["ba_value"]


def _add_choices(match: re.Match[str], found: _Found) -> None:
    pairs = _PAIR.findall(match["pairs"])
    if match["val_bo"] and pairs:
        names = {int(value): text[1:-1] for value, text in pairs}
        found.choices[int(match["val_bo"]), match["val"]] = names


def _add_switch(match: re.Match[str], found: _Found) -> None:
    values = [
        value
        for low, high in _RANGE.findall(match["ranges"])
        for value in range(int(low), int(high) + 1)
    ]
    switches = found.switches.setdefault(int(match["mul_bo"]), {})
    if match["mul"] in switches:
        raise _UnusualError
    switches[match["mul"]] = match["switch"], values


def _add_definition(match: re.Match[str], found: _Found) -> None:
    name = match["attribute"][1:-1]
    if name in found.attributes:
        raise _UnusualError
    found.attributes[name] = match["attribute_type"], match["attribute_values"]


_ADD: Final = {
    "ba_value": _add_attribute,
    "pairs": _add_choices,
    "ranges": _add_switch,
    "attribute_values": _add_definition,
}


def _message(parsed: _Message, found: _Found) -> CanMessage:
    stored = parsed.stored
    is_extended = bool(stored >> 31)
    if stored >> 32 or (stored & 0x7FFFFFFF) >> (29 if is_extended else 11):
        raise _UnusualError
    names = {one["sg"] for one in parsed.lines}
    if parsed.name in _KEYWORDS or len(names) < len(parsed.lines):
        raise _UnusualError
    switches = found.switches.get(stored, {})
    _refuse_cycles(switches)
    multiplexers = [one["sg"] for one in parsed.lines if (one["mux"] or "").endswith("M")]
    only = multiplexers[0] if len(multiplexers) == 1 else None
    signals = [_signal(one, stored, found, only) for one in parsed.lines]
    signals.sort(key=lambda signal: signal.first_bit)
    return CanMessage(
        name=parsed.name,
        arbitration_id=stored & 0x7FFFFFFF,
        is_extended=is_extended,
        length=parsed.length,
        signals=tuple(signals),
        is_fd=_is_fd(stored, found),
        source=str(stored),
    )


def _signal(line: re.Match[str], stored: int, found: _Found, only: str | None) -> CanSignal:
    """Return the signal of a line; ``only`` is its message's multiplexer, if it has exactly one."""
    name, marker, start, size, order, sign, scale, offset, low, high, unit = line.group(
        "sg", "mux", "start", "size", "order", "sign", "scale", "offset", "min", "max", "unit"
    )
    choices = found.choices.pop((stored, name), None)
    is_float = found.kinds.pop((stored, name), 0) in _FLOATS
    has_range, is_multiplexer = not low == high == "0", (marker or "").endswith("M")
    # Ints where cantools returns ints.
    by, more = _number(scale), _number(offset)
    if choices is None and by == 1 and more == 0:
        by, more = 1, 0
    elif choices is None and not is_float and is_integer(by) and is_integer(more):
        by, more = int(by), int(more)
    switch, values = found.switches.get(stored, {}).get(name, (None, []))
    multiplexer = only or switch
    branches = set(values) if multiplexer is not None and switch == multiplexer else set()
    if only is not None and marker and not is_multiplexer:
        branches.add(int(marker[1:]))
    return CanSignal(
        name,
        int(start),
        int(size),
        order == "0",
        sign == "-",
        is_float,
        by,
        more,
        unit[1:-1],
        _number(low) if has_range else None,
        _number(high) if has_range else None,
        choices or {},
        is_multiplexer,
        multiplexer if marker and name != only else None,
        frozenset(branches),
    )


def _refuse_cycles(switches: dict[str, tuple[str, list[int]]]) -> None:
    for name in switches:
        above, steps = name, 0
        while above in switches:
            above, steps = switches[above][0], steps + 1
            if steps > len(switches):
                raise _UnusualError


def _is_fd(stored: int, found: _Found) -> bool | None:
    """Return whether a message is CAN FD, or None if the file does not distinguish them."""
    if _FORMAT not in found.attributes:
        return None
    kind, values = found.attributes[_FORMAT]
    choices: tuple[str, ...]
    default, value = found.defaults.get(_FORMAT), found.formats.get(stored)
    if kind == "ENUM":
        choices = tuple(text.strip('"') for text in _TEXTS.findall(values))
    elif kind == "INT" and default is not None:
        choices, default = _FORMATS, f'"{_FORMATS[_index(default, _FORMATS)]}"'
    else:
        raise _UnusualError
    used = choices[_index(value, choices)] if value is not None else (default or "").strip('"')
    return used.endswith("CAN_FD")


def _index(text: str, choices: tuple[str, ...]) -> int:
    if not text.isascii() or not text.isdigit() or int(text) >= len(choices):
        raise _UnusualError
    return int(text)
