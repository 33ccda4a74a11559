"""Parse message definitions: ROS 1 and ROS 2 ``.msg`` text, and ROS 2 IDL.

A definition comes from the log and is not trusted. Its size is checked first, and no code is
generated from it.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cache
from typing import Final

from crosscue.replay.decode.ros.type_names import ros2_spelling
from crosscue.replay.errors import SchemaError
from crosscue.replay.limits import DEFAULT_LIMITS

# NumPy codes of primitive types; ``byte`` is signed and ``char`` is not, in ROS 1 and ROS 2.
PRIMITIVES: Final[Mapping[str, str]] = {
    "bool": "u1",
    "byte": "i1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}

TIME: Final = "builtin_interfaces/msg/Time"
DURATION: Final = "builtin_interfaces/msg/Duration"
# Max size of IDL text; its general parser takes about a second for this size.
IDL_BYTES: Final = 64 << 10


class Multiplicity(Enum):
    """Multiplicity of a field."""

    ONE = "one"
    ARRAY = "array"
    SEQUENCE = "sequence"


@dataclass(frozen=True, slots=True)
class MessageField:
    """One field of a message.

    Attributes:
        name: Name as spelled in the definition.
        type_name: A key of ``PRIMITIVES``, ``string``, or a message name in ROS 2 spelling.
        shape: One value, an array of ``size`` values, or a sequence.
        size: Length of an array; max items of a sequence, 0 for no bound.
        text_bound: Max characters of a string, 0 for no bound.
    """

    name: str
    type_name: str
    shape: Multiplicity = Multiplicity.ONE
    size: int = 0
    text_bound: int = 0


Definitions = Mapping[str, tuple[MessageField, ...]]

_SEPARATOR: Final = re.compile(r"^={40,}[ \t\r]*$", re.MULTILINE)
_ACTION_PART: Final = re.compile(r"^---[ \t\r]*$", re.MULTILINE)
_FIELD: Final = re.compile(
    r"(?P<type>[A-Za-z][\w/]*)(?:<=(?P<text>\d{1,10}))?"
    r"(?P<array>\[(?P<most><=)?(?P<size>\d{0,10})\])?"
    r"[ \t]+(?P<name>[A-Za-z]\w*)[ \t]*(?P<rest>.*)"
)
_IDL_SKIP: Final = re.compile(r'/\*|//|"')
_IDL_ANNOTATION: Final = re.compile(r"@\w{1,64}\s{0,8}\([^()]{0,4000}\)")
_ANNOTATION: Final = re.compile(r"(?:@\w{1,64}(?:\([^)]{0,200}\))?[ \t]*){0,16}")


def definitions_of(type_name: str, schema: bytes, schema_encoding: str) -> Definitions:
    """Return all types that a schema defines, by name in ROS 2 spelling.

    Args:
        type_name: Message type of the schema.
        schema: Text as stored in the log.
        schema_encoding: ``ros1msg``, ``ros2msg`` or ``ros2idl``.

    Raises:
        SchemaError: The text is too large, not UTF-8, or does not parse; the message names the
            line.
    """
    if len(schema) > DEFAULT_LIMITS.schema_bytes:
        raise SchemaError(
            f"{type_name}: definition has {len(schema)} bytes, over the limit of "
            f"{DEFAULT_LIMITS.schema_bytes}"
        )
    try:
        text = schema.decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise SchemaError(f"{type_name}: definition is not UTF-8 text ({error.reason})") from None
    if schema_encoding in ("ros1msg", "ros2msg"):
        text = _feedback_of_action(type_name, text)
        return _from_msg(ros2_spelling(type_name), text)
    if schema_encoding in ("ros2idl", "omgidl"):
        return _from_idl(type_name, text)
    raise SchemaError(f"{type_name}: expected ros1msg, ros2msg or ros2idl, got {schema_encoding!r}")


def _from_msg(type_name: str, text: str) -> Definitions:
    sections = _SEPARATOR.split(text)
    raw: dict[str, tuple[MessageField, ...]] = {}
    for i, section in enumerate(sections):
        name, body = type_name, section
        if i:
            head, _, body = section.lstrip().partition("\n")
            if not head.startswith("MSG:"):
                raise SchemaError(
                    f"{type_name}: expected 'MSG: name' after ====, got {head[:60]!r}"
                )
            name = ros2_spelling(head[4:].strip())
        fields = tuple(_fields_of(name, body))
        if raw.setdefault(name, fields) != fields:
            raise SchemaError(f"{type_name}: two different definitions of {name}")
    return {name: _resolved(name, fields, raw) for name, fields in raw.items()}


def _feedback_of_action(type_name: str, text: str) -> str:
    """Derive the definition of an action's feedback, if the definition of the action is stored."""
    name = type_name.removesuffix("_FeedbackMessage")
    separator = _SEPARATOR.search(text)
    action = text[: separator.start()] if separator else text
    parts = _ACTION_PART.split(action)
    if name == type_name or "/action/" not in type_name or len(parts) != 3:
        return text
    others = text[separator.start() :] if separator else ""
    fields = f"unique_identifier_msgs/UUID goal_id\n{name}_Feedback feedback\n"
    return f"{fields}{'=' * 80}\nMSG: {name}_Feedback\n{parts[2]}\n{others}"


