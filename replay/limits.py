"""Limits on declared sizes, above which a reader refuses a log."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

MIB: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """Maximum sizes that a reader accepts, both declared and after decompression.

    Attributes:
        chunk_bytes: Size of a decompressed chunk, container or page.
        message_bytes: Size of a message or an encoded image.
        records_per_chunk: Number of records in a chunk; a few kilobytes can hold millions.
        schema_bytes: Size of a message definition.
        record_bytes: Size of a JSON file in which crosscue records how a result was made.
    """

    chunk_bytes: int = 256 * MIB
    message_bytes: int = 64 * MIB
    records_per_chunk: int = 4_000_000
    schema_bytes: int = 1 * MIB
    record_bytes: int = 64 * MIB


DEFAULT_LIMITS: Final = Limits()
