"""The text of a CAN database file: its encoding, its lines, and signs of truncation."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.replay.errors import CanDatabaseError, LogTooLargeError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.limits import MIB, Limits

# Upper bound on the bits of a message; the longest multi-packet message has 1785 bytes.
_MAX_BITS: Final = 8 * 2048
_MAX_BRANCHES: Final = 1_000_000
# Max characters of a DBC or SYM text for cantools, which takes up to 340 bytes for each.
MAX_CANTOOLS: Final = 2 * MIB

_MESSAGE_HEADS: Final = {
    "dbc": r"^[ \t]*BO_\s+(\d+)",
    "sym": r'^\["?([^\]"\n]+)"?\]',
    "kcd": r"<Message\b[^<>]*?\bname=\"([^\"]*)\"",
    "arxml": r"<SHORT-NAME>([^<]*)</SHORT-NAME>",
}

_BYTE_ORDER_MARKS: Final = (
    (b"\xef\xbb\xbf", "utf-8"),
    (b"\xff\xfe", "utf-16-le"),
    (b"\xfe\xff", "utf-16-be"),
)


@dataclass(frozen=True, slots=True)
class DatabaseText:
    """One file as text.

    Attributes:
        path: Path of the file.
        text: Decoded text, with the line ends of the file.
        notices: Warnings about its encoding.
    """

    path: Path
    text: str
    notices: tuple[str, ...] = ()

    def line_at(self, position: int) -> int:
        """Return the number of the line that holds the character at ``position``, from 1."""
        return self.text.count("\n", 0, position) + 1

    def lines_of_messages(self, form: str) -> dict[str, int]:
        """Return the line numbers of message definitions in a file of this format.

        The key is the stored identifier with its flag bit in a DBC file, and the name elsewhere.
        """
        lines: dict[str, int] = {}
        line, position = 1, 0
        for match in re.finditer(_MESSAGE_HEADS[form], self.text, re.MULTILINE):
            line += self.text.count("\n", position, match.start(1))
            position = match.start(1)
            lines.setdefault(match[1], line)
        return lines

    def multiplexed_signals(self) -> dict[str, list[str]]:
        """Return the signals of a DBC file marked as multiplexed, by stored identifier."""
        marked: dict[str, list[str]] = {}
        for block in re.split(r"^[ \t]*BO_\s+", self.text, flags=re.MULTILINE)[1:]:
            names = re.findall(r"^[ \t]*SG_\s+(\w+)\s+m\d+M?\s*:", block, re.MULTILINE)
            if names:
                marked[block.split(None, 1)[0]] = names
        return marked

    def line_of_error(self, words: str) -> int:
        """Return the line that a parser's error refers to; the last line if it names none."""
        if match := re.search(r"\bline (\d+)", words):
            return int(match[1])
        for name in re.findall(r"(?:VAL_|SIG_VALTYPE_) (\d+ \w+)|message (\w+)", words):
            pattern = r"\b" + r"\s+".join(re.escape(part) for part in max(name).split()) + r"\b"
            if match := re.search(pattern, self.text):
                return self.line_at(match.end())
        return self.line_at(len(self.text.rstrip()))


def read_text(path: Path, limits: Limits) -> DatabaseText:
    """Read a file without a declared encoding.

    The encoding is UTF-8 if that is valid, else Windows-1252, which DBC editors write. XML
    declarations and byte order marks take precedence.

    Raises:
        CanDatabaseError: It cannot be read, is empty or is binary.
        LogTooLargeError: It is larger than ``limits.message_bytes``.
    """
    try:
        if not path.is_file():
            raise CanDatabaseError(f"{path}: no such file; expected a CAN database")
        stored = read_at_most(path, limits.message_bytes)
    except OSError as error:
        raise CanDatabaseError(f"{path}: {error.strerror or error}; check the path") from None
    if stored is None:
        raise LogTooLargeError(f"{path}: larger than {limits.message_bytes} bytes; not a database")
    text, notices = _decode(path, stored)
    if not text.strip():
        raise CanDatabaseError(f"{path}:1: empty; expected a CAN database")
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise CanDatabaseError(
            f"{path}:{line}: contains zero bytes; the file is damaged or not a text file"
        )
    return DatabaseText(path, text, notices)


