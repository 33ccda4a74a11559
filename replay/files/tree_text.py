r"""Parse JSON, TOML and YAML text with a limit on nesting, and spell file names in such text.

The parsers recurse, and so does most code that uses their results. The limit turns a hostile file
into an error of one clear line in every command.

A file name is bytes, but JSON, Parquet, TOML, HTML and recordings accept only valid text. Names are
therefore stored in a spelling: control characters, line separators and bytes that are not UTF-8 are
written as ``\xff``, a byte each, and a backslash as ``\\``. All other names are as they are.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Callable, Mapping
from json.encoder import encode_basestring_ascii as _quoted
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from .bounded import read_whole

if TYPE_CHECKING:
    from tomlkit import TOMLDocument

# Max levels of nested objects and arrays; a manifest has about ten.
MAX_DEPTH: Final = 64
# Max characters of a YAML text, whose parser takes about 20 us for each.
_MAX_YAML: Final = 1 << 20
# A string, also one cut off by the end of the text, so that matching takes linear time.
_STRING: Final = re.compile(rb'"[^"\\]*+(?:\\.[^"\\]*+)*+(?:"|\\?\Z)', re.DOTALL)
# A string or a comment, also one cut off; each character is tried once.
_TOML_QUOTED: Final = re.compile(
    r"""\"{3}[^"\\]*+(?:(?:\\.|"{1,2}(?!"))[^"\\]*+)*+(?:"{3,5}|\\?\Z)
    | '{3}[^']*+(?:'{1,2}(?!')[^']*+)*+(?:'{3,5}|\Z)
    | "[^"\\\n]*+(?:\\.[^"\\\n]*+)*+"? | '[^'\n]*+'? | \#[^\n]*+""",
    re.DOTALL | re.VERBOSE,
)
# A dotted key of more levels than allowed, in a text whose strings are replaced by letters.
_TOML_KEY: Final = re.compile(
    rf"(?<![\w-])[\w-]++(?:[ \t]*+\.[ \t]*+[\w-]++){{{MAX_DEPTH}}}", re.ASCII
)
_OPEN: Final = b"[{"
_NO_BRACKET: Final = bytes(set(range(256)) - set(b"[]{}"))
_TOO_DEEP: Final = f"nested over {MAX_DEPTH} levels deep"
_SPELLED: Final = re.compile("[\\\\\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_ESCAPE: Final = re.compile(rb"\\(?:(\\)|x([0-9a-f]{2}))")


def json_tree(
    text: str | bytes,
    object_pairs_hook: Callable[[list[tuple[str, Any]]], Any] | None = None,
    parse_constant: Callable[[str], Any] | None = None,
) -> Any:
    """Parse a JSON text; the arguments are those of ``json.loads``.

    Raises:
        ValueError: The text is not JSON, or nested too deeply; the message is one line.
    """
    if _depth(text) > MAX_DEPTH:
        raise ValueError(_TOO_DEEP)
    try:
        return json.loads(text, object_pairs_hook=object_pairs_hook, parse_constant=parse_constant)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def read_json(path: Path, max_bytes: int, refused: type[Exception], remedy: str) -> Any:
    """Return the tree of a JSON file; the arguments are those of ``bounded.read_text``."""
    try:
        return json_tree(read_whole(path, max_bytes))
    except OSError as error:
        raise refused(f"{path}: {error.strerror}; {remedy}") from None
    except ValueError as error:
        raise refused(f"{path}: not readable as JSON ({error}); {remedy}") from None


def toml_tree(text: str) -> dict[str, Any]:
    """Parse a TOML text.

    Raises:
        ValueError: The text is not TOML, or nested too deeply; the message is one line.
    """
    _check_toml(text)
    try:
        import tomllib  # most logs have no seal, and need none

        tree = tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    level: list[Any] = [tree]
    for _ in range(MAX_DEPTH):
        level = [branch for one in level for branch in _branches(one)]
    if level:
        raise ValueError(_TOO_DEEP)
    return tree


def toml_document(text: str) -> TOMLDocument:
    """Parse a TOML text so that it can be changed and written again with its comments.

    Raises:
        ValueError: The text is not TOML, or nested too deeply; the message is one line.
    """
    import tomlkit

    _check_toml(text)
    return tomlkit.parse(text)


def _check_toml(text: str) -> None:
    """Refuse deep nesting in linear time, because parsing it takes quadratic time and memory."""
    bare = _TOML_QUOTED.sub("s", text)
    if _TOML_KEY.search(bare) or _depth(bare) > MAX_DEPTH:
        raise ValueError(_TOO_DEEP)


def yaml_tree(text: str, scalars: Literal["safe", "base"] = "safe") -> Any:
    """Parse a YAML text.

    Args:
        text: The text. Anchors and aliases are refused: a few of them can stand for gigabytes.
        scalars: "base" returns every scalar as a string, "safe" also numbers and booleans.

    Raises:
        ValueError: The text is not YAML, too long, nested too deeply, or has an anchor or alias.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.composer import Composer
    from ruamel.yaml.error import YAMLError
    from ruamel.yaml.events import CollectionStartEvent

    class Bounded(Composer):
        """Composer without anchors and aliases, and of limited depth."""

        levels = 0

        def compose_node(self, parent: Any, index: Any) -> Any:
            event = self.parser.peek_event()
            if event.anchor is not None:
                raise ValueError("an anchor or alias, which is not supported")
            nested = isinstance(event, CollectionStartEvent)
            self.levels += nested
            if self.levels > MAX_DEPTH:
                raise ValueError(_TOO_DEEP)
            node = super().compose_node(parent, index)
            self.levels -= nested
            return node

    if len(text) > _MAX_YAML:
        raise ValueError(f"{len(text)} characters, the limit is {_MAX_YAML}")
    yaml = YAML(typ=scalars, pure=True)
    yaml.Composer = Bounded
    try:
        return yaml.load(text)
    except (YAMLError, RecursionError) as error:
        raise ValueError(str(error)) from None


def strict_json(value: object) -> str:
    """Return JSON text with sorted keys; NaN and infinities become null, all text valid."""
    return _text(value, "\n")


def spelled(name: str) -> str:
    """Return the spelling of a file name or path: one line of valid, printable text."""
    return _SPELLED.sub(_escape, name)


def unspelled(text: str) -> str:
    """Return the file name or path of which ``text`` is the spelling."""
    if "\\" not in text:
        return text
    raw = _ESCAPE.sub(lambda at: at[1] or bytes.fromhex(at[2].decode()), text.encode())
    return os.fsdecode(raw)


def valid_text(text: str) -> str:
    """Return a sentence that may contain file names, with bytes that are not UTF-8 escaped."""
    if text.isascii():
        return text
    return text.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _escape(found: re.Match[str]) -> str:
    if found[0] == "\\":
        return "\\\\"
    return "".join(f"\\x{byte:02x}" for byte in os.fsencode(found[0]))


def _text(value: object, line: str) -> str:
    """Return JSON text of which each line begins with ``line``; json itself indents slowly."""
    if isinstance(value, str):
        return _quoted(valid_text(value))
    inner = f"{line}  "
    if isinstance(value, dict | Mapping):
        items = sorted({valid_text(str(key)): item for key, item in value.items()}.items())
        rows = [f"{_quoted(key)}: {_text(item, inner)}" for key, item in items]
        return f"{{{inner}{f',{inner}'.join(rows)}{line}}}" if rows else "{}"
    if isinstance(value, list | tuple):
        rows = [_text(item, inner) for item in value]
        return f"[{inner}{f',{inner}'.join(rows)}{line}]" if rows else "[]"
    if isinstance(value, float) and not math.isfinite(value):
        return "null"
    return json.dumps(value)


def _branches(value: Any) -> list[Any]:
    below = value.values() if isinstance(value, dict) else value
    return [one for one in below if isinstance(one, dict | list)]


def _depth(text: str | bytes) -> int:
    """Return the nesting depth of the brackets outside strings; arbitrary if it is not JSON."""
    content = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    if content.count(b"[") + content.count(b"{") <= MAX_DEPTH:
        return 0
    brackets = _STRING.sub(b"", content).translate(None, _NO_BRACKET)
    if not brackets:
        return 0
    codes = np.frombuffer(brackets, np.uint8)
    steps = np.where(np.isin(codes, np.frombuffer(_OPEN, np.uint8)), 1, -1)
    return int(np.cumsum(steps).max())
