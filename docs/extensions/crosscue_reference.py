"""Reference pages made from the code itself: public names, commands, settings, tables.

``{crosscue-names}`` prints every public name in a line; ``{crosscue-functions}``,
``{crosscue-values}`` and ``{crosscue-errors}`` their signatures and docstrings, with the records
that functions take and return; ``{crosscue-commands}`` the help of every command;
``{crosscue-settings} MODULE:CLASS`` every field of a settings file with its type, default and
meaning; ``{crosscue-tables}`` every column of the tables in a run folder; and
``{crosscue-columns}`` every column that a query can use. Nothing of it is written by hand, so none
can be outdated.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import inspect
import io
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from docutils import nodes
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from sphinx.util.docutils import SphinxDirective

from crosscue.replay.meanings import meanings
from crosscue.results import Result

if TYPE_CHECKING:
    from sphinx.application import Sphinx

    from crosscue.eval.runs.tables.columns import Column


class Commands(SphinxDirective):
    """``{crosscue-commands}``: the help of every command, as the command prints it."""

    def run(self) -> list[nodes.Node]:
        """One section for each command."""
        from crosscue.eval.cli import COMMANDS, summary_of

        return [self._section(name, summary_of(name)) for name in COMMANDS]

    def _section(self, name: str, says: str) -> nodes.section:
        section = nodes.section(ids=[nodes.make_id(f"crosscue {name}")])
        section += nodes.title(text=f"crosscue {name}")
        section += nodes.paragraph(text=says[:1].upper() + says[1:] + ".")
        section += nodes.literal_block(text=_help(name), language="text")
        return section


@functools.cache
def _help(command: str) -> str:
    from crosscue.eval import cli

    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        status = cli.run([*command.split(), "--help"])
    if status:
        raise RuntimeError(f"crosscue {command} --help exits with {status}")
    return out.getvalue()


class Names(SphinxDirective):
    """``{crosscue-names}``: every public name with the first line of its docstring."""

    def run(self) -> list[nodes.Node]:
        """Functions, then records, then errors and warnings."""
        import crosscue

        found = {name: getattr(crosscue, name) for name in sorted(crosscue.__all__)}
        errors = {
            name
            for name, one in found.items()
            if isinstance(one, type) and issubclass(one, BaseException)
        }
        records = {name for name, one in found.items() if isinstance(one, type)} - errors
        blocks: list[nodes.Node] = []
        modules = {name for name, one in found.items() if inspect.ismodule(one)}
        for title, names in (
            ("functions", found.keys() - records - errors - modules),
            ("records", records),
            ("errors", errors),
        ):
            rows = [(f"crosscue.{name}", first_line(found[name])) for name in sorted(names)]
            blocks.append(_table((title, ""), rows))
        return blocks


def _function_lines() -> Iterator[str]:
    """Directives for every public function, with the records that it takes and returns."""
    import crosscue

    known = {getattr(crosscue, name) for name in crosscue.__all__}
    for name in sorted(crosscue.__all__):
        found = getattr(crosscue, name)
        if not inspect.isfunction(found):
            continue
        yield f".. autofunction:: crosscue.{name}"
        for record in _records(found.__annotations__.values()):
            if record not in known:
                known.add(record)
                yield from _class_lines(f"{record.__module__}.{record.__name__}", record)


def _value_lines() -> Iterator[str]:
    """Directives for every public class that is no error, and what reading a log returns."""
    import crosscue

    for name in sorted(crosscue.__all__):
        found = getattr(crosscue, name)
        if isinstance(found, type) and not issubclass(found, BaseException):
            yield from _class_lines(f"crosscue.{name}", found)
    module = import_module(crosscue.Log.__module__)
    for name in ("Topics", "LogTopic", "CameraFrame", "Signals"):
        yield from _class_lines(f"{module.__name__}.{name}", getattr(module, name))


def _error_lines() -> Iterator[str]:
    """Directives for every error, in the order in which they are defined."""
    from crosscue.replay import errors

    for name, found in vars(errors).items():
        if isinstance(found, type) and issubclass(found, Exception):
            yield f".. autoexception:: crosscue.errors.{name}"


def _class_lines(place: str, found: type) -> Iterator[str]:
    """A class, its properties, and its methods but those for the printer."""
    yield f".. autoclass:: {place}()"
    members = [
        name
        for name, member in vars(found).items()
        if not name.startswith("_")
        and (inspect.isroutine(member) or isinstance(member, property | functools.cached_property))
        and name not in ("lines", "messages", "cells", "as_dict", "exit_status", "reported")
    ]
    if members:
        yield f"   :members: {', '.join(members)}"
    if "__call__" in vars(found):
        yield "   :special-members: __call__"


def _records(annotations: Iterable[object]) -> Iterator[type]:
    """The records of ours in some annotations."""
    for one in annotations:
        yield from _records(typing.get_args(one))
        is_ours = isinstance(one, type) and one.__module__.startswith("crosscue.")
        if is_ours and (dataclasses.is_dataclass(one) or issubclass(one, Result)):
            yield one


GENERATED: Final = {
    "crosscue-functions": _function_lines,
    "crosscue-values": _value_lines,
    "crosscue-errors": _error_lines,
}


def _write_reference(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace the directives of the generated reference by those of autodoc."""
    for name, lines in GENERATED.items():
        mark = f"```{{{name}}}\n```"
        if mark in source[0]:
            block = "\n".join(["```{eval-rst}", *lines(), "```"])
            source[0] = source[0].replace(mark, block)


