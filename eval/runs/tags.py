"""Tags of a run: labels that users set on it, such as ``weather=rain``.

They are stored in a separate file, so that tagging does not change the bytes of a run's inputs and
results.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import StringConstraints, ValidationError

from crosscue.replay.errors import UnreadableRunError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text

from .folder import TAGS
from .record import Record

KEY: Final = r"[A-Za-z_][A-Za-z0-9_.-]{0,63}"
MAX_VALUE: Final = 1000


class _Tags(Record):
    format_version: Literal[1] = 1
    tags: dict[
        Annotated[str, StringConstraints(pattern=rf"^{KEY}$")],
        Annotated[str, StringConstraints(max_length=MAX_VALUE)],
    ]


def parse_tags(content: bytes) -> dict[str, str]:
    """Parse the content of ``tags.json``.

    Raises:
        ValueError: The content is invalid; the message has one line.
    """
    try:
        return dict(sorted(_Tags.model_validate_json(content).tags.items()))
    except ValidationError as error:
        why = error.errors(include_url=False)[0]["msg"].lower()
        raise ValueError(f"{TAGS}: unreadable ({why}); delete it and tag the run again") from None


def read_tags(run: Path) -> dict[str, str]:
    """Read the tags of a run folder; empty without a tags file.

    Raises:
        UnreadableRunError: The file cannot be read.
    """
    path = run / TAGS
    try:
        return parse_tags(door.read(path))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise UnreadableRunError(f"{path}: {error.strerror}; check its mode") from None
    except ValueError as error:
        raise UnreadableRunError(f"{run}: {error}") from None


def write_tags(run: Path, tags: Mapping[str, str]) -> None:
    """Replace the tags of a run folder; delete its tags file without any.

    Raises:
        OutputError: The file cannot be written.
    """
    if tags:
        content = _Tags(tags=dict(sorted(tags.items())))
        write_text(run / TAGS, strict_json(content.as_json()) + "\n")
    else:
        (run / TAGS).unlink(missing_ok=True)


def assignments(tags: Mapping[str, str] | Sequence[str], remove: Sequence[str]) -> dict[str, str]:
    """Return the tags to set, by key, after checking them.

    Args:
        tags: Values by key, or texts such as ``weather=rain``.
        remove: Keys to remove.

    Raises:
        UsageError: A key or value is invalid, or a key is set twice, or both set and removed.
    """
    texts = [f"{key}={value}" for key, value in tags.items()] if isinstance(tags, Mapping) else tags
    found: dict[str, str] = {}
    for key, value in map(_assignment, texts):
        if key in found or key in remove:
            raise UsageError(f"{key}: set twice, or set and removed; name each key once")
        found[key] = value
    for key in remove:
        if re.fullmatch(KEY, key) is None:
            raise UsageError(f"{key}: not a valid key of a tag; expected one such as weather")
    return found


def _assignment(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    is_fine = re.fullmatch(KEY, key) is not None and 0 < len(value) <= MAX_VALUE
    if not (equals and is_fine and value.isprintable()):
        raise UsageError(
            f"{text}: expected KEY=VALUE, the key of letters, digits, '_', '.' and '-', "
            "such as weather=rain"
        )
    return key, value
