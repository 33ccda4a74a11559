"""Decode JSON messages: numbers with dotted names, and Foxglove's types as standard columns.

JSON with duplicate keys, or with NaN or Infinity (which JSON does not define), is refused.
"""

from base64 import b64decode
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, Messages, Table, Topic
from crosscue.replay.errors import SchemaError, one_line
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import DEFAULT_LIMITS

from .coding import MAGIC_BYTES
from .foxglove import PICTURES, TABLES, PictureKind, SourceField, stamp_ns
from .pictures import PictureRow, images_of
from .refuse import MISFIT, refuse

MAX_DEPTH: Final = 16
MAX_COLUMNS: Final = 2048
_BAD: Final = (ValueError, KeyError, TypeError, RecursionError, OverflowError)


def json_decoder(topic: Topic) -> Callable[[Block, Ledger], Block]:
    """Return the decoder of a JSON topic; its schema, if any, must be a JSON object.

    Raises:
        SchemaError: The schema is too large, or is not a JSON object.
    """
    if len(topic.schema) > DEFAULT_LIMITS.schema_bytes:
        raise SchemaError(
            f"{topic.name}: JSON schema has {len(topic.schema)} bytes, over the limit of "
            f"{DEFAULT_LIMITS.schema_bytes}"
        )
    if topic.schema.strip():
        try:
            _object(topic.schema)
        except _BAD as error:
            raise SchemaError(
                f"{topic.name}: its JSON schema is not a JSON object: {error}"
            ) from None
    if topic.type_name in PICTURES:
        return _PictureDecoder(PICTURES[topic.type_name])
    return _TableDecoder(topic.type_name)


def _object(text: bytes) -> dict[str, Any]:
    value = json_tree(text.decode("utf-8"), parse_constant=_refuse, object_pairs_hook=_unique_keys)
    if not isinstance(value, dict):
        raise ValueError(f"expected an object, got {type(value).__name__}")
    return value


def _refuse(word: str) -> float:
    raise ValueError(f"{word} is not JSON")


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("an object has a duplicate key")
    return found


def _nanoseconds(value: Any) -> int | None:
    """Convert ``{"sec": ..., "nsec": ...}`` to nanoseconds; None if it is something else."""
    if not isinstance(value, dict) or value.keys() != {"sec", "nsec"}:
        return None
    seconds, rest = value["sec"], value["nsec"]
    if type(seconds) is not int or type(rest) is not int:
        return None
    return stamp_ns(seconds, rest)


def _flat(value: Any, path: str, depth: int) -> Iterator[tuple[str, float | int]]:
    if isinstance(value, bool | int | float):
        yield path, value
    elif isinstance(value, list):
        yield f"{path}.length", len(value)
    elif isinstance(value, dict):
        if depth > MAX_DEPTH:
            raise ValueError(f"{path} is nested deeper than {MAX_DEPTH} levels")
        stamp = _nanoseconds(value)
        if stamp is not None:
            yield path, stamp
            return
        for key, inner in value.items():
            yield from _flat(inner, f"{path}.{key}" if path else key, depth + 1)


@dataclass(frozen=True, slots=True)
class _TableDecoder:
    type_name: str

    def __call__(self, block: Block, ledger: Ledger) -> Block:
        if not isinstance(block.rows, Messages):
            return block
        kept, rows, stamps = [], [], []
        standard = TABLES.get(self.type_name, {})
        for i in range(len(block)):
            try:
                value = _object(bytes(block.rows.payload(i)))
                stamp = _nanoseconds(value.get("timestamp"))
                row = {column: _at(value, source) for column, source in standard.items()}
                row = row or dict(_flat(value, "", 0))
                if len(row) > MAX_COLUMNS:
                    raise ValueError(f"over {MAX_COLUMNS} numbers")
            except _BAD as error:
                why = one_line(error, 120)
                refuse(ledger, block, i, MISFIT, why)
                continue
            kept.append(i)
            rows.append(row)
            stamps.append(stamp)
        picked = block.take(np.array(kept, np.intp))
        names = dict.fromkeys(name for row in rows for name in row)
        if len(names) > MAX_COLUMNS:
            names = dict.fromkeys(list(names)[:MAX_COLUMNS])
            ledger.notice(f"{block.topic}: only the first {MAX_COLUMNS} different keys are columns")
        columns = {name: _column([row.get(name) for row in rows]) for name in names}
        if not columns:
            columns["present"] = np.ones(len(kept), np.bool_)
        header_ns = None
        if rows and all(stamp is not None for stamp in stamps):
            header_ns = np.array(stamps, np.int64)
        return replace(picked, rows=Table(columns), header_ns=header_ns)


def _at(value: Any, source: SourceField) -> Any:
    for step in source.path.split("."):
        value = value[step]
    if source.count == 0:
        if not isinstance(value, int | float):
            raise ValueError(f"{source.path} is not a number")
        return value
    numbers = [float(each) for each in value]
    if source.count > 0 and len(numbers) != source.count:
        raise ValueError(f"{source.path}: expected {source.count} values, got {len(numbers)}")
    return numbers


def _column(values: list[Any]) -> NDArray[np.generic]:
    """Build a column; integers stay integers, and missing keys become NaN."""
    if any(isinstance(value, list) for value in values):
        width = max(len(value) for value in values)
        return np.array([v + [np.nan] * (width - len(v)) for v in values], np.float64)
    if all(type(value) is bool for value in values):
        return np.array(values, np.bool_)
    if all(type(value) is int and -(1 << 63) <= value < 1 << 63 for value in values):
        return np.array(values, np.int64)
    return np.array([np.nan if value is None else float(value) for value in values], np.float64)


@dataclass(frozen=True, slots=True)
class _PictureDecoder:
    picture: PictureKind

    def __call__(self, block: Block, ledger: Ledger) -> Block:
        if not isinstance(block.rows, Messages):
            return block
        rows: list[PictureRow | str] = []
        pixels = bytearray()
        for i in range(len(block)):
            try:
                rows.append(_picture(_object(bytes(block.rows.payload(i))), pixels))
            except _BAD as error:
                rows.append(one_line(error, 120))
        buffer = np.frombuffer(bytes(pixels), np.uint8)
        return images_of(block, buffer, self.picture, rows, ledger)


def _picture(value: dict[str, Any], pixels: bytearray) -> PictureRow:
    encoded = b64decode(value["data"], validate=True)
    start = len(pixels)
    pixels += encoded
    label = value.get("format", value.get("encoding", ""))
    if not isinstance(label, str):
        raise ValueError("format is not text")
    return PictureRow(
        stamp_ns=_nanoseconds(value.get("timestamp")),
        start=start,
        stop=start + len(encoded),
        magic=encoded[:MAGIC_BYTES],
        label=label,
        width_px=_count(value, "width"),
        height_px=_count(value, "height"),
        step_bytes=_count(value, "step"),
    )


def _count(value: dict[str, Any], key: str) -> int:
    number = value.get(key, 0)
    if type(number) is not int or not 0 <= number < 1 << 31:
        raise ValueError(f"{key} is not a count")
    return number
