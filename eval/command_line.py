"""The command line of a verb, generated from its function's signature and docstring.

A parameter without a default is a positional, or ``-o/--output``; every other parameter is an
option. ``Args:`` is the help of the options, the rest of the docstring that of the command. Types
say how words are read: ``Literal`` as choices, ``bool`` as a flag, sequences as several words. A
frozen dataclass stands for its fields. ``crosscue.verb.Option`` states what remains.
"""

from __future__ import annotations

import argparse
import inspect
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from crosscue.replay.errors import UsageError
from crosscue.results import Result
from crosscue.verb import Option, attributes_of

# Metavar by name of a parameter, the same in every command.
METAVARS: Final = {
    "vehicle": "V.toml",
    "truth": "T.json",
    "landmarks": "DB",
    "database": "DB",
    "threshold": "P",
    "precision": "P",
    "overlap": "IOU",
    "ray": "ADDRESS",
    "junit": "XML",
    "log": "LOG",
    "logs": "LOG",
    "run": "RUN",
    "runs": "RUN",
    "output": "DIR",
    "matcher": "NAME",
    "classes": "NAME",
    "labels": "LABELS",
    "topics": "TOPIC",
}
# Metavar by the unit that ends a parameter's name.
UNITS: Final = {"m": "M", "s": "S", "px": "PX", "deg": "DEG", "gib": "GIB"}
TYPES: Final[dict[Any, str]] = {int: "N", float: "X", Path: "FILE", str: "NAME"}
Groups = dict[str, argparse._MutuallyExclusiveGroup]
_SECTION: Final = re.compile(r"^(Args|Attributes|Returns|Yields|Raises|Examples?):$", re.MULTILINE)
_LEAD: Final = re.compile(
    r"(?P<names>\w+(?:, \w+)*): (?:(?P<value>[^\s,]+|(?:\S+|[^,]*)(?=, expected )), )?"
)


@dataclass(frozen=True, slots=True)
class Described:
    """A docstring in parts.

    Attributes:
        text: Summary and body.
        examples: Lines of examples.
        parameters: Text on each parameter or attribute.
    """

    text: str
    examples: str
    parameters: Mapping[str, str]


@dataclass(slots=True)
class Call:
    """A call of a function with arguments of a parsed command line.

    Attributes:
        function: The function to call.
        positional: Name of its parameters ``*names``, if it has such.
        values: For each parameter, its name among the parsed arguments or the call that makes it.
    """

    function: Callable[..., object]
    positional: str | None = None
    values: dict[str, str | Call] = field(default_factory=dict)

    def __call__(self, args: argparse.Namespace) -> object:
        """Call the function."""
        made = {
            name: value(args) if isinstance(value, Call) else getattr(args, value)
            for name, value in self.values.items()
        }
        words = () if self.positional is None else made.pop(self.positional)
        assert isinstance(words, Sequence)
        return self.function(*words, **made)


def with_options(text: str, parser: argparse.ArgumentParser) -> str:
    """Return an error about parameters with the names of their options.

    ``bin_m: -1, expected more than 0`` becomes ``--bin-m -1: expected more than 0``, and
    ``real=True`` becomes ``--real``.
    """
    options = {
        action.dest.rpartition(".")[2]: action.option_strings[-1]
        for action in parser._actions
        if action.option_strings
    }
    lead = _LEAD.match(text)
    if lead is None or not options.keys() >= set(lead["names"].split(", ")):
        return text
    named = ", ".join(options[name] for name in lead["names"].split(", "))
    value = "" if lead["value"] is None else f" {lead['value']}"
    rest = re.sub(r"\b(\w+)=True\b", lambda m: options.get(m[1], m[0]), text[lead.end() :])
    return f"{named}{value}: {rest}"


def described(documented: object) -> Described:
    """Return the docstring of a function or record in parts."""
    parts = _SECTION.split(inspect.getdoc(documented) or "")
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    examples = sections.get("Examples", sections.get("Example", ""))
    described_names = sections.get("Args", "") or attributes_of(documented)
    items = re.findall(r"^    (\w+): (.+(?:\n {5,}.*)*)", described_names, re.MULTILINE)
    return Described(
        parts[0].strip().replace("``", "").replace("::\n", ":\n"),
        inspect.cleandoc(examples),
        {name: " ".join(text.split()) for name, text in items},
    )