def _fields_of(owner: str, body: str) -> Iterator[MessageField]:
    for line in body.split("\n"):
        line = _ANNOTATION.sub("", line.strip(), count=1)
        if not line or line.startswith("#"):
            continue
        match = _FIELD.fullmatch(line)
        if match is None:
            raise SchemaError(f"{owner}: cannot read the line {line[:80]!r} of its definition")
        if match["rest"].startswith("="):
            continue
        shape = Multiplicity.ONE
        if match["array"]:
            fixed = match["size"] and not match["most"]
            shape = Multiplicity.ARRAY if fixed else Multiplicity.SEQUENCE
        if match["text"] and match["type"] != "string":
            raise SchemaError(f"{owner}: only strings may have a bound, not {line[:80]!r}")
        has_default = match["rest"] and not match["rest"].startswith("#")
        if has_default and match["type"] not in PRIMITIVES and match["type"] != "string":
            raise SchemaError(f"{owner}: cannot read the line {line[:80]!r} of its definition")
        yield MessageField(
            match["name"], match["type"], shape, int(match["size"] or 0), int(match["text"] or 0)
        )


def _resolved(
    owner: str, fields: tuple[MessageField, ...], known: Mapping[str, tuple[MessageField, ...]]
) -> tuple[MessageField, ...]:
    package = owner.rsplit("/", 1)[0]
    return tuple(
        MessageField(f.name, _full_name(f.type_name, package, known), f.shape, f.size, f.text_bound)
        for f in fields
    )


def _full_name(name: str, package: str, known: Mapping[str, tuple[MessageField, ...]]) -> str:
    if name in PRIMITIVES or name == "string":
        return name
    if name == "time":
        return TIME
    if name == "duration":
        return DURATION
    if "/" in name:
        return ros2_spelling(name)
    sibling = f"{package}/{name}"
    return "std_msgs/msg/Header" if name == "Header" and sibling not in known else sibling


def _from_idl(type_name: str, text: str) -> Definitions:
    from rosbags.typesys import TypesysError, get_types_from_idl

    if len(text) > IDL_BYTES:
        raise SchemaError(
            f"{type_name}: IDL has {len(text)} characters, over the limit of {IDL_BYTES}"
        )
    found: dict[str, tuple[MessageField, ...]] = {}
    for section in _SEPARATOR.split(text):
        head, _, body = section.lstrip().partition("\n")
        source = body if head.startswith("IDL:") else section
        if not source.strip():
            continue
        _refuse_arithmetic(type_name, source)
        try:
            parsed = get_types_from_idl(source)
        except (TypesysError, RecursionError, ValueError, KeyError, AssertionError) as error:
            first = str(error).split("\n", 1)[0][:80]
            raise SchemaError(f"{type_name}: IDL does not parse: {first}") from None
        found.update({name: _from_rosbags(fields) for name, (_, fields) in parsed.items()})
    return found


def _refuse_arithmetic(type_name: str, text: str) -> None:
    """Refuse constant expressions.

    ROS definitions contain none. The parser takes seconds for each bracket, and products and shifts
    of constants can become arbitrarily large.
    """
    bare = _IDL_ANNOTATION.sub("", _without_comments(text))
    for sign in ("(", "*", "<<"):
        if sign in bare:
            raise SchemaError(f"{type_name}: IDL has an expression with {sign!r}; not supported")


def _without_comments(text: str) -> str:
    """Remove comments and strings from IDL text in one pass."""
    kept: list[str] = []
    at = 0
    for match in _IDL_SKIP.finditer(text):
        if match.start() < at:
            continue
        kept.append(text[at : match.start()])
        end = {"/*": "*/", "//": "\n", '"': '"'}[match[0]]
        stop = text.find(end, match.end())
        at = len(text) if stop < 0 else stop + len(end)
        if at == len(text):
            break
    return "".join(kept) + text[at:]


def _from_rosbags(fields: object) -> tuple[MessageField, ...]:
    """Convert fields from the representation of rosbags."""
    out: list[MessageField] = []
    assert isinstance(fields, list)
    for name, (node, inner) in fields:
        shape, size = Multiplicity.ONE, 0
        if node.name in ("ARRAY", "SEQUENCE"):
            (node, inner), size = inner[0], inner[1]
            shape = (
                Multiplicity.ARRAY
                if fields[len(out)][1][0].name == "ARRAY"
                else Multiplicity.SEQUENCE
            )
        type_name, bound = inner if node.name == "BASE" else (inner, 0)
        out.append(MessageField(name, type_name, shape, size, bound))
    return tuple(out)


@cache
def well_known(type_name: str) -> Definitions | None:
    """Return definitions of a ROS 2 type that logs may omit (sqlite3 bags before ROS 2 Iron)."""
    from rosbags.typesys.stores.ros2_humble import FIELDDEFS

    own = _OWN.get(type_name)
    if own is None and type_name not in FIELDDEFS:
        return None
    found = dict(_from_msg(type_name, own)) if own is not None else {}
    waiting = [type_name, *(f.type_name for fields in found.values() for f in fields)]
    while waiting:
        name = waiting.pop()
        if name not in found and name in FIELDDEFS:
            found[name] = _from_rosbags(FIELDDEFS[name][1])
            waiting += [field.type_name for field in found[name]]
    return found


# Types outside the ROS 2 distribution; field names and order define the wire format.
_OWN: Final[Mapping[str, str]] = {
    "can_msgs/msg/Frame": (
        "std_msgs/Header header\nuint32 id\nbool is_rtr\nbool is_extended\nbool is_error\n"
        "uint8 dlc\nuint8[8] data\n"
    ),
    "foxglove_msgs/msg/CompressedVideo": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
    "foxglove_msgs/msg/CompressedImage": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
    ),
}
