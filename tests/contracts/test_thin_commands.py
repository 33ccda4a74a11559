"""Every command that is written by hand calls public functions only, as Python can."""

from __future__ import annotations

import ast
import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import Final

import pytest

import crosscue
from crosscue.eval import cli

ROOT: Final = Path(__file__).parents[2]
# Public functions that each command calls.
CALLS: Final[dict[str, tuple[str, ...]]] = {}
# Modules that a command may import: the public interface, options and safe text. Constants of other
# modules are allowed as well, for the help.
ALLOWED: Final = re.compile(r"crosscue(\.eval\.commands(\..+)?|\.replay\.(base|safe_text))?")


def tree_of(command: str) -> ast.Module:
    """Return the syntax tree of a command's module."""
    where = cli.COMMANDS[command]
    assert isinstance(where, tuple)
    module = import_module(f"crosscue.eval.commands.{where[0]}")
    return ast.parse(inspect.getsource(module))


def test_every_command_has_public_functions_or_reason() -> None:
    by_hand = {name for name, where in cli.COMMANDS.items() if isinstance(where, tuple)}
    assert CALLS.keys() == by_hand


@pytest.mark.parametrize("command", CALLS)
def test_command_calls_listed_public_functions_only(command: str) -> None:
    called = {
        node.func.attr
        for node in ast.walk(tree_of(command))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and isinstance(node.func.value, ast.Name)
        and node.func.value.id == "crosscue"
    }

    assert {*CALLS[command]} <= called
    assert called <= {*crosscue.__all__}


@pytest.mark.parametrize("command", CALLS)
def test_command_imports_public_interface_only(command: str) -> None:
    imported: dict[str, list[str]] = {}
    for node in ast.walk(tree_of(command)):
        if isinstance(node, ast.ImportFrom):
            imported[node.module or ""] = [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            imported |= {alias.name: [alias.name] for alias in node.names}

    logic = [
        module
        for module, names in imported.items()
        if module.partition(".")[0] == "crosscue"
        and not ALLOWED.fullmatch(module)
        and not all(name.isupper() for name in names)
    ]
    assert logic == []


@pytest.mark.parametrize("name", sorted({name for names in CALLS.values() for name in names}))
def test_public_function_is_documented_with_its_arguments(name: str) -> None:
    function = getattr(crosscue, name)
    page = (ROOT / "docs" / "reference" / "interface.md").read_text(encoding="utf-8")

    assert callable(function)
    assert f".. autofunction:: crosscue.{name}\n" in page
    described = inspect.getdoc(function) or ""
    for argument in inspect.signature(function).parameters:
        assert f"{argument}:" in described or "; as ``" in described, argument
    assert inspect.signature(function).return_annotation is not inspect.Signature.empty
