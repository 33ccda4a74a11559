"""Formats and variants of CAN log files, and the expected result of reading them."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from crosscue.replay.errors import CrosscueError
from crosscue.replay.logs.opening import open_log
from support.can_files import (
    START_NS,
    Sent,
    asc,
    blf,
    by_bus,
    candump,
    random_frames,
    read_back,
    trc,
)


@dataclass(frozen=True, slots=True)
class Kind:
    """One format or variant of a CAN log.

    Attributes:
        spell: Function from frames to the bytes of a file.
        suffix: Suffix of the file.
        fd: Supports CAN FD frames.
        buses: Records the bus of each frame.
        declares_end: A missing end can be detected, even after a complete line.
        start_ns: Log time at which its clock starts.
        step_ns: Resolution of its clock.
    """

    spell: Callable[[Sequence[Sent]], bytes]
    suffix: str
    fd: bool = True
    buses: bool = True
    declares_end: bool = False
    start_ns: int = START_NS
    step_ns: int = 1_000

    def frames(self, count: int, seed: int = 1) -> list[Sent]:
        """Generate frames that the format supports."""
        frames = random_frames(count, seed, fd=self.fd, step_ns=self.step_ns)
        return frames if self.buses else [replace(f, bus="1") for f in frames]

    def expected(self, frames: Sequence[Sent]) -> dict[str, list[Sent]]:
        """Return the frames that a reader is expected to yield, by topic."""
        shifted = [replace(f, t_ns=f.t_ns - START_NS + self.start_ns) for f in frames]
        return by_bus(shifted, "can{}" if self.suffix == ".log" else "can/{}")


KINDS = {
    "candump": Kind(candump, ".log"),
    "asc": Kind(asc, ".asc", declares_end=True),
    "asc-relative": Kind(lambda f: asc(f, relative=True), ".asc", declares_end=True),
    "asc-comma": Kind(lambda f: asc(f, mark=","), ".asc", declares_end=True),
    "trc-1.0": Kind(lambda f: trc(f, "1.0"), ".trc", fd=False, buses=False, start_ns=0),
    "trc-1.1": Kind(lambda f: trc(f, "1.1"), ".trc", fd=False, buses=False),
    "trc-1.2": Kind(lambda f: trc(f, "1.2"), ".trc", fd=False),
    "trc-1.3": Kind(lambda f: trc(f, "1.3"), ".trc", fd=False),
    "trc-2.1": Kind(trc, ".trc"),
    "blf": Kind(blf, ".blf", declares_end=True),
    "blf-stored": Kind(lambda f: blf(f, stored=True), ".blf", declares_end=True),
    "blf-old": Kind(lambda f: blf(f, is_old=True), ".blf", declares_end=True, step_ns=10_000),
    "blf-unclosed": Kind(lambda f: blf(f, is_closed=False), ".blf", declares_end=True, start_ns=0),
}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of reading a damaged copy.

    Attributes:
        word: ``refused``, ``same``, ``reported``, ``undetectable`` or, in capitals, a fault.
        why: Error message or counts that explain it.
    """

    word: str
    why: str = ""

    @property
    def is_fault(self) -> bool:
        """True if frames were lost or invented without a report, or an error was unclear."""
        return self.word.isupper()


def judge(kind: Kind, frames: Sequence[Sent], intact: bytes, copy: bytes, path: Path) -> Verdict:
    path.write_bytes(copy)
    try:
        open_log(path).close()
    except CrosscueError as refused:
        message = str(refused)
        is_clear = "\n" not in message and path.name in message
        return Verdict("refused" if is_clear else "UNCLEAR", message)
    found, ledger = read_back(path)
    sent = Counter((f.arbitration_id, f.payload) for f in frames)
    read = Counter((f.arbitration_id, f.payload) for rows in found.values() for f in rows)
    new, lost = (read - sent).total(), (sent - read).total()
    numbers = f"{new} new, {lost} lost, {len(frames)} sent"
    if new > hit(kind, intact, copy) or read.total() > len(frames):
        return Verdict("INVENTED", numbers)
    events = len(frames) // 50 + 1 if kind.suffix == ".asc" else 0
    is_empty_reported = any("no objects" in notice for notice in ledger.notices)
    if not ledger.is_whole or ledger.topic("").skipped.total() > events or is_empty_reported:
        return Verdict("reported", numbers)
    if read.total() < len(frames):
        # A text log that ends with a complete line is a valid, shorter log.
        is_short = not kind.declares_end and intact.startswith(copy) and copy.endswith(b"\n")
        return Verdict("undetectable" if is_short else "SILENT", numbers)
    return Verdict("same" if found == kind.expected(frames) else "undetectable", numbers)


def hit(kind: Kind, intact: bytes, copy: bytes) -> int:
    """Number of frames that the damage may have changed without a checksum to detect it."""
    if kind.suffix == ".blf":
        # A span of 64 bytes touches three objects of 48 at most.
        return 3 if kind is KINDS["blf-stored"] else 0
    places = [k for k, (a, b) in enumerate(zip(intact, copy, strict=False)) if a != b]
    return intact[places[0] : places[-1] + 1].count(b"\n") + 1 if places else 0
