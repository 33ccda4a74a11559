"""Code on the pages of the documentation: blocks, inline code, and the commands they run."""

import json
import re
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from markdown_it import MarkdownIt

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
