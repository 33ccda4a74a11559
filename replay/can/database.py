"""Read CAN databases (DBC, KCD, ARXML, SYM) and report what is doubtful about them.

cantools parses the files. This module detects what cantools accepts silently: truncated files,
identifiers defined twice, signals that overlap or do not fit, and text in another encoding.
"""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.replay.errors import CanDatabaseError, LogTooLargeError, SchemaError, one_line
from crosscue.replay.limits import DEFAULT_LIMITS, Limits

from .extract import MessageExtractor
from .layout import CanMessage, CanSignal, layout_problem, overlapping_signals
from .layout_cache import LayoutEntry, layout_cache_folder
from .sources import MAX_CANTOOLS, DatabaseText, doubts, read_text, refuse_bombs

if TYPE_CHECKING:
    from cantools.database.can import Message, Signal
    from cantools.database.can.internal_database import InternalDatabase

FORMATS: Final = ("dbc", "kcd", "arxml", "sym")
# Max reported pairs of overlapping signals in a message.
_MAX_PAIRS: Final = 100
# Two messages that are equal in these decode every frame to the same columns.
_LAYOUT: Final = ("name", "length", "signals")
_EXTENDED_FLAG: Final = 0x8000_0000


@dataclass(frozen=True, slots=True)
class CanDatabase:
    """The messages of one bus.

    Attributes:
        messages: One message for each identifier, in the order of the files.
        notices: Warnings about doubtful contents of the files, one sentence each.
    """

    messages: tuple[CanMessage, ...]
    notices: tuple[str, ...] = ()
    _extractors: dict[tuple[int, bool, frozenset[str] | None], MessageExtractor] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @classmethod
    def load(cls, paths: Sequence[Path | str], limits: Limits = DEFAULT_LIMITS) -> CanDatabase:
        """Read the database files that together describe one bus.

        Args:
            paths: Files ending in .dbc, .kcd, .arxml or .sym.
            limits: No file may be larger than ``message_bytes``.

        Raises:
            CanDatabaseError: A file is missing or does not parse.
            SchemaError: Two files contradict each other.
            LogTooLargeError: A file, or a size that it declares, exceeds the limit.
        """
        found: list[CanMessage] = []
        notices: list[str] = []
        for path in map(Path, paths):
            messages, doubtful = _load_file(path, limits)
            found += messages
            notices += doubtful
        return cls.of(found, notices)

    @classmethod
    def of(cls, messages: Iterable[CanMessage], notices: Iterable[str] = ()) -> CanDatabase:
        """Build a database from messages, and check for duplicate identifiers and names.

        Raises:
            SchemaError: Two messages with one identifier differ.
        """
        by_key: dict[tuple[int, bool], CanMessage] = {}
        said, harmful = [*notices], list[str]()
        for message in messages:
            kept = by_key.setdefault(message.key, message)
            if kept is message:
                continue
            twice = (
                f"{spell_id(*kept.key)} is defined as {kept.name} ({kept.source}) and as "
                f"{message.name} ({message.source})"
            )
            if all(getattr(kept, name) == getattr(message, name) for name in _LAYOUT):
                said.append(f"{twice}: with the same layout")
            else:
                harmful.append(twice)
        if harmful:
            more = f" (and {len(harmful) - 1} more)" if len(harmful) > 1 else ""
            raise SchemaError(
                f"{harmful[0]}{more}, with different signals; expected one definition for each "
                "identifier; pass only the file of this bus"
            )
        named, renamed = _with_topics(by_key.values())
        return cls(named, tuple(said + renamed))

    def find(self, arbitration_id: int, is_extended: bool) -> CanMessage | None:
        """Return the message with an identifier; 11-bit and 29-bit identifiers are distinct."""
        wanted = (arbitration_id, is_extended)
        return next((m for m in self.messages if m.key == wanted), None)

    def extractor(
        self, message: CanMessage, wanted: Collection[str] | None = None
    ) -> MessageExtractor:
        """Return the extractor of a message's signals, which is planned once for all logs.

        Args:
            message: One of ``messages``, without ``problem``.
            wanted: Names of the signals to extract, or None for all.
        """
        key = (*message.key, None if wanted is None else frozenset(wanted))
        found = self._extractors.get(key)
        if found is None:
            found = self._extractors.setdefault(key, MessageExtractor(message, wanted))
        return found

    def named(self, name: str) -> CanMessage:
        """Return the message with this ``name`` or ``topic_name``.

        Raises:
            ValueError: No message or several messages match; the error lists them.
        """
        fitting = [m for m in self.messages if name in (m.name, m.topic_name)]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            names = ", ".join(m.topic_name for m in fitting)
            raise ValueError(f"{len(fitting)} messages are named {name!r}; choose one of: {names}")
        near = difflib.get_close_matches(name, [m.topic_name for m in self.messages], n=3)
        hint = f"; did you mean {' or '.join(near)}" if near else ""
        raise ValueError(f"no message {name!r} among {len(self.messages)}{hint}")


