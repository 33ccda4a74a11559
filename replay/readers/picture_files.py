"""One camera as files in a folder: which file has which time, and their bytes in blocks.

Pictures and times are paired by name where the time file gives names; else one by one where there
are as many of each; else by the numbers in the file names where these span as many; else in order
from the first, which is told. Nothing is paired in silence when the counts differ.
"""

from __future__ import annotations

import re
import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import BLOCK_BYTES, Block, Images, Int64s, Messages, Topic
from crosscue.replay.decode.coding import MAGIC_BYTES, coding_of
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.log import Selection

from .picture_bytes import CHECKED, damage_of
from .time_file import TimeFile

SUFFIXES: Final = (".png", ".jpg", ".jpeg", ".webp")
_DIGITS: Final = re.compile(r"([0-9]+)")
_DETAILS_TOLD: Final = 20


@dataclass(frozen=True, slots=True, eq=False)
class PictureFiles:
    """Pictures of one camera and their times.

    Attributes:
        topic: The camera.
        paths: N files in natural order.
        t_ns: Shape (N,), int64; -1 for a picture without time.
        missing_ns: Shape (M,), int64: times whose picture is not there.
        notices: What is odd about the pairing, a sentence each.
    """

    topic: Topic
    paths: tuple[Path, ...]
    t_ns: Int64s
    missing_ns: Int64s
    notices: tuple[str, ...]

    def read(self, ledger: Ledger, selection: Selection, limits: Limits) -> Iterator[Block]:
        """The pictures in blocks, accounted for; codings met are added to ``ledger.integrity``."""
        name = self.topic.name
        ledger.declare(name, self.topic.declared)
        if not selection.wants(name):
            ledger.find(name, len(self.paths))
            ledger.skip(name, NOT_ASKED_TOPIC, len(self.paths))
        else:
            for sentence in self.notices:
                ledger.notice(sentence)
            yield from self._blocks(ledger, selection, limits)
        missing = self.missing_ns[_is_inside(self.missing_ns, selection)]
        first_ns = int(missing[0]) if len(missing) else None
        ledger.lose(name, "a time without its picture", len(missing), "", first_ns)
        if selection.start_ns is None and selection.end_ns is None:
            ledger.settle(name)

    def _blocks(self, ledger: Ledger, selection: Selection, limits: Limits) -> Iterator[Block]:
        name = self.topic.name
        without = [path.name for path, t in zip(self.paths, self.t_ns, strict=True) if t < 0]
        ledger.find(name, len(without))
        ledger.skip(name, "a picture without its time", len(without), _few(without))
        wanted = _is_inside(self.t_ns, selection) & (self.t_ns >= 0)
        outside = len(self.paths) - len(without) - int(np.count_nonzero(wanted))
        ledger.find(name, outside)
        ledger.skip(name, NOT_ASKED_TIME, outside)
        batch = _Batch(name)
        for i in np.flatnonzero(wanted):
            t_ns = int(self.t_ns[i])
            picture = _read_picture(self.paths[i], name, t_ns, ledger, limits)
            if picture is None:
                continue
            if batch.size and batch.size + len(picture[0]) > BLOCK_BYTES:
                yield batch.block()
                batch = _Batch(name)
            batch.add(t_ns, *picture)
        if batch.size:
            yield batch.block()


class _Batch:
    """Pictures waiting to become a block."""

    def __init__(self, topic: str) -> None:
        self._topic = topic
        self._t_ns: list[int] = []
        self._pictures: list[bytes] = []
        self._codings: list[str] = []
        self.size = 0

    def add(self, t_ns: int, picture: bytes, coding: str) -> None:
        self._t_ns.append(t_ns)
        self._pictures.append(picture)
        self._codings.append(coding)
        self.size += len(picture)

    def block(self) -> Block:
        return image_block(self._topic, self._t_ns, self._pictures, self._codings)


def image_block(
    topic: str, t_ns: Sequence[int], pictures: Sequence[bytes], codings: Sequence[str]
) -> Block:
    """A block of encoded pictures, copied into one buffer."""
    stop = np.cumsum([len(picture) for picture in pictures], dtype=np.int64)
    start = np.concatenate([np.zeros(1, dtype=np.int64), stop[:-1]])
    buffer = np.frombuffer(b"".join(pictures), dtype=np.uint8)
    rows = Images(Messages(buffer, start, stop), tuple(codings))
    return Block(topic, np.array(t_ns, dtype=np.int64), rows)


def list_pictures(folder: Path) -> list[Path]:
    """The pictures in a folder, in natural order (``2.png`` before ``10.png``); hidden ones not."""
    paths = [p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.name[0] != "."]
    return sorted(paths, key=lambda path: _natural(path.name))


