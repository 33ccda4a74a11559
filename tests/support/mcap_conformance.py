"""The conformance files of the MCAP project, from its folder ``tests/conformance/data``.

That folder has a JSON description of each file's records. A checkout without Git LFS has pointers
instead of the files. A file is then rebuilt from its records and compared with the pointer's
SHA-256.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from support.mcap_files import MAGIC, Message, mapping, record, text

OPCODES = {
    "Header": 1,
    "Footer": 2,
    "Schema": 3,
    "Channel": 4,
    "Message": 5,
    "ChunkIndex": 8,
    "Attachment": 9,
    "AttachmentIndex": 10,
    "Statistics": 11,
    "Metadata": 12,
    "MetadataIndex": 13,
    "SummaryOffset": 14,
    "DataEnd": 15,
}
NEVER_PADDED = ("Message", "DataEnd", "Footer")
IN_CHUNK = ("Schema", "Channel", "Message")
PADDING = b"\x01\xff\xff"


@dataclass(frozen=True, slots=True)
class Conformance:
    """One file of the suite and its content.

    Attributes:
        name: Name of the file.
        coded: Bytes of the file.
        messages: Messages by topic, in stored order.
        is_exact: The bytes have the SHA-256 of the suite's file.
    """

    name: str
    coded: bytes
    messages: Mapping[str, list[Message]]
    is_exact: bool


def load(description: Path) -> Conformance:
    """Load the file that a JSON file describes."""
    reported = json.loads(description.read_text())
    records = [(r["type"], dict(r["fields"])) for r in reported["records"]]
    stored = description.with_suffix(".mcap").read_bytes()
    pointer = re.search(rb"oid sha256:([0-9a-f]{64})", stored)
    if pointer is None:
        return Conformance(description.stem, stored, _messages(records), True)
    coded = rebuild(records, frozenset(reported["meta"]["variant"]["features"]))
    is_exact = hashlib.sha256(coded).hexdigest() == pointer[1].decode()
    return Conformance(description.stem, coded, _messages(records), is_exact)


def _messages(records: list[tuple[str, dict[str, Any]]]) -> dict[str, list[Message]]:
    topics = {f["id"]: f["topic"] for kind, f in records if kind == "Channel"}
    found: dict[str, list[Message]] = {}
    for kind, f in records:
        if kind == "Message":
            one = (int(f["log_time"]), int(f["publish_time"]), _bytes(f["data"]))
            found.setdefault(topics[f["channel_id"]], []).append(one)
    return found


def rebuild(records: list[tuple[str, dict[str, Any]]], features: frozenset[str]) -> bytes:
    """Build a file from records, chunked, indexed and padded as the features specify."""
    pad = PADDING if "pad" in features else b""
    out = bytearray(MAGIC)
    chunk: list[tuple[str, dict[str, Any]]] = []
    in_data = True
    for kind, fields in records:
        if kind == "DataEnd":
            if "ch" in features:
                out += _chunk(chunk, "mx" in features, pad)
            in_data = False
        if in_data and "ch" in features and kind in IN_CHUNK:
            chunk.append((kind, fields))
        else:
            out += _record(kind, fields, pad)
    return bytes(out + MAGIC)


def _chunk(records: list[tuple[str, dict[str, Any]]], is_indexed: bool, pad: bytes) -> bytes:
    body, entries, logs = bytearray(), dict[int, list[tuple[int, int]]](), list[int]()
    for kind, fields in records:
        if kind == "Message":
            logs.append(int(fields["log_time"]))
            entries.setdefault(int(fields["channel_id"]), []).append((logs[-1], len(body)))
        body += _record(kind, fields, b"")
    span = (min(logs, default=0), max(logs, default=0))
    fixed = struct.pack("<QQQI", *span, len(body), zlib.crc32(body)) + text("")
    out = record(6, fixed + struct.pack("<Q", len(body)) + body)
    for number, found in entries.items() if is_indexed else ():
        coded = b"".join(struct.pack("<QQ", *entry) for entry in found)
        out += record(7, struct.pack("<H", number) + text(coded) + pad)
    return out


def _record(kind: str, fields: dict[str, Any], pad: bytes) -> bytes:
    content = _CODERS[kind](fields)
    return record(OPCODES[kind], content + (b"" if kind in NEVER_PADDED else pad))


def _bytes(numbers: list[str]) -> bytes:
    return bytes(int(number) for number in numbers)


def _pack(layout: str, fields: dict[str, Any], *names: str) -> bytes:
    return struct.pack(f"<{layout}", *(int(fields[name]) for name in names))


def _strings(pairs: Mapping[str, str]) -> bytes:
    return mapping(text(key) + text(value) for key, value in pairs.items())


def _numbers(pairs: Mapping[str, str]) -> bytes:
    return mapping(struct.pack("<HQ", int(key), int(value)) for key, value in pairs.items())


def _attachment(f: dict[str, Any]) -> bytes:
    body = _bytes(f["data"])
    content = _pack("QQ", f, "log_time", "create_time") + text(f["name"]) + text(f["media_type"])
    content += struct.pack("<Q", len(body)) + body
    return content + struct.pack("<I", zlib.crc32(content))


_CODERS: Mapping[str, Callable[[dict[str, Any]], bytes]] = {
    "Header": lambda f: text(f["profile"]) + text(f["library"]),
    "Footer": lambda f: _pack("QQI", f, "summary_start", "summary_offset_start", "summary_crc"),
    "Schema": lambda f: (
        _pack("H", f, "id") + text(f["name"]) + text(f["encoding"]) + text(_bytes(f["data"]))
    ),
    "Channel": lambda f: (
        _pack("HH", f, "id", "schema_id")
        + text(f["topic"])
        + text(f["message_encoding"])
        + _strings(f["metadata"])
    ),
    "Message": lambda f: (
        _pack("HIQQ", f, "channel_id", "sequence", "log_time", "publish_time") + _bytes(f["data"])
    ),
    "ChunkIndex": lambda f: (
        _pack(
            "QQQQ",
            f,
            "message_start_time",
            "message_end_time",
            "chunk_start_offset",
            "chunk_length",
        )
        + _numbers(f["message_index_offsets"])
        + _pack("Q", f, "message_index_length")
        + text(f["compression"])
        + _pack("QQ", f, "compressed_size", "uncompressed_size")
    ),
    "Attachment": _attachment,
    "AttachmentIndex": lambda f: (
        _pack("QQQQQ", f, "offset", "length", "log_time", "create_time", "data_size")
        + text(f["name"])
        + text(f["media_type"])
    ),
    "Statistics": lambda f: (
        _pack(
            "QHIIIIQQ",
            f,
            "message_count",
            "schema_count",
            "channel_count",
            "attachment_count",
            "metadata_count",
            "chunk_count",
            "message_start_time",
            "message_end_time",
        )
        + _numbers(f["channel_message_counts"])
    ),
    "Metadata": lambda f: text(f["name"]) + _strings(f["metadata"]),
    "MetadataIndex": lambda f: _pack("QQ", f, "offset", "length") + text(f["name"]),
    "SummaryOffset": lambda f: _pack("BQQ", f, "group_opcode", "group_start", "group_length"),
    "DataEnd": lambda f: _pack("I", f, "data_section_crc"),
}