def spell_id(arbitration_id: int, is_extended: bool) -> str:
    """Format an identifier with three hexadecimal digits, or eight if it is extended."""
    return f"0x{arbitration_id:08X} (extended)" if is_extended else f"0x{arbitration_id:03X}"


def _with_topics(messages: Iterable[CanMessage]) -> tuple[tuple[CanMessage, ...], list[str]]:
    """Return messages with distinct topics: identifiers are added where names are shared."""
    messages = list(messages)
    uses = Counter(message.name for message in messages)
    repeated = {name for name, n in uses.items() if n > 1}
    notices = [
        f"{uses[name]} messages are named {name}; their topics end in their identifiers"
        for name in sorted(repeated)
    ]
    named = tuple(
        replace(m, topic=f"{m.name}_0x{m.arbitration_id:X}{'x' if m.is_extended else ''}")
        if m.name in repeated
        else m
        if m.topic == m.name
        else replace(m, topic=m.name)
        for m in messages
    )
    return named, notices


def _load_file(path: Path, limits: Limits) -> tuple[list[CanMessage], list[str]]:
    form = path.suffix.lower().removeprefix(".")
    if form not in FORMATS:
        known = " ".join(f".{suffix}" for suffix in FORMATS)
        raise CanDatabaseError(f"{path}: not a CAN database; expected a name ending in {known}")
    source = read_text(path, limits)
    entry = LayoutEntry(source, form, layout_cache_folder())
    kept = entry.read()
    if kept is not None:
        return kept
    messages, notices = _read_layout(source, form)
    entry.write(messages, notices)
    return messages, notices


def _read_layout(source: DatabaseText, form: str) -> tuple[list[CanMessage], list[str]]:
    """Return messages, and notices about their doubtful contents."""
    path = source.path
    refuse_bombs(source, form)
    lines = source.lines_of_messages(form)
    marked = source.multiplexed_signals() if form == "dbc" else {}
    messages = []
    for one in _defined(source, form):
        line = lines.get(one.source)
        where = f"{path.name}:{line}" if line else path.name
        problem = one.problem or _problem(one, marked.get(one.source, []))
        messages.append(replace(one, source=where, problem=problem, topic=one.name))
    if not messages:
        raise CanDatabaseError(f"{path}: defines no message; check that the file is complete")
    notices = [*source.notices, *doubts(source, form, [m.name for m in messages])]
    for message in messages:
        notices += _doubts_of(message)
    empty = sum(not message.signals for message in messages)
    if empty:
        notices.append(f"{path.name}: {empty} of {len(messages)} messages have no signals")
    return messages, notices


def _defined(source: DatabaseText, form: str) -> list[CanMessage]:
    """Return the messages of a file, with the keys of ``lines_of_messages`` as ``source``."""
    from .dbc_text import read_dbc  # a layout in the cache does not need its patterns

    quick = read_dbc(source.text) if form == "dbc" else None
    if quick is not None:
        return quick
    parsed = _parse(source, form)
    distinguishes_fd = _distinguishes_fd(parsed, form)
    return [_message(one, form, distinguishes_fd) for one in parsed.messages]


