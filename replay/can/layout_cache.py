"""Cache of the layouts of CAN databases, in the user's cache folder, so that each is parsed once.

The key of an entry is a hash of the database's text, its name and the code that parses it,
including cantools, so that no entry is ever stale. An entry is JSON after its own checksum, and is
written atomically: one line for the messages, then one line for the signals of each message. The
lines of signals are parsed on first use. An entry that cannot be read or written is treated as
missing, so the cache never fails.

``$CROSSCUE_DBC_CACHE`` replaces the folder ``~/.cache/crosscue/can_layouts``; ``off`` disables the
cache.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import cache, cached_property
from hashlib import blake2b
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final, overload

from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.files.whole_file import write_bytes
from crosscue.replay.limits import MIB

from .layout import CanMessage, CanSignal
from .sources import DatabaseText

VARIABLE: Final = "CROSSCUE_DBC_CACHE"
_ENTRY_BYTES: Final = 256 * MIB
_ENTRIES_KEPT: Final = 64
_HEAD: Final = b"crosscue CAN layout "
_HEAD_FIELDS: Final = tuple(one.name for one in fields(CanMessage) if one.name != "signals")
_MADE_BY: Final = ("database.py", "dbc_text.py", "layout.py", "layout_cache.py", "sources.py")


def layout_cache_folder() -> Path | None:
    """Return the folder of the cache, or None if it is disabled or there is no home folder."""
    asked = os.environ.get(VARIABLE)
    if asked is not None:
        return None if asked.strip().lower() in ("", "off", "0", "no") else Path(asked)
    with suppress(UsageError):
        return door.user_cache(VARIABLE) / "can_layouts"
    return None


class LayoutEntry:
    """Cache entry of one file's layout."""

    def __init__(self, source: DatabaseText, form: str, folder: Path | None) -> None:
        """Compute the path of the entry; ``folder`` is None if the cache is disabled."""
        self._path: Path | None = None
        made_by = _made_by() if folder else None
        if folder is None or made_by is None:
            return
        key = blake2b(digest_size=20)
        for part in (made_by, form, source.path.name, source.text, *source.notices):
            stored = part.encode("utf-8", "surrogatepass")
            key.update(b"%d " % len(stored))
            key.update(stored)
        self._path = folder / f"{key.hexdigest()}.json"

    def read(self) -> tuple[list[CanMessage], list[str]] | None:
        """Return the messages and notices passed to ``write``, or None if there is no entry."""
        if self._path is None:
            return None
        try:
            stored = door.read(self._path, _ENTRY_BYTES)
        except OSError:
            return None
        head, _, body = stored.partition(b"\n")
        if head != _HEAD + _checksum(body):
            return None
        try:
            first, *lines = body.split(b"\n")
            found = json_tree(first)
            rows = zip(found["messages"], lines, strict=True)
            return [_message(line, row) for row, line in rows], list(found["notices"])
        except (ValueError, KeyError, TypeError, IndexError):
            return None

    def write(self, messages: list[CanMessage], notices: list[str]) -> None:
        """Store a layout if the folder is writable."""
        if self._path is None:
            return
        heads = [[getattr(message, name) for name in _HEAD_FIELDS] for message in messages]
        parts = [{"notices": notices, "messages": heads}, *map(_signals, messages)]
        body = "\n".join(json.dumps(one, separators=(",", ":")) for one in parts).encode()
        with suppress(OSError, OutputError):
            folder = self._path.parent
            folder.mkdir(parents=True, exist_ok=True)
            write_bytes(self._path, _HEAD + _checksum(body) + b"\n" + body)
            # The oldest files go, including those of killed processes.
            entries = [(entry.stat().st_mtime, entry) for entry in folder.iterdir()]
            for _, entry in sorted(entries)[:-_ENTRIES_KEPT]:
                entry.unlink()


def _checksum(body: bytes) -> bytes:
    return blake2b(body, digest_size=16).hexdigest().encode()


@cache
def _made_by() -> str | None:
    """Return a hash of the parsing code and cantools' version; None if it cannot be determined."""
    code = blake2b(digest_size=16)
    try:
        for name in _MADE_BY:
            code.update(Path(__file__).with_name(name).read_bytes())
        return f"{code.hexdigest()} {_version_of_cantools()}"
    except (OSError, ImportError, ValueError):
        return None


def _version_of_cantools() -> str:
    """Return the installed version, without the slow imports of cantools or package metadata."""
    spec = find_spec("cantools")
    if spec is None or spec.origin is None:
        raise ImportError("cantools is not installed as files")
    package = Path(spec.origin)
    stamp = package.stat()
    installed = sorted(one.name for one in package.parents[1].glob("cantools-*.dist-info"))
    return f"{' '.join(installed)} {stamp.st_size} {stamp.st_mtime_ns}"


class _StoredSignals(Sequence[CanSignal]):
    """The signals of one message, parsed on first use."""

    def __init__(self, line: bytes) -> None:
        self._line = line

    @cached_property
    def _parsed(self) -> tuple[CanSignal, ...]:
        return tuple(
            CanSignal(*[*row[:11], dict(row[11]), *row[12:14], frozenset(row[14])])
            for row in json_tree(self._line)
        )

    def __len__(self) -> int:
        return len(self._parsed)

    def __iter__(self) -> Iterator[CanSignal]:
        return iter(self._parsed)

    @overload
    def __getitem__(self, at: int) -> CanSignal: ...
    @overload
    def __getitem__(self, at: slice) -> Sequence[CanSignal]: ...
    def __getitem__(self, at: int | slice) -> CanSignal | Sequence[CanSignal]:
        return self._parsed[at]

    def __eq__(self, other: object) -> bool:
        return self._parsed == (other._parsed if isinstance(other, _StoredSignals) else other)

    def __hash__(self) -> int:
        return hash(self._parsed)

    def __repr__(self) -> str:
        return repr(self._parsed)


def _signals(message: CanMessage) -> list[Any]:
    names = [one.name for one in fields(CanSignal)]
    return [[_stored(getattr(signal, name)) for name in names] for signal in message.signals]


def _stored(value: object) -> object:
    if isinstance(value, Mapping):
        return list(value.items())
    return sorted(value) if isinstance(value, frozenset) else value


def _message(line: bytes, row: Sequence[Any]) -> CanMessage:
    return CanMessage(signals=_StoredSignals(line), **dict(zip(_HEAD_FIELDS, row, strict=True)))
