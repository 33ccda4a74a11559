"""Seeded damage to MCAP files, and a classification of what a reader returns."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

from crosscue.replay.errors import CrosscueError
from support.mcap_files import (
    ChunkOf,
    McapFile,
    Message,
    Reading,
    channel,
    message,
    read_back,
    schema,
)

# Parts of the ledger's integrity if a changed byte cannot be detected.
UNCOVERED = ("no checksum covers", "checksum is wrong", "has no checksums")
TOPICS = ("/imu", "/can", "/camera")


def sound_parts(compression: str, is_chunked: bool) -> list[bytes | ChunkOf]:
    """Six hundred messages on three topics, in chunks or as records without chunks."""
    rng = np.random.default_rng(7)
    defined = [schema(1)] + [channel(i + 1, 1, name) for i, name in enumerate(TOPICS)]
    # Payloads contain their number, so that they cannot be confused.
    messages = [
        message(1 + i % 3, 10**9 + i * 1000, b"%06d" % i + rng.bytes(i * 13 % 60) + bytes(i % 40))
        for i in range(600)
    ]
    if not is_chunked:
        return [*defined, *messages]
    first, *rest = [messages[i : i + 25] for i in range(0, len(messages), 25)]
    return [ChunkOf([*defined, *first], compression), *(ChunkOf(m, compression) for m in rest)]


def sound_files() -> Iterator[tuple[str, bytes]]:
    """Yield undamaged files with different checksums and indexes, by name."""
    for compression in ("", "lz4", "zstd"):
        parts = sound_parts(compression, is_chunked=True)
        name = compression or "none"
        yield f"{name} indexed", McapFile(parts, data_crc=True).coded()
        yield f"{name} without data crc", McapFile(parts).coded()
        yield f"{name} without summary", McapFile(parts, summary=False).coded()
        yield f"{name} without statistics", McapFile(parts, statistics=False).coded()
        bare = [
            ChunkOf(p.records, p.compression, is_indexed=False)
            for p in parts
            if not isinstance(p, bytes)
        ]
        yield f"{name} without any index", McapFile(bare, summary=False).coded()
    yield "no chunks", McapFile(sound_parts("", is_chunked=False), data_crc=True).coded()
    bare_records = sound_parts("", is_chunked=False)
    yield "no chunks, no checksum", McapFile(bare_records).coded()
    yield "no chunks, no summary", McapFile(bare_records, summary=False).coded()
    mixed = sound_parts("zstd", is_chunked=True)
    outside = [message(2, 5_000 + i, b"outside %d" % i) for i in range(30)]
    yield "mixed", McapFile([*mixed[:8], *outside, *mixed[8:]], data_crc=True).coded()
    one = McapFile(mixed).coded()
    yield "two in a row", one + McapFile(sound_parts("lz4", is_chunked=True)).coded()


class Kind(Enum):
    """Kind of outcome of reading one damaged copy."""

    REFUSED = "refused with one line"
    SAME = "everything read, nothing to report"
    REPORTED = "loss reported"
    NOTICED = "everything read, with a notice"
    SILENT = "SILENT LOSS"
    CHANGED = "a message changed where no checksum can say which"
    WRONG = "WRONG MESSAGE"
    UNBALANCED = "ACCOUNT DOES NOT ADD UP, OR ERROR IS NOT ONE LINE"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Outcome of reading one damaged copy, and the fraction of messages read."""

    kind: Kind
    kept: float = 0.0


def judge(path: Path, truth: Reading) -> Verdict:
    """Read a damaged copy and compare it with the reading of the undamaged file."""
    try:
        reading = read_back(path)
    except CrosscueError as error:
        return Verdict(Kind.UNBALANCED if "\n" in str(error) else Kind.REFUSED)
    kept = reading.count() / truth.count()
    if not reading.adds_up():
        return Verdict(Kind.UNBALANCED, kept)
    unexpected = _of_all(reading) - _of_all(truth)
    if unexpected:
        is_uncovered = any(one in reading.ledger.integrity for one in UNCOVERED)
        only_changed = is_uncovered and _are_changed(unexpected, _of_all(truth) - _of_all(reading))
        return Verdict(Kind.CHANGED if only_changed else Kind.WRONG, kept)
    if reading.count() < truth.count():
        accounts = reading.ledger.accounts.values()
        is_annotated = not reading.ledger.is_whole or any(one.skipped for one in accounts)
        return Verdict(Kind.REPORTED if is_annotated else Kind.SILENT, kept)
    if not reading.ledger.is_whole:
        return Verdict(Kind.REPORTED, kept)
    has_notice = reading.ledger.notices != truth.ledger.notices
    return Verdict(Kind.NOTICED if has_notice else Kind.SAME, kept)


def _of_all(reading: Reading) -> Counter[tuple[str, Message]]:
    return Counter((topic, one) for topic, messages in reading.messages.items() for one in messages)


def _are_changed(
    unexpected: Counter[tuple[str, Message]], missing: Counter[tuple[str, Message]]
) -> bool:
    """Return whether changed bytes or a renamed topic can explain every unexpected message.

    Damage of at most 64 bytes touches at most three records.
    """
    known = {topic for topic, _ in missing}
    changed = sum(count for (topic, _), count in unexpected.items() if topic in known)
    return changed <= 3 and unexpected.total() <= missing.total()


def damage(coded: bytes, rng: np.random.Generator) -> bytes:
    """Overwrite 1 to 64 bytes by noise, zeros, ones or other bytes of the file, or flip one bit."""
    out = bytearray(coded)
    size = int(rng.integers(1, 65))
    at = int(rng.integers(0, len(coded) - size))
    match int(rng.integers(0, 5)):
        case 0:
            out[at : at + size] = rng.bytes(size)
        case 1:
            out[at : at + size] = bytes(size)
        case 2:
            out[at : at + size] = b"\xff" * size
        case 3:
            out[at] ^= 1 << int(rng.integers(0, 8))
        case _:
            other = int(rng.integers(0, len(coded) - size))
            out[at : at + size] = coded[other : other + size]
    return bytes(out)


def copies(coded: bytes, seed: int, cuts: int, damages: int) -> Iterator[tuple[str, bytes]]:
    """Yield damaged copies of a file, each with a description; the seed determines all."""
    rng = np.random.default_rng(seed)
    for i in range(cuts):
        yield f"cut {i}", coded[: int(rng.integers(0, len(coded)))]
    for i in range(damages):
        yield f"damage {i}", damage(coded, rng)
