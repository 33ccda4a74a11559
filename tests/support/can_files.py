"""CAN logs of each format, written from a list of frames and read back as such a list."""

import random
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import can

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import DATA, ERROR, REMOTE, CanFrames
from crosscue.replay.errors import CrosscueError
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log

# Noon of 10 July 2015, which the day count of TRC files represents exactly.
START_NS = 1_436_529_600_000_000_000
FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


@dataclass(frozen=True, slots=True)
class Sent:
    """One frame on the bus."""

    t_ns: int
    bus: str
    arbitration_id: int
    payload: bytes
    is_extended: bool = False
    kind: int = DATA
    is_fd: bool = False


def random_frames(
    count: int, seed: int = 1, *, fd: bool = True, step_ns: int = 1_000
) -> list[Sent]:
    """Generate ``count`` random frames of all kinds on two buses, in time order."""
    rng = random.Random(seed)
    frames, t_ns = [], START_NS
    for _ in range(count):
        t_ns += step_ns * rng.randrange(0, 2_000)
        is_extended = rng.random() < 0.3
        identifier = rng.randrange(0x20000000 if is_extended else 0x800)
        is_fd = fd and rng.random() < 0.2
        length = rng.choice(FD_LENGTHS) if is_fd else rng.randrange(9)
        kind = REMOTE if not is_fd and rng.random() < 0.05 else DATA
        payload = b"" if kind == REMOTE else rng.randbytes(length)
        bus = rng.choice(("1", "2"))
        frames.append(Sent(t_ns, bus, identifier, payload, is_extended, kind, is_fd))
    return frames


def candump_line(frame: Sent) -> str:
    """Format a frame as ``candump -l`` does."""
    flags = 0x20000000 if frame.kind == ERROR else 0
    width = 8 if frame.is_extended or flags else 3
    separator = "##1" if frame.is_fd else "#R" if frame.kind == REMOTE else "#"
    identifier = f"{frame.arbitration_id | flags:0{width}X}"
    seconds, nanos = divmod(frame.t_ns, 10**9)
    text = f"{identifier}{separator}{frame.payload.hex().upper()}"
    return f"({seconds:010d}.{nanos // 1000:06d}) can{frame.bus} {text}"


def candump(frames: Sequence[Sent]) -> bytes:
    return "".join(candump_line(frame) + "\n" for frame in frames).encode()


def _hex(payload: bytes) -> str:
    return payload.hex(" ").upper()


def asc(frames: Sequence[Sent], *, relative: bool = False, mark: str = ".") -> bytes:
    """A Vector ASC log, with a statistics line every fifty frames."""
    mode = "relative" if relative else "absolute"
    date = "Fri Jul 10 12:00:00.000 pm 2015"
    lines = [f"date {date}", f"base hex  timestamps {mode}", "internal events logged"]
    lines += [
        "// version 9.0.0",
        f"Begin Triggerblock {date}",
        f"   0{mark}000000 Start of measurement",
    ]
    before = START_NS
    for k, frame in enumerate(frames):
        seconds, nanos = divmod(frame.t_ns - (before if relative else START_NS), 10**9)
        time = f"{seconds:4}{mark}{nanos // 1000:06d}"
        before = frame.t_ns
        lines.append(f"{time} {_asc_body(frame)}")
        if k % 50 == 49:
            time = f"0{mark}000000" if relative else time
            lines.append(f"{time} 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.00%")
    return "".join(line + "\n" for line in [*lines, "End TriggerBlock"]).encode()


def _asc_body(frame: Sent) -> str:
    identifier = f"{frame.arbitration_id:X}{'x' if frame.is_extended else ''}"
    if frame.kind == ERROR:
        return f"{frame.bus}  ErrorFrame"
    if frame.kind == REMOTE:
        return f"{frame.bus}  {identifier:<15} Rx   r"
    if not frame.is_fd:
        length = len(frame.payload)
        rest = f" Length = 0 BitCount = 0 ID = {frame.arbitration_id}"
        return f"{frame.bus}  {identifier:<15} Rx   d {length:x} {_hex(frame.payload)} {rest}"
    code = FD_LENGTHS.index(len(frame.payload))
    name = "Name_of_it" if frame.arbitration_id % 2 else ""
    return (
        f"CANFD {frame.bus:>3} Rx {identifier:>8}  {name:>32} 1 0 {code:x} "
        f"{len(frame.payload):>2} {_hex(frame.payload)} 102203  133   303000 e0006659 46500250"
    )


