"""One-line messages for validation errors of a settings file."""

import difflib
import re
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError

from crosscue.replay.files.bounded import read_text
from crosscue.replay.files.tree_text import toml_tree
from crosscue.replay.limits import MIB

from .section import tuples

# Maximum number of characters of an invalid value in a message.
GIVEN_CHARACTERS: Final = 80
# Maximum number of missing fields that a message names.
MAX_MISSING: Final = 8
Model = TypeVar("Model", bound=BaseModel)


def read_model(path: Path, model: type[Model], refused: type[Exception], remedy: str) -> Model:
    """Read and check a settings file in TOML, of at most 1 MiB.

    Args:
        path: The file.
        model: Model of the file.
        refused: Error that is raised if the file cannot be read, or a key or value is invalid.
        remedy: End of the message if it cannot be read: what was expected, or what to do.
    """
    return parse_model(read_text(path, MIB, refused, remedy), str(path), model, refused)


def parse_model(text: str, where: str, model: type[Model], refused: type[Exception]) -> Model:
    """Parse and check a text in TOML; ``where`` names it in errors, of the kind ``refused``."""
    try:
        return model.model_validate(tuples(toml_tree(text)))
    except ValidationError as error:
        raise refused(explain(error, text, where, model)) from None
    except ValueError as error:
        raise refused(f"{where}: not TOML: {error}; correct that line") from None


def explain(error: ValidationError, text: str | None, where: str, root: type[BaseModel]) -> str:
    """Describe a validation error in one line: place, problem, remedy.

    Args:
        error: The validation error.
        text: Text of the file if it is TOML, to report the line.
        where: Name of the file.
        root: Model of the file.
    """
    first, *others = found = error.errors(include_url=False)
    keys = [str(part) for part in first["loc"]]
    more = f" (and {len(others)} more)" if others else ""
    line = "" if text is None else f":{_line_of(keys, text)}"
    place = f"{where}{line}: {'.'.join(keys)}"
    if first["type"] == "extra_forbidden":
        return f"{place}: no such key; {_suggestion(keys, root)}{more}"
    if first["type"] == "missing":
        missing = [".".join(map(str, one["loc"])) for one in found if one["type"] == "missing"]
        named = missing[:MAX_MISSING]
        more = f" (and {len(found) - len(named)} more)" if len(found) > len(named) else ""
        them = "it" if len(named) == 1 else "them"
        return f"{where}{line}: {', '.join(named)}: missing; add {them}{more}"
    if not keys:
        return f"{where}: {first['msg'].removeprefix('Value error, ')}{more}"
    given = repr(first["input"])
    if len(given) > GIVEN_CHARACTERS:
        given = f"{given[:GIVEN_CHARACTERS]}..."
    return f"{place}: {first['msg'].lower()}, got {given}; correct the value{more}"


def _suggestion(keys: list[str], root: type[BaseModel]) -> str:
    section: type[BaseModel] | None = root
    is_table = False
    for key in keys[:-1]:
        if key.isdigit():
            # An index in a list of sections; the section itself is already known.
            continue
        if is_table:
            # A name in a table of sections; the section itself is already known.
            is_table = False
        elif section is not None:
            section, is_table = _section_of(section, key)
    known = sorted(section.model_fields) if section else []
    close = difflib.get_close_matches(keys[-1], known, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]}?"
    return f"there are: {', '.join(known)}" if known else "remove it"


def _section_of(section: type[BaseModel], key: str) -> tuple[type[BaseModel] | None, bool]:
    """Return the section below ``key``, and whether its entries have user-defined names."""
    field = section.model_fields.get(key)
    if field is None:
        return None, False
    return next(_models(field.annotation), None), get_origin(field.annotation) is dict


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)


def _line_of(keys: list[str], text: str) -> int:
    """Return the line of the deepest of ``keys`` that occurs in the text; 1 if none does."""
    names = [key for key in keys if not key.isdigit()]
    places = {key: int(at) for key, at in pairwise(keys) if at.isdigit()}
    seen: Counter[str] = Counter()
    table: list[str] = []
    best, best_depth = 1, 0
    for number, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*(\[+)\s*([^\]]+?)\s*\]+", line)
        entry = re.match(r"\s*([\w.\"'-]+)\s*=", line)
        if header:
            table = [part.strip("\"' ") for part in header[2].split(".")]
            here = table
            seen[table[-1]] += len(header[1]) > 1
        elif entry:
            here = table + [part.strip("\"' ") for part in entry[1].split(".")]
        else:
            continue
        if any(seen[key] - 1 != at for key, at in places.items() if seen[key]):
            # Another entry of a list of sections.
            continue
        depth = len(here)
        if here == names[:depth] and depth > best_depth:
            best, best_depth = number, depth
    return best
