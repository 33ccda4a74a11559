"""Write complete ROS 2 definitions, and convert ROS 1 definitions to ROS 2.

The text specifies the encoding of messages, without constants and comments.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from crosscue.replay.decode.ros.definition import (
    DURATION,
    PRIMITIVES,
    TIME,
    Definitions,
    MessageField,
    Multiplicity,
    well_known,
)
from crosscue.replay.errors import SchemaError

SEPARATOR: Final = "=" * 80 + "\n"
HEADER: Final = "std_msgs/msg/Header"
_TIMES: Final[Mapping[str, tuple[MessageField, ...]]] = {
    TIME: (MessageField("sec", "int32"), MessageField("nanosec", "uint32")),
    DURATION: (MessageField("sec", "int32"), MessageField("nanosec", "uint32")),
}


def text_of(type_name: str, known: Definitions) -> str:
    """Return a complete ``ros2msg`` definition: the type and, after separators, its parts."""
    parts = [_body(known[type_name])]
    for name in _needed(type_name, known):
        fields = known.get(name) or _TIMES.get(name)
        if fields is None:
            raise SchemaError(f"{type_name}: its definition lacks the type {name}")
        parts.append(f"MSG: {_short(name)}\n{_body(fields)}")
    return SEPARATOR.join(parts)


def completed(type_name: str, text: bytes, known: Definitions) -> bytes:
    """Complete a stored ``ros2msg`` text with the types that it uses but omits.

    Raises:
        SchemaError: It uses an unknown type.
    """
    whole = dict(known)
    missing: list[str] = []
    for name in _needed(type_name, whole):
        if name not in whole:
            fields = _TIMES.get(name) or (well_known(name) or {}).get(name)
            if fields is None:
                raise SchemaError(f"{type_name}: its definition lacks the type {name}")
            # The loop continues over ``whole``, so the parts of this type are examined next.
            whole[name] = fields
            missing.append(f"MSG: {_short(name)}\n{_body(fields)}")
    end = b"" if text.endswith(b"\n") or not missing else b"\n"
    return text + end + "".join(SEPARATOR + each for each in missing).encode()


def standard_text(type_name: str) -> str:
    """Return ``text_of`` a type that ROS 2 or crosscue defines."""
    known = well_known(type_name)
    if known is None:
        raise SchemaError(f"{type_name}: unknown type")
    return text_of(type_name, known)


def as_ros2(type_name: str, ros1: Definitions) -> Definitions:
    """Return the ROS 2 definitions of a ROS 1 type, with headers without counter.

    If ROS 2 has a type of this name with the same encoding, its field names are used.
    """
    known: dict[str, tuple[MessageField, ...]] = {}
    for name, fields in ros1.items():
        kept = fields
        if name == HEADER and fields and fields[0].name == "seq":
            kept = fields[1:]
        known[name] = kept
    modern = well_known(type_name)
    if modern is not None and _alike(type_name, known, modern):
        return modern
    return known


def differs_in_ros2(type_name: str, known: Definitions) -> bool:
    """Return whether ROS 2 has a type of this name with a different encoding."""
    modern = well_known(type_name)
    return modern is not None and not _alike(type_name, known, modern)


def _alike(name: str, ours: Definitions, theirs: Definitions) -> bool:
    if name in _TIMES:
        return True
    mine, other = ours.get(name), theirs.get(name)
    if mine is None or other is None or len(mine) != len(other):
        return False
    return all(
        (a.type_name, a.shape, a.size if a.shape is Multiplicity.ARRAY else 0)
        == (b.type_name, b.shape, b.size if b.shape is Multiplicity.ARRAY else 0)
        and (
            a.type_name in PRIMITIVES or "/" not in a.type_name or _alike(a.type_name, ours, theirs)
        )
        for a, b in zip(mine, other, strict=True)
    )


def _needed(type_name: str, known: Definitions) -> Iterator[str]:
    """Yield the names of the types that a type consists of, with lazy look-ups in ``known``."""
    seen = {type_name}
    waiting = [type_name]
    while waiting:
        for field in known.get(waiting.pop(0)) or ():
            if "/" in field.type_name and field.type_name not in seen:
                seen.add(field.type_name)
                waiting.append(field.type_name)
                yield field.type_name


def _short(name: str) -> str:
    return name.replace("/msg/", "/")


def _body(fields: tuple[MessageField, ...]) -> str:
    return "".join(f"{_type(field)} {field.name}\n" for field in fields)


def _type(field: MessageField) -> str:
    name = _short(field.type_name) + (f"<={field.text_bound}" if field.text_bound else "")
    if field.shape is Multiplicity.ARRAY:
        return f"{name}[{field.size}]"
    if field.shape is Multiplicity.SEQUENCE:
        return f"{name}[<={field.size}]" if field.size else f"{name}[]"
    return name
