"""Check Python examples against the public interface without running them.

Names, arguments and attributes of results are looked up by type. The type of a call is the return
annotation of the function. Expressions of unknown type are not checked.
"""

import ast
import inspect
import types
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Final

import crosscue
import crosscue.testing

PUBLIC: Final = {"crosscue": crosscue, "crosscue.testing": crosscue.testing}


@dataclass(frozen=True)
class Instance:
    """An object with a known type and an unknown value."""

    type: Any


@dataclass
class Check:
    """Faults of one piece of code.

    Attributes:
        known: Module, function, class or ``Instance`` of each known name.
        faults: Line and message of every fault.
    """

    known: dict[str, Any] = field(default_factory=lambda: {"crosscue": crosscue})
    faults: list[tuple[int, str]] = field(default_factory=list)

    def fault(self, node: ast.expr | ast.stmt, message: str) -> None:
        """Add a fault unless it is recorded already."""
        if (node.lineno, message) not in self.faults:
            self.faults.append((node.lineno, message))

    def visit(self, node: ast.AST) -> None:
        """Check a node and its descendants, in order."""
        if isinstance(node, ast.Import):
            for alias in node.names:
                self._import(node, alias.name)
                if alias.name in PUBLIC:
                    self.known[alias.asname or "crosscue"] = crosscue
            return
        if isinstance(node, ast.ImportFrom):
            # A record or a helper that is documented in its module.
            if (node.module or "").startswith("crosscue.") and node.module not in PUBLIC:
                home = import_module(node.module or "")
                self.known |= {one.name: getattr(home, one.name) for one in node.names}
                return
            self._import(node, node.module or "")
            module = PUBLIC.get(node.module or "")
            for alias in node.names if module else ():
                self.known[alias.asname or alias.name] = self._of_module(node, module, alias.name)
            return
        if isinstance(node, ast.For | ast.comprehension):
            self._name(node.target, _element(self.type_of(node.iter)))
        if isinstance(node, ast.GeneratorExp | ast.ListComp | ast.SetComp | ast.DictComp):
            for one in node.generators:
                self.visit(one)
        if isinstance(node, ast.expr):
            self.type_of(node)
        for child in ast.iter_child_nodes(node):
            self.visit(child)
        if isinstance(node, ast.Assign):
            for target in node.targets:
                self._name(target, self.type_of(node.value))

    def type_of(self, node: ast.expr) -> Any:
        """Module, function, class or ``Instance`` of an expression; None if unknown."""
        if isinstance(node, ast.Name):
            return self.known.get(node.id)
        if isinstance(node, ast.Attribute):
            return self._attribute(node, self.type_of(node.value))
        if isinstance(node, ast.Subscript):
            found = self.type_of(node.value)
            method = getattr(_class_of(found), "__getitem__", None)
            return _returned(method) if _is_ours(_class_of(found)) else _element(found)
        if isinstance(node, ast.Call):
            return self._call(node, self.type_of(node.func))
        return None

    def _import(self, node: ast.stmt, module: str) -> None:
        if module.partition(".")[0] == "crosscue" and module not in PUBLIC:
            self.fault(node, f"{module} is not public")

    def _of_module(self, node: ast.expr | ast.stmt, module: Any, name: str) -> Any:
        if module is crosscue and name == "testing":
            return crosscue.testing
        if name not in module.__all__:
            self.fault(node, f"{module.__name__} has no public name {name}")
            return None
        return getattr(module, name)

    def _attribute(self, node: ast.Attribute, owner: Any) -> Any:
        if owner in PUBLIC.values():
            return self._of_module(node, owner, node.attr)
        cls = owner if inspect.isclass(owner) else _class_of(owner)
        if not _is_ours(cls):
            return None
        hints = _hints(cls)
        found = inspect.getattr_static(cls, node.attr, None)
        if found is None and not any(
            node.attr in vars(one).get("__annotations__", ()) for one in cls.__mro__
        ):
            self.fault(node, f"{cls.__name__} has no attribute {node.attr}")
            return None
        if isinstance(found, property):
            return _returned(found.fget)
        if callable(found) or isinstance(found, classmethod | staticmethod):
            return getattr(cls, node.attr) if inspect.isclass(owner) else _Bound(found)
        return _instance(hints.get(node.attr))

    def _call(self, node: ast.Call, function: Any) -> Any:
        if function is None or isinstance(function, Instance):
            return None
        called = function.function if isinstance(function, _Bound) else function
        is_open = any(isinstance(one, ast.Starred) for one in node.args)
        is_open |= any(one.arg is None for one in node.keywords)
        if not is_open and _is_ours(called):
            first = [None] if isinstance(function, _Bound) else []
            named = {one.arg: None for one in node.keywords if one.arg}
            try:
                inspect.signature(called).bind(*first, *(None for _ in node.args), **named)
            except TypeError as error:
                self.fault(node, f"{called.__qualname__}: {error}")
        return Instance(called) if inspect.isclass(called) else _returned(called)

    def _name(self, target: ast.expr, found: Any) -> None:
        if isinstance(target, ast.Name):
            self.known[target.id] = found


@dataclass(frozen=True)
class _Bound:
    """A method of an instance."""

    function: Callable[..., Any]


def faults_in(code: str) -> list[tuple[int, str]]:
    """Line and message of each name, attribute and argument that the public interface lacks."""
    check = Check()
    check.visit(ast.parse(code))
    return check.faults


def _is_ours(found: Any) -> bool:
    return str(getattr(found, "__module__", "")).partition(".")[0] == "crosscue"


def _class_of(found: Any) -> Any:
    """Class of an instance; None if its type is not a single class."""
    if not isinstance(found, Instance):
        return None
    origin = typing.get_origin(found.type) or found.type
    return origin if inspect.isclass(origin) else None


def _instance(hint: Any) -> Instance | None:
    """Instance of an annotated type; None is removed from optional types."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        some = [one for one in typing.get_args(hint) if one is not type(None)]
        hint = some[0] if len(some) == 1 else None
    return None if hint is None else Instance(hint)


def _returned(function: Any) -> Instance | None:
    """Instance of a function's return type."""
    if not _is_ours(function):
        return None
    return _instance(_hints(function).get("return"))


def _hints(annotated: Any) -> dict[str, Any]:
    """Annotated types by name, or none if one of them is imported for type checking only."""
    try:
        return typing.get_type_hints(annotated)
    except NameError:
        return {}


def _element(found: Any) -> Instance | None:
    """Instance of the element type of an iterable."""
    cls = _class_of(found)
    if cls is None:
        return None
    if _is_ours(cls):
        return _element(_returned(getattr(cls, "__iter__", None)))
    arguments = typing.get_args(found.type)
    return _instance(arguments[0]) if len(arguments) == 1 or arguments[1:] == (...,) else None