def trc(frames: Sequence[Sent], version: str = "2.1") -> bytes:
    """A PEAK TRC log; versions below 2.0 have no CAN FD, below 1.2 one bus."""
    lines = [f";$FILEVERSION={version}", ";$STARTTIME=42195.5"]
    if version == "1.0":
        lines = [";  no version"]
    if version.startswith("2"):
        lines.append(";$COLUMNS=N,O,T,B,I,d,R,L,D")
    lines.append(";---+--   ----+----")
    for k, frame in enumerate(frames, 1):
        micros = (frame.t_ns - START_NS) // 1000
        time = f"{micros // 1000}.{micros % 1000:03d}"
        identifier = f"{frame.arbitration_id:0{8 if frame.is_extended else 4}X}"
        length = len(frame.payload)
        rest = "RTR" if frame.kind == REMOTE else _hex(frame.payload)
        rest = "" if version >= "2" and frame.kind == REMOTE else rest
        kind = "RR" if frame.kind == REMOTE else "FB" if frame.is_fd else "DT"
        bus, code = frame.bus, FD_LENGTHS.index(length)
        lines.append(
            {
                "1.0": f"{k:>6}) {time:>12}  {identifier:>8}  {length}  {rest}",
                "1.1": f"{k:>6}) {time:>12}  Rx  {identifier:>8}  {length}  {rest} ",
                "1.2": f"{k:>6}) {time:>12} {bus}  Rx  {identifier:>8}  {length}  {rest}",
                "1.3": f"{k:>6}) {time:>12} {bus}  Rx {identifier:>8} -  {length}  {rest}",
                "2.1": f"{k:>7} {time:>13} {kind} {bus:>2} {identifier:>8} Rx -  {code:<4} {rest}",
            }[version]
        )
    return "".join(line + "\r\n" for line in lines).encode()


def blf(
    frames: Sequence[Sent],
    *,
    container: int = 2000,
    stored: bool = False,
    is_closed: bool = True,
    is_old: bool = False,
) -> bytes:
    """A Vector BLF log, in which objects may span containers, as in those of Vector's tools.

    Args:
        frames: Frames to write.
        container: Bytes of content in each container.
        stored: Containers are not compressed.
        is_closed: The header has counts and times, which a writer adds when it closes the file.
        is_old: Times in steps of ten microseconds, header version 2, CAN_MESSAGE2.
    """
    content = b"".join(_blf_object(frame, is_old) for frame in frames)
    body = b""
    for k in range(0, len(content), container):
        part = content[k : k + container]
        coded = part if stored else zlib.compress(part)
        head = struct.pack(
            "<4sHHLLH6xL4x", b"LOBJ", 16, 1, 32 + len(coded), 10, 0 if stored else 2, len(part)
        )
        body += head + coded + bytes(len(coded) % 4)
    start, stop = (2015, 7, 5, 10, 12, 0, 0, 0), (2038, 7, 5, 10, 12, 0, 0, 0)
    times, count = ((*start, *stop), len(frames)) if is_closed else ((0,) * 16, 0)
    size = 144 + len(body) if is_closed else 144
    # Size of the header, application, its version, and BLF's; sizes, objects, and times.
    opening = (b"LOGG", 144, *(5, 0, 0, 0), *(2, 6, 8, 1))
    header = struct.pack("<4sL8BQQLL16H", *opening, size, 144 + len(content), count, 0, *times)
    return header.ljust(144, b"\0") + body


def _blf_object(frame: Sent, is_old: bool) -> bytes:
    identifier = frame.arbitration_id | (0x80000000 if frame.is_extended else 0)
    bus, length = int(frame.bus), len(frame.payload)
    flags = 0x80 if frame.kind == REMOTE else 0
    code = FD_LENGTHS.index(length)
    if frame.kind == ERROR:
        type_ = 73
        body = struct.pack(
            "<HHLBBBxLLH2x8s", bus, 0, 0, 0, 0, code, 0, identifier, 0, frame.payload
        )
    elif frame.is_fd and is_old:
        type_ = 101
        body = struct.pack(
            "<BBBBLLLLLLLHBBL", bus, code, length, 0, identifier, 0, 0x1000, 0, 0, 0, 0, 0, 0, 0, 0
        )
        body += frame.payload
    elif frame.is_fd:
        type_ = 100
        body = struct.pack(
            "<HBBLLBBB5x64s", bus, flags, code, identifier, 0, 0, 1, length, frame.payload
        )
    else:
        type_ = 86 if is_old else 1
        body = struct.pack("<HBBL8s", bus, flags, code, identifier, frame.payload)
        body += bytes(8) if is_old else b""
    ticks = (frame.t_ns - START_NS) // (10_000 if is_old else 1)
    head = struct.pack("<LHHQ", 1 if is_old else 2, 0, 0, ticks) + bytes(8 if is_old else 0)
    size = 16 + len(head) + len(body)
    base = struct.pack("<4sHHLL", b"LOBJ", 16 + len(head), 2 if is_old else 1, size, type_)
    return base + head + body + bytes(size % 4)


