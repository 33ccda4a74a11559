"""Layouts of CAN databases, kept in the user's cache folder so that a second start parses nothing.

A file's layout is kept under a hash of its text, its name and of all code that made it, cantools
included, so that no entry ever has to be told to be out of date. Entries are JSON behind their own
checksum, written whole. What cannot be read or written is as good as not there: the cache never
fails, and never answers for another file.

``$CROSSCUE_DBC_CACHE`` names another folder than ``~/.cache/crosscue/can_layouts``, or is ``off``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from hashlib import blake2b
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.limits import MIB

from .layout import CanMessage, CanSignal
from .sources import DatabaseText

VARIABLE: Final = "CROSSCUE_DBC_CACHE"
_ENTRY_BYTES: Final = 256 * MIB
_ENTRIES_KEPT: Final = 64
_HEAD: Final = b"crosscue CAN layout "
_MADE_BY: Final = ("database.py", "dbc_text.py", "layout.py", "layout_cache.py", "sources.py")


def cache_folder(environment: Mapping[str, str] = os.environ) -> Path | None:
    """Where layouts are kept, or None where they are not."""
    asked = environment.get(VARIABLE)
    if asked is not None:
        return None if asked.strip().lower() in ("", "off", "0", "no") else Path(asked)
    base = Path(environment.get("XDG_CACHE_HOME", ""))
    if not base.is_absolute():  # the XDG specification wants relative ones ignored
        try:
            base = Path.home() / ".cache"
        except RuntimeError:
            return None
    return base / "crosscue" / "can_layouts" if base.is_absolute() else None


class LayoutEntry:
    """The place of one file's layout in the cache."""

    def __init__(self, source: DatabaseText, form: str, folder: Path | None) -> None:
        """Name the place; ``folder`` None for no cache at all."""
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
        """Messages and notices as ``write`` got them, or None."""
        if self._path is None:
            return None
        try:
            stored = read_at_most(self._path, _ENTRY_BYTES)
        except OSError:
            return None
        head, _, body = (stored or b"").partition(b"\n")
        if head != _HEAD + _checksum(body):
            return None
        try:
            found = json.loads(body)
            messages = [_message(*row) for row in found["messages"]]
            return messages, list(found["notices"])
        except (ValueError, KeyError, TypeError, IndexError):
            return None

    def write(self, messages: list[CanMessage], notices: list[str]) -> None:
        """Keep a layout if the folder can be written."""
        if self._path is None:
            return
        rows = [_row(message) for message in messages]
        body = json.dumps({"notices": notices, "messages": rows}, separators=(",", ":")).encode()
        with suppress(OSError):
            folder = self._path.parent
            folder.mkdir(parents=True, exist_ok=True)
            _replace(self._path, _HEAD + _checksum(body) + b"\n" + body)
            _prune(folder)


def _replace(path: Path, content: bytes) -> None:
    """Write a file whole: another process sees the old one or this one."""
    import tempfile

    number, name = tempfile.mkstemp(prefix=".", suffix=".partial", dir=path.parent)
    try:
        with os.fdopen(number, "wb") as file:
            file.write(content)
        Path(name).replace(path)
    except OSError:
        Path(name).unlink()
        raise


def _prune(folder: Path) -> None:
    """Remove the oldest entries, and what killed processes left, beyond ``_ENTRIES_KEPT``."""
    entries = [(entry.stat().st_mtime, entry) for entry in folder.iterdir()]
    for _, entry in sorted(entries)[:-_ENTRIES_KEPT]:
        entry.unlink()


def _checksum(body: bytes) -> bytes:
    return blake2b(body, digest_size=16).hexdigest().encode()


@cache
def _made_by() -> str | None:
    """A hash of the code that makes layouts, with cantools' version; None if nobody can tell."""
    code = blake2b(digest_size=16)
    try:
        for name in _MADE_BY:
            code.update(Path(__file__).with_name(name).read_bytes())
        return f"{code.hexdigest()} {_version_of_cantools()}"
    except (OSError, ImportError, ValueError):
        return None


def _version_of_cantools() -> str:
    """Its version as installed, told without importing it or all that reads package metadata."""
    spec = find_spec("cantools")
    if spec is None or spec.origin is None:
        raise ImportError("cantools is not installed as files")
    package = Path(spec.origin)
    stamp = package.stat()
    installed = sorted(one.name for one in package.parents[1].glob("cantools-*.dist-info"))
    return f"{' '.join(installed)} {stamp.st_size} {stamp.st_mtime_ns}"


def _row(message: CanMessage) -> list[Any]:
    signals = [
        [
            s.name,
            s.start,
            s.length,
            s.is_big_endian,
            s.is_signed,
            s.is_float,
            s.scale,
            s.offset,
            s.unit,
            s.minimum,
            s.maximum,
            list(s.choices.items()),
            s.is_multiplexer,
            s.multiplexer,
            sorted(s.branches),
        ]
        for s in message.signals
    ]
    return [
        message.name,
        message.arbitration_id,
        message.is_extended,
        message.length,
        signals,
        message.is_fd,
        message.topic,
        message.problem,
        message.source,
    ]


def _message(
    name: str,
    arbitration_id: int,
    is_extended: bool,
    length: int,
    signals: list[list[Any]],
    *rest: Any,
) -> CanMessage:
    made = tuple(
        CanSignal(*[*row[:11], dict(row[11]), *row[12:14], frozenset(row[14])]) for row in signals
    )
    return CanMessage(name, arbitration_id, is_extended, length, made, *rest)