def _parse(source: DatabaseText, form: str) -> InternalDatabase:
    from cantools.database.can.formats import arxml, dbc, kcd, sym

    if form in ("dbc", "sym") and len(source.text) > MAX_CANTOOLS:
        raise LogTooLargeError(
            f"{source.path}: {len(source.text)} characters with statements of unusual form, for "
            f"which the limit is {MAX_CANTOOLS}; save it with a DBC editor, or split it"
        )
    load: Callable[[str, bool], InternalDatabase]
    load = {"dbc": dbc, "kcd": kcd, "arxml": arxml, "sym": sym}[form].load_string
    try:
        # Not strict, because one bad message would fail the whole file. Each is checked afterwards.
        return load(source.text, False)
    except (RecursionError, MemoryError) as error:
        raise LogTooLargeError(
            f"{source.path}: too large or too deeply nested to parse ({type(error).__name__})"
        ) from None
    except Exception as error:  # cantools does not document what damaged files raise
        words = one_line(error, 300) or type(error).__name__
        line = source.line_of_error(str(error))
        raise CanDatabaseError(
            f"{source.path}:{line}: not a readable {form.upper()} file: {words}; "
            "correct that line or get a complete copy of the file"
        ) from None


def _distinguishes_fd(parsed: InternalDatabase, form: str) -> bool:
    """Return whether the file distinguishes CAN FD frames from classic ones."""
    if form == "dbc":
        return parsed.dbc is not None and "VFrameFormat" in parsed.dbc.attribute_definitions
    return form == "arxml"


def _message(parsed: Message, form: str, distinguishes_fd: bool) -> CanMessage:
    stored = str(parsed.frame_id | (_EXTENDED_FLAG if parsed.is_extended_frame else 0))
    return CanMessage(
        name=parsed.name,
        arbitration_id=parsed.frame_id,
        is_extended=parsed.is_extended_frame,
        length=parsed.length,
        signals=tuple(_signal(s) for s in parsed.signals),
        is_fd=parsed.is_fd if distinguishes_fd else None,
        problem="container message, not supported" if parsed.is_container else "",
        source=stored if form == "dbc" else parsed.name,
    )


def _problem(message: CanMessage, marked: list[str]) -> str:
    lost = [s.name for s in message.signals if s.name in marked and s.multiplexer is None]
    if lost:
        return f"signal {lost[0]} is multiplexed, but its multiplexer is not specified"
    return layout_problem(message)


def _signal(parsed: Signal) -> CanSignal:
    conversion = parsed.conversion
    return CanSignal(
        name=parsed.name,
        start=parsed.start,
        length=parsed.length,
        is_big_endian=parsed.byte_order == "big_endian",
        is_signed=parsed.is_signed,
        is_float=conversion.is_float,
        scale=conversion.scale,
        offset=conversion.offset,
        unit=parsed.unit or "",
        minimum=parsed.minimum,
        maximum=parsed.maximum,
        choices={int(raw): str(name) for raw, name in (conversion.choices or {}).items()},
        is_multiplexer=parsed.is_multiplexer,
        multiplexer=parsed.multiplexer_signal,
        branches=frozenset(parsed.multiplexer_ids or ()),
    )


def _doubts_of(message: CanMessage) -> list[str]:
    where = f"{message.source}: {message.name}"
    if not message.signals:
        return []
    if message.problem:
        return [f"{where} cannot be decoded: {message.problem}"]
    pairs = list(islice(overlapping_signals(message), _MAX_PAIRS + 1))
    notices = [f"{where}: signals {a} and {b} share bits" for a, b in pairs[:_MAX_PAIRS]]
    if len(pairs) > _MAX_PAIRS:
        notices.append(f"{where}: more signals share bits")
    for signal in message.signals:
        if signal.is_multiplexer and (signal.scale != 1 or signal.offset != 0):
            notices.append(
                f"{where}: multiplexer {signal.name} is scaled; its physical value selects the "
                "branch"
            )
        if signal.multiplexer is not None and not signal.branches:
            notices.append(f"{where}: no multiplexer value selects {signal.name}; it never occurs")
    return notices