def python_can_message(frame: Sent) -> can.Message:
    return can.Message(
        timestamp=frame.t_ns * 1e-9,
        arbitration_id=frame.arbitration_id,
        is_extended_id=frame.is_extended,
        is_remote_frame=frame.kind == REMOTE,
        is_error_frame=frame.kind == ERROR,
        is_fd=frame.is_fd,
        data=frame.payload,
        channel=int(frame.bus),
    )


def frames_of(columns: CanFrames, log_ns: Sequence[int], bus: str) -> Iterator[Sent]:
    for k, t_ns in enumerate(log_ns):
        yield Sent(
            int(t_ns),
            bus,
            int(columns.arbitration_id[k]),
            columns.data[k, : columns.length[k]].tobytes(),
            bool(columns.is_extended[k]),
            int(columns.kind[k]),
            bool(columns.is_fd[k]),
        )


def read_back(
    path: Path, selection: Selection = EVERYTHING
) -> tuple[dict[str, list[Sent]], Ledger]:
    """Return all frames by topic, and the ledger."""
    ledger = Ledger(str(path))
    found: dict[str, list[Sent]] = {}
    with open_log(path) as log:
        for block in log.read(ledger, selection):
            assert isinstance(block.rows, CanFrames)
            assert not any(
                block.rows.data[k, length:].any() for k, length in enumerate(block.rows.length)
            )
            rows = frames_of(block.rows, block.log_ns.tolist(), block.topic)
            found.setdefault(block.topic, []).extend(rows)
        assert {topic.name for topic in log.topics} >= set(found)
    for name, rows_of_bus in found.items():
        assert ledger.topic(name).used == len(rows_of_bus)
    return found, ledger


def by_bus(frames: Sequence[Sent], spelled: str = "can/{}") -> dict[str, list[Sent]]:
    """Expected columns of a reader for ``frames``, if bus ``1`` is renamed to ``spelled``."""
    found: dict[str, list[Sent]] = {}
    for f in frames:
        name = spelled.format(f.bus)
        found.setdefault(name, []).append(replace(f, bus=name))
    return found


def damaged(intact: bytes, seed: int) -> bytes:
    """Replace 1 to 64 consecutive bytes by random ones or zeros, or flip one bit."""
    rng = random.Random(seed)
    at = rng.randrange(len(intact))
    count = min(rng.randrange(1, 65), len(intact) - at)
    match rng.randrange(3):
        case 0:
            patch = rng.randbytes(count)
        case 1:
            patch = bytes(count)
        case _:
            patch = bytes([intact[at] ^ 1 << rng.randrange(8)])
    return intact[:at] + patch + intact[at + len(patch) :]


def assert_equal_to_python_can(
    path: Path,
    peer: Iterable[can.Message],
    within_ns: int = 300,
    missing: int = 0,
    *,
    by_id: bool = False,
) -> None:
    """Compare our frames with python-can's, whose times are floats in seconds.

    With ``by_id``, the order of frames with different identifiers does not matter.
    """
    found, ledger = read_back(path)
    theirs: dict[str, list[can.Message]] = {}
    for message in peer:
        theirs.setdefault(f"can/{message.channel}", []).append(message)
    assert ledger.topic("").dropped.total() == missing
    assert missing or ledger.is_whole
    assert {name: len(frames) for name, frames in found.items()} == {
        name: len(messages) for name, messages in theirs.items()
    }
    for name, frames in found.items():
        if by_id:
            frames.sort(key=lambda one: one.arbitration_id)
            theirs[name].sort(key=lambda one: one.arbitration_id)
        for ours, message in zip(frames, theirs[name], strict=True):
            assert ours.arbitration_id == message.arbitration_id
            assert ours.payload == bytes(message.data)
            assert ours.kind == ERROR or ours.is_extended == message.is_extended_id
            assert ours.is_fd == message.is_fd
            assert (ours.kind == REMOTE) == message.is_remote_frame
            assert (ours.kind == ERROR) == message.is_error_frame
            assert abs(ours.t_ns - message.timestamp * 1e9) < within_ns


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
