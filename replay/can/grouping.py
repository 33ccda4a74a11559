"""Assign frames to messages, check them, and decode those of each message together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import DATA, LENGTH_UNKNOWN, CanFrames

from .extract import Column, MessageExtractor, Words
from .layout import CanMessage

STANDARD_IDS: Final = 2048
# Max number of messages for which searching for each is faster than sorting (0.11 ms against 0.21
# ms for 10 messages in 58,000 frames).
FEW: Final = 16

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


class GroupedDecoder:
    """Decoder that groups the frames of a block by message, and extracts the columns of each."""

    def __init__(self, rules: Sequence[MessageRules]) -> None:
        """Prepare the tables; rules without an extractor must be last."""
        self._rules = rules
        self._decodable = sum(rule.extractor is not None for rule in rules)
        self._tables = RuleArrays.of(rules)
        self._numbers = np.arange(len(rules) + 1, dtype=np.uint16)
        self._grouped: Grouped | None = None
        self._words: Words = np.zeros((0, 1), dtype=np.uint64)

    def group(self, frames: CanFrames) -> Grouped:
        """Look up, check and sort frames."""
        number = self._number(frames)
        is_data = frames.kind == DATA
        is_good = (number > 0) & (number <= self._decodable)
        order, stops = self._sort(number)
        seen = np.diff(stops, prepend=0)
        if not self._all_fit(frames, order, stops):
            is_good = self._fits(frames, number) & is_data
            seen = np.bincount(number[is_data], minlength=len(self._rules) + 1)
            order, stops = self._sort(np.where(is_good, number, np.uint16(0)))
        order = order[stops[0] : stops[self._decodable]]
        stops = np.minimum(stops, stops[self._decodable]) - stops[0]
        words: Words = np.ascontiguousarray(frames.data).view("<u8").astype(np.uint64, copy=False)
        self._words = words.take(order, axis=0)
        unknown = is_data & (number == 0) & ~frames.is_extended
        by_id = np.bincount(
            np.minimum(frames.arbitration_id[unknown], STANDARD_IDS), minlength=STANDARD_IDS
        )
        self._grouped = Grouped(number, is_good, order, stops, seen, by_id[:STANDARD_IDS])
        return self._grouped

    def _sort(self, number: NDArray[np.uint16]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the frames in order of ``number``, and the end of each number."""
        if len(self._numbers) <= FEW:
            each = [np.flatnonzero(number == one) for one in self._numbers]
            return np.concatenate(each), np.cumsum([len(rows) for rows in each])
        order = np.argsort(number, kind="stable")  # a radix sort on 16 bits
        return order, np.searchsorted(number.take(order), self._numbers, side="right")

    def _all_fit(self, frames: CanFrames, order: NDArray[np.intp], stops: NDArray[np.intp]) -> bool:
        """Check from the extreme lengths alone that all decodable frames fit, the usual case."""
        if frames.kind.any() or frames.is_fd.any():
            return False
        ends = stops[: self._decodable + 1]
        groups = np.flatnonzero(np.diff(ends))
        if not len(groups):
            return True
        lengths = frames.length.take(order[: ends[-1]])
        shortest = np.minimum.reduceat(lengths, ends[groups])
        max_length = np.maximum.reduceat(lengths, ends[groups])
        fits = self._tables.fits[frames.data.shape[1]][0, groups + 1]
        at = np.arange(len(groups))
        # All lengths between two fitting lengths fit, except the number that means "unknown".
        in_one_piece = (max_length < LENGTH_UNKNOWN) | (shortest == LENGTH_UNKNOWN)
        return bool((fits[at, shortest] & fits[at, max_length] & in_one_piece).all())

    def columns(self, number: int) -> tuple[Columns, Strange]:
        """Return the columns of one message of the last group of frames."""
        extractor = self._rules[number - 1].extractor
        assert extractor is not None
        assert self._grouped is not None
        return extractor(self._words[self._grouped.rows(number)])

    def _number(self, frames: CanFrames) -> NDArray[np.uint16]:
        tables = self._tables
        number = tables.standard.take(frames.arbitration_id, mode="clip")
        if not frames.is_extended.any():
            return number
        rows = np.flatnonzero(frames.is_extended)
        if not len(tables.extended_ids):
            number[rows] = 0
            return number
        ids = frames.arbitration_id[rows]
        place = np.searchsorted(tables.extended_ids, ids)
        place[place == len(tables.extended_ids)] = 0
        is_known = tables.extended_ids[place] == ids
        number[rows] = np.where(is_known, tables.extended_numbers[place], np.uint16(0))
        return number

    def _fits(self, frames: CanFrames, number: NDArray[np.uint16]) -> NDArray[np.bool_]:
        fits: NDArray[np.bool_] = self._tables.fits[frames.data.shape[1]][
            frames.is_fd.view(np.uint8), number, frames.length
        ]
        return fits
