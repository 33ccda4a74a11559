"""Tables that assign frames to messages and check them; both engines share them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import LENGTH_UNKNOWN, CanFrames

from .extract import Column, MessageExtractor, Words
from .layout import CanMessage

STANDARD_IDS: Final = 2048

Columns: TypeAlias = dict[str, Column]
Strange: TypeAlias = NDArray[np.bool_] | None


@dataclass(frozen=True, slots=True)
class MessageRules:
    """Requirements on the frames of one message.

    Attributes:
        message: The message.
        extractor: Extractor of its signals, or None if it is not decoded.
        longest: Max bytes of a classic frame and of an FD frame; -1 where no frame fits.
    """

    message: CanMessage
    extractor: MessageExtractor | None
    longest: tuple[int, int]


@dataclass(frozen=True, slots=True)
class RuleArrays:
    """The rules of all messages as arrays; message number 0 means no message.

    Attributes:
        standard: Shape (2049,): message number of each 11-bit identifier; the last element is for
            larger identifiers.
        extended_ids: Sorted 29-bit identifiers.
        extended_numbers: Message numbers of ``extended_ids``.
        fits: By width of the payload array: shape (2, M + 1, 256), True where a classic or FD frame
            of this message and length can be decoded.
    """

    standard: NDArray[np.uint16]
    extended_ids: NDArray[np.uint32]
    extended_numbers: NDArray[np.uint16]
    fits: dict[int, NDArray[np.bool_]]

    @classmethod
    def of(cls, rules: Sequence[MessageRules]) -> RuleArrays:
        """Build the tables; messages are numbered from 1."""
        standard = np.zeros(STANDARD_IDS + 1, dtype=np.uint16)
        fits = {width: np.zeros((2, len(rules) + 1, 256), dtype=np.bool_) for width in (8, 64)}
        extended = []
        for number, rule in enumerate(rules, start=1):
            if rule.message.is_extended:
                extended.append((rule.message.arbitration_id, number))
            else:
                standard[rule.message.arbitration_id] = number
        decoded = [rule.extractor is not None for rule in rules]
        sizes = np.array([rule.message.length for rule in rules], dtype=np.int64)
        longest = np.array([rule.longest for rule in rules], dtype=np.int64).reshape(-1, 2)
        fitting = _fitting_lengths(sizes, longest.T) & np.array(decoded, dtype=np.bool_)[:, None]
        for width, table in fits.items():
            table[:, 1:] = fitting & (sizes <= width)[:, None]
        extended.sort()
        ids = np.array([i for i, _ in extended], dtype=np.uint32)
        numbers = np.array([n for _, n in extended], dtype=np.uint16)
        return cls(standard, ids, numbers, fits)


def _fitting_lengths(sizes: NDArray[np.int64], longest: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of the lengths that fit, shape (2, M, 256), from shapes (M,) and (2, M)."""
    length, max_length = np.arange(256), longest[:, :, None]
    fits: NDArray[np.bool_] = (length >= sizes[:, None]) & (length <= max_length)
    # A log that does not record lengths cannot contradict the database.
    fits[:, :, LENGTH_UNKNOWN] |= longest >= 0
    return fits


@dataclass(frozen=True, slots=True)
class Grouped:
    """The frames of a block, grouped by message.

    Attributes:
        number: Shape (N,): number of each frame's message, 0 for none.
        is_good: Shape (N,): True if the frame can be decoded.
        order: Shape (G,): indices of the G good frames, those of message 1 first.
        stops: Shape (M + 1,): end of each message in ``order``; 0 for message 0.
        seen: Shape (M + 1,): number of data frames of each message, good or not.
        unknown: Shape (2048,): number of data frames of no message, by 11-bit identifier.
    """

    number: NDArray[np.uint16]
    is_good: NDArray[np.bool_]
    order: NDArray[np.intp]
    stops: NDArray[np.intp]
    seen: NDArray[np.intp]
    unknown: NDArray[np.intp]

    def rows(self, number: int) -> slice:
        """Return the slice of ``order`` that holds a message's frames."""
        return slice(int(self.stops[number - 1]), int(self.stops[number]))


class CanDecoder(Protocol):
    """Engine that groups frames and decodes the columns of each group."""

    def group(self, frames: CanFrames) -> Grouped:
        """Look up, check and sort frames."""
        ...

    def columns(self, number: int) -> tuple[Columns, Strange]:
        """Return the columns of one message of the last group, like ``MessageExtractor``."""
        ...


def payload_words(frames: CanFrames) -> Words:
    """Return payloads as little-endian words, shape (N, W / 8)."""
    words: Words = np.ascontiguousarray(frames.data).view("<u8").astype(np.uint64, copy=False)
    return words