def first_line(documented: object) -> str:
    """Summary line of a public name, without markup."""
    text = (inspect.getdoc(documented) or "").partition("\n\n")[0]
    return " ".join(text.replace("``", "").split())


class SettingsFile(SphinxDirective):
    """``{crosscue-settings} MODULE:CLASS``: every field, section by section."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """A table for each section of the file."""
        module, _, name = self.arguments[0].partition(":")
        model: type[BaseModel] = getattr(import_module(module), name)
        found: list[nodes.Node] = []
        for path, section in _sections("", model):
            title = f"[{path}]" if path else "top of the file"
            block = nodes.section(ids=[nodes.make_id(f"{name} {title}")])
            block += nodes.title(text=title)
            block += nodes.paragraph(text=_summary(section))
            block += _table(("field", "type", "default", "meaning"), list(_fields(section)))
            found.append(block)
        return found


def _summary(model: type[BaseModel]) -> str:
    """The first paragraph of its docstring."""
    return " ".join((model.__doc__ or "").split("\n\n")[0].split())


def _sections(path: str, model: type[BaseModel]) -> Iterator[tuple[str, type[BaseModel]]]:
    yield path, model
    for name, field in model.model_fields.items():
        for inner in _models_in(field.annotation):
            yield from _sections(f"{path}.{name}" if path else name, inner)


def _models_in(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in typing.get_args(annotation) for model in _models_in(inner)]


def _fields(model: type[BaseModel]) -> Iterator[tuple[str, str, str, str]]:
    for name, field in model.model_fields.items():
        if field.is_required():
            default = "required"
        else:
            value = field.get_default(call_default_factory=True)
            default = "a section" if isinstance(value, BaseModel) else repr(value)
            default = default if len(default) <= 60 else default[:57] + "..."
        yield (
            name,
            _type_name(field.annotation),
            default,
            _meaning(field, meanings(model).get(name, "")),
        )


def _meaning(field: FieldInfo, text: str) -> str:
    """What the field is; of a section, its summary."""
    described = " ".join(text.split())
    inner = _models_in(field.annotation)
    return described or (_summary(inner[0]) if inner else "")


def _type_name(annotation: Any) -> str:
    if annotation is type(None):
        return "nothing"
    if isinstance(annotation, type) and not typing.get_args(annotation):
        return annotation.__name__
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _type_name(inner[0])
    if origin is typing.Literal:
        return ", ".join(repr(one) for one in inner)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type_name(one) for one in inner)
    if inner:
        names = ", ".join("..." if one is Ellipsis else _type_name(one) for one in inner)
        return f"{getattr(origin, '__name__', origin)} of {names}"
    return str(annotation)


class Tables(SphinxDirective):
    """``{crosscue-tables}``: the columns of every table in a run folder."""

    def run(self) -> list[nodes.Node]:
        """One section for each table."""
        from crosscue.eval.runs.tables.columns import OF_RUN, OF_SCORE

        scores = {f"score/{name}": columns for name, columns in OF_SCORE.items()}
        found: list[nodes.Node] = []
        for name, columns in {**OF_RUN, **scores}.items():
            block = nodes.section(ids=[nodes.make_id(f"table {name}")])
            block += nodes.title(text=f"{name}.parquet")
            block += _columns(columns)
            found.append(block)
        return found


class Columns(SphinxDirective):
    """``{crosscue-columns}``: the columns of the tables that ``crosscue query`` reads."""

    def run(self) -> list[nodes.Node]:
        """One section for each table."""
        from crosscue.eval.runs.tables.columns import INDEXED, QUERIED

        found: list[nodes.Node] = []
        for name, columns in {**INDEXED, **QUERIED}.items():
            block = nodes.section(ids=[nodes.make_id(f"columns {name}")])
            block += nodes.title(text=name)
            block += _columns(columns)
            found.append(block)
        return found


def _columns(columns: Mapping[str, Column]) -> nodes.table:
    rows: list[tuple[str, ...]] = [(name, *column) for name, column in columns.items()]
    return _table(("column", "type", "meaning"), rows)


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> nodes.table:
    group = nodes.tgroup(cols=len(head))
    group += [nodes.colspec(colwidth=1) for _ in head]
    group += nodes.thead("", _row(head, is_head=True))
    group += nodes.tbody("", *(_row(row) for row in rows))
    return nodes.table("", group)


def _row(cells: tuple[str, ...], *, is_head: bool = False) -> nodes.row:
    entries = []
    for place, cell in enumerate(cells):
        text: nodes.Node = nodes.Text(cell) if place or is_head else nodes.literal(text=cell)
        entries.append(nodes.entry("", nodes.paragraph("", "", text)))
    return nodes.row("", *entries)


def _keep_examples(
    app: Sphinx, kind: str, name: str, found: object, options: object, lines: list[str]
) -> None:
    """Show the examples of a verb as they are, one command a line."""
    if "Examples:" in lines:
        place = lines.index("Examples:")
        lines[place : place + 1] = ["Examples::", ""]


def _show_plain_types(app: Sphinx) -> None:
    """Show the types of public names without how the command line reads them."""
    import crosscue
    from crosscue.eval.cli import COMMANDS
    from crosscue.eval.command_line import types_of

    # Before the types are replaced: the help of commands needs the options in them.
    for command in COMMANDS:
        _help(command)
    records: set[type] = set()
    for found in map(crosscue.__getattr__, crosscue.__all__):
        if isinstance(found, types.FunctionType):
            found.__annotations__ = types_of(found)
            records |= {*_records(found.__annotations__.values())}
        elif dataclasses.is_dataclass(found) and isinstance(found, type):
            records.add(found)
    for kind in {kind for one in records for kind in one.__mro__ if dataclasses.is_dataclass(kind)}:
        # A class with types that only type checkers know has no options either.
        with contextlib.suppress(NameError):
            plain = typing.get_type_hints(kind)
            kind.__annotations__ = {name: plain[name] for name in kind.__annotations__}
            kind.__init__.__annotations__ = plain


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directives."""
    app.add_directive("crosscue-columns", Columns)
    app.connect("autodoc-process-docstring", _keep_examples, priority=400)
    app.connect("builder-inited", _show_plain_types)
    app.connect("source-read", _write_reference)
    app.add_directive("crosscue-commands", Commands)
    app.add_directive("crosscue-names", Names)
    app.add_directive("crosscue-settings", SettingsFile)
    app.add_directive("crosscue-tables", Tables)
    return {"parallel_read_safe": True}
