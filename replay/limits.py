"""Limits on declared sizes, above which a reader refuses a log."""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Final, TypeAlias

from crosscue.replay.errors import UsageError
from crosscue.verb import Option

MIB: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class Limits:
    """Maximum sizes that a reader accepts, declared and after decompression, and use of links.

    Attributes:
        chunk_bytes: Size of a decompressed chunk, container or page.
        message_bytes: Size of a message or an encoded image.
        records_per_chunk: Number of records in a chunk; a few kilobytes can hold millions.
        schema_bytes: Size of a message definition.
        record_bytes: Size of a JSON file in which crosscue records how a result was made.
        follow_links: Read files of a log through links, which may lead out of the log's folder.
    """

    chunk_bytes: int = 256 * MIB
    message_bytes: int = 64 * MIB
    records_per_chunk: int = 4_000_000
    schema_bytes: int = 1 * MIB
    record_bytes: int = 64 * MIB
    follow_links: bool = False


DEFAULT_LIMITS: Final = Limits()


def mebibytes(text: str) -> int:
    """Return a number of MiB in bytes.

    Raises:
        UsageError: It is not a number above 0, or above 1 TiB.
    """
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and 0.0 < value <= 1 << 20):
        raise UsageError(f"{text!r}: expected MiB, above 0 and up to {1 << 20}")
    return max(int(value * MIB), 1)


def limits_of(
    *,
    max_chunk_bytes: Annotated[
        int, Option("--max-chunk", metavar="MIB", convert=mebibytes)
    ] = DEFAULT_LIMITS.chunk_bytes,
    follow_links: bool = False,
) -> Limits:
    """Return limits for reading a log.

    Args:
        max_chunk_bytes: Largest chunk, container or page to decompress, in MiB (default: 256).
        follow_links: Read files of a log through links, which may lead out of its folder.
    """
    return replace(DEFAULT_LIMITS, chunk_bytes=max_chunk_bytes, follow_links=follow_links)


# Limits, as a parameter of a verb.
LimitsGiven: TypeAlias = Annotated[Limits, Option(made_by=limits_of)]
