"""What the signature of a verb states beyond types, defaults and names.

A verb is a function of the package whose command line is generated from it; see
``crosscue.eval.command_line``.
"""

import inspect
import re
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from typing import Any, Concatenate, Final, Literal, ParamSpec, TypeVar, overload

A = TypeVar("A")
B = TypeVar("B")
P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")


@dataclass(frozen=True, slots=True)
class Option:
    """How a parameter appears on the command line, where its name and type do not say it.

    Used as ``Annotated[TYPE, Option(...)]``.

    Attributes:
        name: Name of the option, such as ``--from``; default: from the parameter's name.
        metavar: Name of the value in the help; default: from the parameter's name, unit or type.
        is_positional: True for an optional parameter without a name on the command line.
        is_hidden: True for a parameter that is not on the command line.
        may_be_empty: True for a sequence of positionals that may be empty.
        group: Options of the same group exclude each other; ``json`` excludes ``--json``.
        convert: Function that converts one word, which may raise ``UsageError``.
        is_one_word: True for a sequence that ``convert`` makes from one word.
        made_by: Function that makes the value; its own parameters become options.
    """

    name: str | None = None
    metavar: str | tuple[str, ...] | None = None
    is_positional: bool = False
    is_hidden: bool = False
    may_be_empty: bool = False
    group: str | None = None
    convert: Callable[[str], object] | None = None
    is_one_word: bool = False
    made_by: Callable[..., object] | None = None


# For a parameter that is not on the command line.
HIDDEN: Final = Option(is_hidden=True)


@overload
def keywords(
    record: Callable[P, S],
) -> Callable[[Callable[[A, S], R]], Callable[Concatenate[A, P], R]]: ...
@overload
def keywords(
    record: Callable[P, S], leading: Literal[0]
) -> Callable[[Callable[[S], R]], Callable[P, R]]: ...
@overload
def keywords(
    record: Callable[P, S], leading: Literal[2]
) -> Callable[[Callable[[A, B, S], R]], Callable[Concatenate[A, B, P], R]]: ...
def keywords(record: Callable[..., Any], leading: int = 1) -> Any:
    """Let a verb take the fields of its record of settings as arguments.

    ``replay_drive(log, output, settings)`` is then called as ``replay_drive(log, output, draw=3)``.
    Its help describes the fields, from the record's docstring.

    Args:
        record: The frozen dataclass of settings.
        leading: Number of parameters before the settings.
    """

    def wrap(function: Callable[..., Any]) -> Callable[..., Any]:
        own = list(inspect.signature(function).parameters.values())
        replaced = own.pop(leading).name
        settings = list(inspect.signature(record).parameters.values())
        signature = inspect.signature(function).replace(parameters=[*own, *settings])

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            bound = signature.bind(*args, **kwargs).arguments
            first = [bound.pop(one.name) for one in own]
            return function(*first, record(**bound))

        attributes = attributes_of(record)
        item = rf"^    {replaced}: .*\n?(?:     +.*\n?)*"
        text = inspect.getdoc(function) or ""
        call.__doc__ = re.sub(item, lambda _: f"{attributes}\n", text, flags=re.MULTILINE)
        call.__signature__ = signature  # type: ignore[attr-defined]
        call.takes_record = function  # type: ignore[attr-defined]
        return call

    return wrap


def attributes_of(record: object) -> str:
    """Return the descriptions of a record's fields, also of those that it inherits."""
    kinds = reversed(record.__mro__) if isinstance(record, type) else ()
    texts = [inspect.cleandoc(vars(kind).get("__doc__") or "") for kind in kinds]
    found = [text.partition("Attributes:\n")[2].partition("\n\n")[0] for text in texts]
    return "\n".join(filter(None, found))


def compared(record: object) -> dict[str, object]:
    """Return the settings of a record that determine a result, by name.

    These are the fields that dataclasses compare. How a result is made, such as the number of
    workers, is declared with ``field(compare=False)``.
    """
    assert is_dataclass(record)
    return {one.name: getattr(record, one.name) for one in fields(record) if one.compare}
