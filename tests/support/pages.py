"""Code on the pages of the documentation, and its check without running it."""

import ast
import inspect
import json
import re
import subprocess
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from markdown_it import MarkdownIt

import crosscue
import crosscue.testing

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs").glob("*/*.md")),
    *sorted((ROOT / "detectors").rglob("*.md")),
    *sorted((ROOT / "datasets").rglob("*.md")),
]
NOTEBOOKS: Final = sorted((ROOT / "notebooks").glob("*.ipynb"))
PROGRAMS: Final = ("crosscue", "make", "pip", "pytest", "python", "sphinx-build")
# Functions in place of programs, which record their arguments and print a number.
PRELUDE: Final = f"""
record() {{ printf '%s\\0' "$@" $'\\x1e' >&9; }}
for program in {" ".join(PROGRAMS)}; do
  eval "$program() {{ record $program \\"\\$@\\"; echo 1; }}"
done
command_not_found_handle() {{ :; }}
"""


@dataclass(frozen=True)
class Code:
    """A block of a page, or inline code.

    Attributes:
        page: Path of the page, relative to the repository.
        line: First line of the code on the page, from 1; number of the cell in a notebook.
        kind: Language of a block, empty without one.
        text: The code.
    """

    page: str
    line: int
    kind: str
    text: str

    @property
    def place(self) -> str:
        """Page and line."""
        return f"{self.page}:{self.line}"


def _parsed(page: str, text: str, first: int = 1) -> Iterator[Code]:
    """Yield the blocks and inline code of a text in Markdown."""
    for token in MarkdownIt("commonmark").enable("table").parse(text):
        line = first + (token.map[0] if token.map else 0)
        if token.type == "fence":
            yield Code(page, line + 1, token.info.partition(" ")[0], token.content)
        elif token.type == "code_block":
            yield Code(page, line, "indented", token.content)
        for child in token.children or ():
            if child.type == "code_inline":
                yield Code(page, line, "inline", child.content)


def code_of_pages() -> list[Code]:
    """All code of all pages, in order."""
    return [
        code
        for path in PAGES
        for code in _parsed(str(path.relative_to(ROOT)), path.read_text(encoding="utf-8"))
    ]


def code_of_notebooks() -> list[Code]:
    """Inline code of the notebooks' text, and the Python of each notebook as one block."""
    found: list[Code] = []
    for path in NOTEBOOKS:
        page = str(path.relative_to(ROOT))
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        python = ""
        for number, cell in enumerate(cells, 1):
            source = "".join(cell["source"])
            if cell["cell_type"] == "code":
                python += source + "\n"
            else:
                found += [code for code in _parsed(page, source, number) if code.kind == "inline"]
        found.append(Code(page, 1, "python", python))
    return found


def _shell_of(code: Code) -> str:
    """Shell code of a block: the lines after a prompt, or the ``run`` steps of a workflow."""
    if code.kind == "console":
        return "\n".join(re.findall(r"^\$ ((?:.*\\\n)*.*)", code.text, re.MULTILINE))
    if code.kind == "yaml":
        return "\n".join(re.findall(r"^- run: (.*)", code.text, re.MULTILINE))
    return code.text


def commands_of(page: Sequence[Code], folder: Path) -> list[tuple[Code, list[str]]]:
    """Return program and arguments of every command that a shell runs for the blocks of one page.

    bash expands variables, loops and functions. Functions that record their arguments replace
    programs, no other program is available, and nothing is written.
    """
    blocks = [code for code in page if code.kind in ("bash", "console", "yaml")]
    script = "\n".join(f"record block {i}\n{_shell_of(code)}" for i, code in enumerate(blocks))
    script = re.sub(r"\S*\.venv/bin/", "", script)
    script = re.sub(r">+\s*[^\s&|;)]+", ">/dev/null", script)
    environment = {"PATH": "", "HOME": str(folder), "CROSSCUE_DATA": "data", "PR": "1"}
    notes = folder / "notes"
    done = subprocess.run(
        ["/bin/bash", "-c", f"exec 9>{notes}\n{PRELUDE}\n{script}"],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=20,
    )
    assert "syntax error" not in done.stderr, f"{blocks[0].page}: {done.stderr}"
    found: list[tuple[Code, list[str]]] = []
    block = None
    for noted in notes.read_text(encoding="utf-8").split("\0\x1e\0")[:-1]:
        program, *arguments = noted.split("\0")
        if program == "block":
            block = blocks[int(arguments[0])]
        elif block is not None:
            found.append((block, [program, *arguments]))
    return found


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
