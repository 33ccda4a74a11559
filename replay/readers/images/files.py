"""The image files of one camera, read into blocks and accounted for."""

import stat
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import BLOCK_BYTES, Block, Topic, image_block
from crosscue.replay.decode.coding import IMAGE_SUFFIXES, MAGIC_BYTES, coding_of
from crosscue.replay.ledger import Ledger
from crosscue.replay.limits import Limits
from crosscue.replay.readers.timed_files import TimedFiles, list_files
from crosscue.replay.seal.touched import Touched, open_noted

from .damage import CHECKED, damage_of

_NAMES_SHOWN: Final = 20


def list_pictures(folder: Path) -> list[Path]:
    """List the image files of a folder in natural order, without hidden files."""
    return list_files(folder, IMAGE_SUFFIXES)


@dataclass(frozen=True, slots=True, eq=False)
class PictureFiles:
    """Image files of one camera and their times.

    Attributes:
        topic: Topic of the camera.
        files: The image files and their times.
        touched: Record of the files read, for a seal.
    """

    topic: Topic
    files: TimedFiles
    touched: Touched = field(default_factory=Touched)

    def read(self, ledger: Ledger, selection: Selection, limits: Limits) -> Iterator[Block]:
        """Yield the images in blocks; add the check of each coding to ``ledger.integrity``."""
        name = self.topic.name
        ledger.declare(name, self.topic.declared)
        if not selection.wants(name):
            selection.leave(name, len(self.files.paths), ledger)
        else:
            for sentence in self.files.notices:
                ledger.notice(sentence)
            yield from self._blocks(ledger, selection, limits)
        self._drop_missing(ledger, selection)
        if not selection.is_timed:
            ledger.settle(name)

    def report_missing(self, ledger: Ledger) -> None:
        """Report images without a time and times without an image, without opening an image."""
        for sentence in self.files.notices:
            ledger.notice(sentence)
        self._drop_timeless(ledger)
        self._drop_missing(ledger, EVERYTHING)

    def _drop_timeless(self, ledger: Ledger) -> int:
        """Drop the images without a time, and return their number."""
        without = [p.name for p, t in zip(self.files.paths, self.files.t_ns, strict=True) if t < 0]
        reason = "a picture without its time"
        ledger.drop(self.topic.name, reason, len(without), _few(without))
        return len(without)

    def _drop_missing(self, ledger: Ledger, selection: Selection) -> None:
        missing = self.files.missing_ns[selection.inside(self.files.missing_ns)]
        first_ns = int(missing[0]) if len(missing) else None
        ledger.drop(self.topic.name, "a time without its picture", len(missing), "", first_ns)

    def _blocks(self, ledger: Ledger, selection: Selection, limits: Limits) -> Iterator[Block]:
        name = self.topic.name
        without = self._drop_timeless(ledger)
        wanted = selection.inside(self.files.t_ns) & (self.files.t_ns >= 0)
        outside = len(self.files.paths) - without - int(np.count_nonzero(wanted))
        selection.leave(name, outside, ledger)
        batch = PictureBatch(name)
        for i in np.flatnonzero(wanted):
            t_ns = int(self.files.t_ns[i])
            picture = _read_picture(self.files.paths[i], name, t_ns, ledger, limits, self.touched)
            if picture is None:
                continue
            yield from batch.add(t_ns, *picture)
        yield from batch.flush()


class PictureBatch:
    """Encoded images of one topic, collected for the next block."""

    def __init__(self, topic: str) -> None:
        """Begin a batch without images."""
        self._topic = topic
        self._rows: list[tuple[int, bytes, str]] = []
        self._size = 0

    def add(self, t_ns: int, picture: bytes, coding: str) -> Iterator[Block]:
        """Add an image; yield those before it if the block would be too large."""
        if self._size + len(picture) > BLOCK_BYTES:
            yield from self.flush()
        self._rows.append((t_ns, picture, coding))
        self._size += len(picture)

    def flush(self) -> Iterator[Block]:
        """Yield the collected images."""
        rows, self._rows, self._size = self._rows, [], 0
        if rows:
            t_ns, pictures, codings = zip(*rows, strict=True)
            yield image_block(self._topic, np.array(t_ns, np.int64), pictures, codings)


def _read_picture(
    path: Path, topic: str, t_ns: int, ledger: Ledger, limits: Limits, touched: Touched
) -> tuple[bytes, str] | None:
    """Return an undamaged image and its coding, or None after recording the reason."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise OSError("not a regular file")
        with open_noted(path, touched) as file:
            picture = file.read(limits.message_bytes + 1)
    except OSError as error:
        why = error.strerror or str(error)
        ledger.drop(topic, "picture cannot be opened", 1, f"{path.name}: {why}", t_ns)
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
        ledger.drop(topic, damage, 1, path.name, t_ns)
        return None
    ledger.find(topic, 1)
    _note_check(ledger, CHECKED[coding])
    return picture, coding


def _note_check(ledger: Ledger, check: str) -> None:
    if ledger.integrity == "not checked":
        ledger.integrity = check
    elif check not in ledger.integrity:
        ledger.integrity += f"; {check}"


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMES_SHOWN]) + (", ..." if len(names) > _NAMES_SHOWN else "")