def fill(parser: argparse.ArgumentParser, verb: Callable[..., Any]) -> Call:
    """Add a verb's parameters and its description to a parser.

    Returns:
        The call to make with the parsed arguments.
    """
    says = described(verb)
    body = says.text
    if says.examples:
        lines = "\n".join(f"  {line}" for line in says.examples.splitlines())
        body += f"\n\nexamples:\n{lines}"
    parser.description = body
    groups: Groups = {}
    call = add_parameters(parser, verb, groups)
    returned = _returned(verb)
    if returned in (dict, str, type(None)):
        parser.set_defaults(json=False)
    else:
        shown = groups.get("json") or parser.add_mutually_exclusive_group()
        formats = returned.formats if issubclass(returned, Result) else {}
        for name, what in formats.items():
            shown.add_argument(f"--{name}", action="store_true", help=what)
        shown.add_argument("--json", action="store_true", help="print the result as JSON")
    if hasattr(returned, "write_page"):
        text = "page to write: the result, its charts, what was dropped, the section to paste"
        parser.add_argument("--page", type=Path, metavar="FILE", dest="page_of_result", help=text)
        overwrite = parser._option_string_actions.get("--overwrite") or parser.add_argument(
            "--overwrite", action="store_true", help="replace an existing page"
        )
        parser.set_defaults(name_of_overwrite=overwrite.dest)
    return call


def add_parameters(
    parser: argparse.ArgumentParser,
    function: Callable[..., Any],
    groups: Groups | None = None,
    prefix: str = "",
) -> Call:
    """Add the parameters of a function to a parser.

    Args:
        parser: The parser.
        function: The function, or a record.
        groups: Groups of options that exclude each other, by name.
        prefix: Prefix of the names among the parsed arguments.
    """
    groups = {} if groups is None else groups
    function = getattr(function, "takes_record", function)
    says = described(function)
    call = Call(function)
    hints = _hints(function)
    for name, parameter in inspect.signature(function).parameters.items():
        annotation = hints[name]
        option, kind = _option_of(annotation)
        if option.is_hidden:
            continue
        maker = option.made_by or (kind if is_dataclass(kind) else None)
        if maker is not None:
            assert callable(maker)
            inner = add_parameters(parser, maker, groups, f"{prefix}{name}.")
            call.values[name] = inner
            continue
        made = _Argument(name, parameter, kind, option)
        if parameter.kind is parameter.VAR_POSITIONAL:
            call.positional = name
        container: Any = parser
        if option.group is not None:
            if option.group not in groups:
                groups[option.group] = parser.add_mutually_exclusive_group()
            container = groups[option.group]
        if (text := says.parameters.get(name)) is None:
            raise TypeError(f"{function.__name__}: no description of {name}")
        action = container.add_argument(
            *made.flags, **made.reading(), **made.naming(f"{prefix}{name}"), help=made.help(text)
        )
        call.values[name] = action.dest
    return call


@dataclass(frozen=True, slots=True)
class _Argument:
    name: str
    parameter: inspect.Parameter
    kind: Any
    option: Option

    @property
    def default(self) -> Any:
        return self.parameter.default

    @property
    def is_required(self) -> bool:
        return self.default is inspect.Parameter.empty

    @property
    def is_positional(self) -> bool:
        if self.parameter.kind is inspect.Parameter.VAR_POSITIONAL or self.option.is_positional:
            return True
        is_named = self.parameter.kind is inspect.Parameter.KEYWORD_ONLY or self.name == "output"
        return self.is_required and not is_named and self.option.name is None

    @property
    def flags(self) -> list[str]:
        if self.is_positional:
            return []
        plain = self.name.removeprefix("has_").replace("_", "-")
        name = self.option.name or ("--without-" if self.default is True else "--") + plain
        return ["-o", name] if name == "--output" else [name]

    def naming(self, dest: str) -> dict[str, Any]:
        """Return where the value is kept, and whether it is required."""
        if self.is_positional:
            return {"dest": dest}
        return {"dest": dest, "required": self.is_required}

    def reading(self) -> dict[str, Any]:
        """Return how words become the value: action, type, choices, number and default."""
        if self.kind is bool:
            return {"action": "store_false" if self.default is True else "store_true"}
        item, count = (str, None) if self.option.is_one_word else _items(self.kind)
        if self.parameter.kind is inspect.Parameter.VAR_POSITIONAL:
            count = "+"
        if self.is_positional and not self.is_required:
            count = "*" if count == "+" else "?"
        if self.option.may_be_empty:
            count = "*"
        found: dict[str, Any] = {} if count is None else {"nargs": count}
        if not self.is_required:
            found["default"] = self.default
        if typing.get_origin(item) is Literal:
            found["choices"] = typing.get_args(item)
        elif self.option.convert is not None:
            found["type"] = _converter(self.option.convert)
        elif item is not str:
            found["type"] = item
        if self.option.metavar is not None or "choices" not in found:
            found["metavar"] = self.option.metavar or self._metavar(item)
        return found

    def _metavar(self, item: Any) -> str:
        unit = self.name.rpartition("_")[2]
        return METAVARS.get(self.name) or UNITS.get(unit) or TYPES[item]

    def help(self, text: str) -> str:
        found = text.replace("``", "'").removesuffix(".")
        if found[:1].isupper() and not any(c.isupper() for c in found.split()[0][1:]):
            found = found[:1].lower() + found[1:]
        value = () if self.is_required else self.default
        is_plain = not isinstance(value, bool) and value not in (None, "", ())
        if is_plain and "(default" not in found:
            found += f" (default: {_shown(value)})"
        return found.replace("%", "%%")


