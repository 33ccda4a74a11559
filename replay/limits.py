"""How much one declared size may cost before a reader refuses it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

MIB: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """Sizes above which a reader refuses, both as declared and as really produced.

    Attributes:
        chunk_bytes: One decompressed chunk, container or page.
        message_bytes: One message or one encoded image.
        records_per_chunk: Records inside one chunk; a few kilobytes can hold millions of them.
        schema_bytes: One message definition.
        record_bytes: One of our own JSON files that says what a result is made of.
    """

    chunk_bytes: int = 256 * MIB
    message_bytes: int = 64 * MIB
    records_per_chunk: int = 4_000_000
    schema_bytes: int = 1 * MIB
    record_bytes: int = 64 * MIB


DEFAULT_LIMITS: Final = Limits()