def _decode(path: Path, stored: bytes) -> tuple[str, tuple[str, ...]]:
    for mark, encoding in _BYTE_ORDER_MARKS:
        if stored.startswith(mark):
            return stored[len(mark) :].decode(encoding, errors="replace"), ()
    declared = re.match(rb"""\s*<\?xml[^>]*encoding=["']([\w.-]+)["']""", stored[:400])
    candidates = ["utf-8", "cp1252"]
    if declared:
        candidates.insert(0, declared[1].decode("ascii"))
    for encoding in candidates:
        try:
            return stored.decode(encoding), ()
        except (UnicodeDecodeError, LookupError):
            continue
    return stored.decode("cp1252", errors="replace"), (
        f"{path.name}: neither UTF-8 nor Windows-1252; unknown characters were replaced",
    )


def refuse_bombs(source: DatabaseText, form: str) -> None:
    """Refuse numbers that would make the parser allocate excessive memory.

    Raises:
        LogTooLargeError: A message or signal is declared as thousands of bytes long, or a
            multiplexer range has more than a million values.
    """
    if form == "dbc":
        _refuse_over(source, r"^[ \t]*SG_\b[^:\n]*:\s*(\d{5,})\s*\|", "start bit")
        _refuse_over(source, r"^[ \t]*SG_\b[^:\n]*:\s*\d+\s*\|\s*(\d{5,})", "signal length")
        _refuse_over(source, r"^[ \t]*BO_\s+\d+\s+\w+\s*:\s*(\d{4,})", "message length", 8)
        _refuse_ranges(source)
    elif form == "kcd":
        _refuse_over(source, r"\b(?:offset|length)\s*=\s*[\"'](\d{5,})[\"']", "offset or length")
    elif form == "arxml":
        sizes = r"<(?:FRAME-LENGTH|LENGTH|START-POSITION)>\s*(\d{5,})"
        _refuse_over(source, sizes, "length or position")
    elif form == "sym":
        numbers = r"\b(?:Var|Sig|Mux|Len|DLC)\b(?>[^\n]*?\b(\d{5,})\b|[^\n]*)"
        _refuse_over(source, numbers, "bit number")


def _refuse_over(source: DatabaseText, pattern: str, what: str, bits_each: int = 1) -> None:
    for match in re.finditer(pattern, source.text, re.MULTILINE):
        digits = match[1] or "0"
        if len(digits) > 9 or int(digits) * bits_each > _MAX_BITS:
            raise LogTooLargeError(
                f"{source.path}:{source.line_at(match.start(1))}: {what} {digits[:20]} is larger "
                "than any CAN message; correct that line"
            )


def _refuse_ranges(source: DatabaseText) -> None:
    total = 0
    for match in re.finditer(r"^[ \t]*SG_MUL_VAL_[^;]*", source.text, re.MULTILINE):
        for low, high in re.findall(r"(\d+)\s*-\s*(\d+)", match[0]):
            total += int(high[:30]) - int(low[:30])
        if total > _MAX_BRANCHES:
            raise LogTooLargeError(
                f"{source.path}:{source.line_at(match.start())}: multiplexer ranges of more than "
                f"{_MAX_BRANCHES} values; correct that line"
            )


def doubts(source: DatabaseText, form: str, names: list[str]) -> list[str]:
    """Return signs that a file was truncated although it parses.

    Only DBC and SYM files can be truncated and still parse, because nothing marks their end. A
    truncation after a complete line of the closing section cannot be detected.
    """
    if form not in ("dbc", "sym"):
        return []
    text, name = source.text, source.path.name
    notices = []
    if form == "dbc" and not text.rstrip().endswith(";"):
        last = names[-1]
        notices.append(
            f"{name}: ends with the definition of message {last} and has no closing section; "
            "if messages are missing, the file is truncated"
        )
    if not text.endswith(("\n", "\r")):
        line = text.splitlines()[-1].strip()
        notices.append(
            f"{name}:{source.line_at(len(text))}: the last line has no end ({line[-60:]!r}); "
            "the file may be truncated"
        )
    return notices