def pair(topic_name: str, type_name: str, paths: Sequence[Path], times: TimeFile) -> PictureFiles:
    """Give each picture its time, as the module's text says.

    Raises:
        LogFormatError: Not one picture gets a time.
    """
    notices: list[str] = []
    if times.names is not None:
        index = _by_name(paths, times.names)
    else:
        index = _in_order(paths, times, notices)
    is_timed = index >= 0
    if not is_timed.any():
        raise LogFormatError(
            f"{times.path}: no line names a picture of {paths[0].parent}; want names like "
            f"{paths[0].name!r}"
        )
    t_ns = np.full(len(paths), -1, dtype=np.int64)
    t_ns[is_timed] = times.times_at(index[is_timed])
    missing = np.ones(len(times.t_ns), dtype=np.bool_)
    missing[index[is_timed] if times.period is None else []] = False
    declared = len(times.t_ns) if times.period is None else None
    return PictureFiles(
        Topic(topic_name, type_name, "columns", declared=declared),
        tuple(paths),
        t_ns,
        times.t_ns[missing],
        tuple(notices),
    )


def _by_name(paths: Sequence[Path], names: Sequence[str]) -> Int64s:
    """Line of each picture, by its name with or without suffix; -1 where there is none."""
    at = {name: i for i, name in enumerate(names)}
    found = [at.get(path.name, at.get(path.stem, -1)) for path in paths]
    return np.array(found, dtype=np.int64)


def _in_order(paths: Sequence[Path], times: TimeFile, notices: list[str]) -> Int64s:
    """Line of each picture where lines hold no names."""
    n, lines = len(paths), len(times.t_ns)
    numbers, place = _numbers(paths), paths[0].parent.name
    has_gaps = numbers is not None and int(numbers[-1]) + 1 > n
    if times.period is not None:
        notices.append(
            f"{place}: times are made up from a constant rate of "
            f"{float(1_000_000_000 / times.period):g} Hz ({times.path.name}), starting at 0"
        )
    elif numbers is None or n == lines or int(numbers[-1]) + 1 != lines:
        if n != lines:
            notices.append(
                f"{place}: {n} pictures and {lines} times ({times.path.name}), and nothing says "
                "which belong together: paired in order from the first"
            )
        elif has_gaps and numbers is not None:
            notices.append(
                f"{place}: the numbers in the file names leave out {int(numbers[-1]) + 1 - n}; "
                "there are as many times as pictures, so they are paired one by one"
            )
        index = np.arange(n, dtype=np.int64)
        return np.where(index < lines, index, -1)
    if has_gaps and numbers is not None:
        notices.append(
            f"{place}: {int(numbers[-1]) + 1 - n} numbers are missing in the file names; "
            "times go by number"
        )
    return np.arange(n, dtype=np.int64) if numbers is None else numbers


def _numbers(paths: Sequence[Path]) -> Int64s | None:
    """Each picture's place by the last number in its name, from 0, or None where there is none.

    The usual step between numbers counts as one place, if all steps are whole multiples of it.
    """
    texts = [_DIGITS.findall(path.stem) for path in paths]
    if not all(texts) or any(len(found[-1]) > 18 for found in texts):
        return None
    numbers = np.array([int(found[-1]) for found in texts], dtype=np.int64)
    steps = np.array([b - a for a, b in pairwise(numbers.tolist())], dtype=np.int64)
    if not len(steps) or steps.min() <= 0:
        return None if len(steps) else np.zeros(1, dtype=np.int64)
    usual = int(np.median(steps))
    places: Int64s = (numbers - numbers[0]) // usual
    return places if not (steps % usual).any() else None


def _read_picture(
    path: Path, topic: str, t_ns: int, ledger: Ledger, limits: Limits
) -> tuple[bytes, str] | None:
    """A whole picture and its coding; else None, and the ledger knows why."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError("not a regular file")
        with path.open("rb") as file:
            picture = file.read(limits.message_bytes + 1)
    except OSError as error:
        why = error.strerror or str(error)
        ledger.lose(topic, "picture cannot be opened", 1, f"{path.name}: {why}", t_ns)
        return None
    coding = coding_of(picture[:MAGIC_BYTES], "")
    reason = None
    if not picture:
        reason = "empty file"
    elif len(picture) > limits.message_bytes:
        reason = "picture over the size limit"
    elif coding not in CHECKED:
        reason = "not a JPEG, PNG or WebP picture"
    if coding is None or reason is not None:
        ledger.find(topic, 1)
        ledger.skip(topic, reason or "", 1, f"{path.name}: {len(picture)} bytes", t_ns)
        return None
    if damage := damage_of(picture, coding):
        ledger.lose(topic, damage, 1, path.name, t_ns)
        return None
    ledger.find(topic, 1)
    _note_check(ledger, CHECKED[coding])
    return picture, coding


def _note_check(ledger: Ledger, check: str) -> None:
    if ledger.integrity == "not checked":
        ledger.integrity = check
    elif check not in ledger.integrity:
        ledger.integrity += f"; {check}"


def _is_inside(t_ns: Int64s, selection: Selection) -> NDArray[np.bool_]:
    keep = np.ones(len(t_ns), dtype=np.bool_)
    if selection.start_ns is not None:
        keep &= t_ns >= selection.start_ns
    if selection.end_ns is not None:
        keep &= t_ns < selection.end_ns
    return keep


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:_DETAILS_TOLD]) + (", ..." if len(names) > _DETAILS_TOLD else "")


def _natural(name: str) -> list[str | int]:
    return [int(part) if i % 2 else part for i, part in enumerate(_DIGITS.split(name))]