def _option_of(annotation: Any) -> tuple[Option, Any]:
    """Return the option and the type of an annotation, without ``Annotated`` and None."""
    option = Option()
    while True:
        if typing.get_origin(annotation) is Annotated:
            inner, *rest = typing.get_args(annotation)
            option = next((one for one in rest if isinstance(one, Option)), option)
            annotation = inner
        elif typing.get_origin(annotation) in (typing.Union, types.UnionType):
            members = [one for one in typing.get_args(annotation) if one is not type(None)]
            marked = [one for one in members if typing.get_origin(one) is Annotated]
            words = [one for one in members if one in (Path, float, int, str) or _is_list(one)]
            annotation = (marked or words or members)[0]
        else:
            return option, annotation


def _items(kind: Any) -> tuple[Any, str | int | None]:
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and Ellipsis not in inner:
        return inner[0], len(inner)
    if _is_list(kind):
        return _option_of(inner[0])[1], "+"
    return kind, None


def _is_list(kind: Any) -> bool:
    origin = typing.get_origin(kind)
    return isinstance(origin, type) and issubclass(origin, Sequence)


@cache
def _converter(convert: Callable[[str], object]) -> Callable[[str], object]:
    """Return a converter whose ``UsageError`` is wrong usage for argparse."""

    def converted(text: str) -> object:
        try:
            return convert(text)
        except UsageError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    converted.__name__ = convert.__name__
    return converted


def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    if isinstance(function, type):
        return typing.get_type_hints(function, include_extras=True)
    plain = inspect.unwrap(function)
    notes = {name: kind for name, kind in plain.__annotations__.items() if name != "return"}
    holder: Any = types.SimpleNamespace(__annotations__=notes)
    names = vars(inspect.getmodule(plain))
    while True:
        try:
            return typing.get_type_hints(holder, names, include_extras=True)
        except NameError as error:
            # A type that is only known to type checkers, because its import takes long.
            name = str(error.name)
            names = {**names, name: type(name, (), {})}


def types_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the types of a verb's parameters and result, without options, for documentation.

    A type that is only known to type checkers stays a text.
    """
    raw = inspect.unwrap(function)
    names = vars(inspect.getmodule(raw))
    found: dict[str, Any] = {}
    for name, kind in raw.__annotations__.items():
        holder: Any = types.SimpleNamespace(__annotations__={name: kind})
        try:
            found |= typing.get_type_hints(holder, names)
        except NameError:
            found[name] = kind
        record = found[name]
        if hasattr(function, "takes_record") and is_dataclass(record) and name != "return":
            found |= typing.get_type_hints(record)
    return found


def _returned(verb: Callable[..., Any]) -> type:
    plain = inspect.unwrap(verb)
    notes = {"return": plain.__annotations__["return"]}
    module = inspect.getmodule(plain)
    found = typing.get_type_hints(types.SimpleNamespace(__annotations__=notes), vars(module))
    _, kind = _option_of(found["return"])
    return typing.get_origin(kind) or kind  # type: ignore[no-any-return]


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return " ".join(map(_shown, value)) if isinstance(value, list | tuple) else str(value)
