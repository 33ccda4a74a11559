"""Read a log that has a seal, and check the bytes that are read against the seal.

A block of a seal is one MiB, and the row of a changed byte is unknown. The rows of a damaged block
are therefore delivered, the block is reported as damaged (file, first byte, one past the last), and
the log is incomplete. Withholding the rows would turn one wrong byte into the loss of thousands of
correct rows.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

from crosscue.replay.base import EVERYTHING, Log, Selection, WrappedLog
from crosscue.replay.columns import Block
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import CHANGED, DIFFERS, Ledger
from crosscue.replay.safe_text import counted

from .seal import HASH, Check, Seal, seal_over, seal_path
from .touched import Blocks, Touched

_SPANS_SHOWN: Final = 3


@runtime_checkable
class Touching(Protocol):
    """Log that records which bytes of its files it reads; other logs are checked completely."""

    @property
    def touched(self) -> Touched:
        """Record of the blocks that were read."""


def with_seal(path: Path, opened: Callable[[], Log], *, is_part: bool = False) -> Log:
    """Open a log, and check it against its seal or the seal of a folder that contains it, if any.

    Args:
        path: The log.
        opened: Function that opens the log without a seal.
        is_part: The log is read as a part of a folder, whose own seal covers it.

    Raises:
        LogError: The seal is damaged, or the log cannot be opened; the message then reports the
            damage that the seal shows.
        OSError: Like ``opened``.
    """
    found = seal_over(path)
    if found is None or (is_part and found[0] != seal_path(path)):
        log = opened()
        if found is None and isinstance(log, Touching):
            log.touched.of_opening()  # of a log without a seal, blocks need not be recorded
        return log
    at, seal = found
    try:
        return SealedLog(opened(), seal, None if at == seal_path(path) else at)
    except LogError as error:
        check = Check(path, seal)
        _exhaust(check.everything())
        spans = [f"{s.name}: bytes {s.start} to {s.stop}" for s in check.damaged()]
        found_odd = [*check.oddities, *spans[:_SPANS_SHOWN]]
        if not found_odd:
            raise
        raise type(error)(f"{error}; its seal differs: {'; '.join(found_odd)}") from None


class SealedLog(WrappedLog):
    """Log that checks its seal; see ``crosscue.replay.base.Log`` and the head of this module."""

    def __init__(self, log: Log, seal: Seal, folders: Path | None = None) -> None:
        """Wrap ``log``; ``folders`` is the seal file if it belongs to a folder around the log."""
        super().__init__(log)
        self.seal: Final = seal
        self.folders: Final = folders
        self._touched: Final = log.touched if isinstance(log, Touching) else None
        self._opening: Final = {} if self._touched is None else self._touched.of_opening()

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield the log's blocks; a log that records its reads is checked before each block."""
        check = Check(self.path, self.seal)
        for sentence in check.oddities:
            ledger.drop("", CHANGED, None, sentence)
        try:
            if self._touched is None:
                yield from self._log.read(ledger, selection)
                _exhaust(check.everything())
            else:
                yield from self._checked(self._touched, check, ledger, selection)
                if selection == EVERYTHING:
                    # Parts that no reader needs, such as indexes, belong to the log as well.
                    _exhaust(check.everything())
        finally:
            _report(check, ledger)

    def report_missing(self, ledger: Ledger) -> None:
        """Report missing parts of the log, and files that are missing, new or of another size."""
        for sentence in Check(self.path, self.seal).oddities:
            ledger.drop("", CHANGED, None, sentence)
        super().report_missing(ledger)

    def _checked(
        self, touched: Touched, check: Check, ledger: Ledger, selection: Selection
    ) -> Iterator[Block]:
        _check_blocks(check, self._opening)
        with touched.listened() as heard:
            for block in self._log.read(ledger, selection):
                _check_blocks(check, touched.taken(heard))
                yield block
            _check_blocks(check, touched.taken(heard))


def _check_blocks(check: Check, blocks: Blocks) -> None:
    for path, numbers in blocks.items():
        if (name := check.named(path)) is not None:
            _exhaust(check.blocks(name, sorted(numbers)))


def _exhaust(steps: Iterator[int]) -> None:
    for _ in steps:
        pass


def _report(check: Check, ledger: Ledger) -> None:
    """Report differences in the ledger, and how much was checked."""
    seal = check.seal
    spans = list(check.damaged())
    for span in spans:
        ledger.drop("", DIFFERS, None, f"{span.name}: bytes {span.start} to {span.stop}")
    blocks = counted(seal.blocks, "block")
    state = f"sealed at {seal.sealed_at} ({HASH}): {check.checked} of {blocks} of 1 MiB"
    bad = "some differ" if spans else "none differs"
    ledger.integrity = f"{ledger.integrity}; {state} were checked, {bad}"


def sealed_sentence(log: Log) -> str:
    """Describe when and how a log was sealed; empty for a log without a seal."""
    if not isinstance(log, SealedLog):
        return "not sealed"
    seal = log.seal
    by = "" if log.folders is None else f", by {log.folders.name} of the folder it is in"
    return f"sealed at {seal.sealed_at} ({HASH}, {counted(seal.blocks, 'block')} of 1 MiB{by})"
