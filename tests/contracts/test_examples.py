"""Every example in the documentation is valid, or a test runs it."""

import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from textwrap import dedent
from types import SimpleNamespace
from typing import Any, Final

import pytest

import crosscue
from crosscue.detectors.base import DetectorChoice
from crosscue.detectors.registry import BUILTIN, make
from crosscue.eval import cli
from crosscue.eval.scoring.gates import load_gates
from crosscue.replay.errors import UsageError
from crosscue.replay.formats import FORMATS, Format
from crosscue.replay.plugins import GROUPS
from crosscue.replay.vehicle.cue_spec import CueSpec
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from crosscue.testing import check_cue, check_detector, check_reader
from support import one_row
from support.catalog_runs import runs_below
from support.commands import output_of
from support.every_format import _bytes
from support.pages import NOTEBOOKS as NOTEBOOK_FILES
from support.pages import (
    PAGES,
    ROOT,
    Code,
    code_of_notebooks,
    code_of_pages,
    commands_of,
    faults_in,
)
from support.refusals import refusal

CODE: Final = code_of_pages()
NOTEBOOKS: Final = code_of_notebooks()
# Pages and languages of blocks that a test runs, and that test.
EXECUTED: Final = {
    ("CONTRIBUTING.md", "python"): "tests/contracts/test_examples.py",
    ("docs/howto/query.md", "sql"): "tests/eval/catalog/test_remote_catalog.py",
}
# Options of other programs that occur in inline code and messages, and those programs.
OTHERS: Final = {
    "--check": "seal had it; the answer names what replaces it",
    "--array": "SLURM",
    "--bind": "Rerun",
    "--end2end": "YOLOv7",
    "--max-wh": "YOLOv7",
    "--ort": "DAMO-YOLO",
    "--min-s": "the example of a command in CONTRIBUTING.md",
    "--decode_in_inference": "YOLOX",
    "--grid": "YOLOv7",
    "--include": "YOLOv5",
    "--serve-web": "Rerun",
    "--torch-backend": "uv",
}
PACKAGES: Final = ("replay", "detectors", "fusion", "localization", "datasets", "eval")
SHELL_PAGES: Final = sorted(
    {code.page for code in CODE if code.kind in ("bash", "console", "yaml")}
)
# Options of all commands and benchmarks.
OPTIONS: Final = {
    "--version",
    *(
        option
        for name in cli.COMMANDS
        for action in cli.parser_of(name)[1]._actions
        for option in action.option_strings
    ),
    *(
        option
        for path in (ROOT / "benchmarks").rglob("*.py")
        for option in re.findall(r'"(--[a-z][\w-]*)"', path.read_text(encoding="utf-8"))
    ),
}


def of_kind(kind: str) -> list[Code]:
    """Blocks of one language that no test runs."""
    return [code for code in CODE if code.kind == kind and (code.page, kind) not in EXECUTED]


@cache
def commands_on(page: str) -> list[tuple[Code, list[str]]]:
    """Program and arguments of every command that the blocks of a page run."""
    with TemporaryDirectory() as folder:
        return commands_of([code for code in CODE if code.page == page], Path(folder))


def words_of(text: str) -> list[str]:
    """Words of inline code, without quotes."""
    return re.findall(r"\"[^\"]*\"|'[^']*'|\S+", text)


def commands_in(words: list[str]) -> list[str]:
    """Return the commands that inline code names: one, several (``fit a|b``), or a group."""
    for length in (2, 1):
        first = words[: length - 1]
        names = [
            " ".join([*first, last]) for last in "".join(words[length - 1 : length]).split("|")
        ]
        if words[length - 1 :] and all(name in cli.COMMANDS for name in names):
            return names
    return [name for name in cli.COMMANDS if words and name.split()[0] == words[0]]


def name_of(command: list[str]) -> str:
    """Return the longest command name with which a command line begins, or an empty text."""
    names = (name for name in cli.COMMANDS if command[: len(name.split())] == name.split())
    return max(names, key=len, default="")


def fault_of(command: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Return the error of a complete command line, or an empty text if its parser accepts it."""
    name = name_of(command)
    if not name:
        return f"no command {command[:2]}"
    try:
        given = vars(cli.parser_of(name)[1].parse_args(command[len(name.split()) :]))
    except SystemExit:
        return capsys.readouterr().err
    known = {*BUILTIN, "none", *(model.name for model in crosscue.models())}
    unknown = {
        detector
        for option, value in given.items()
        if option.rpartition(".")[2] == "detectors"
        for detector in str(value or "none").split(",")
        if detector not in known and not detector.endswith(".toml")
    }
    return f"no detector {unknown}" if unknown else ""


def vehicle_of(text: str) -> Vehicle:
    return parse(text if "version =" in text else f"version = 1\n{text}", "example")


@pytest.mark.parametrize("page", SHELL_PAGES)
def test_commands_on_page_are_accepted_by_parser(
    page: str, capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = [code for code in CODE if code.page == page]
    found = commands_on(page)

    faults = [
        f"{code.place}: {' '.join(command)}: {fault}"
        for code, (program, *command) in found
        if program == "crosscue" and (fault := fault_of(command, capsys))
    ]
    assert faults == []
    for block in blocks:
        if re.search(r"^(\$ )?crosscue ", block.text, re.MULTILINE) and block.kind != "inline":
            assert any(code == block for code, _ in found), f"{block.place}: no command was run"


def test_other_programs_on_a_page_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for page in SHELL_PAGES:
        for code, (program, *words) in commands_on(page):
            if program == "make":
                assert words[0] in targets, code.place
            elif program == "pip":
                named = re.findall(r"\[(.*)\]", " ".join(words))
                assert {one for text in named for one in text.split(",")} <= {*extras}, code.place
            elif program == "python" and words[0] == "-c":
                assert faults_in(words[1]) == [], code.place
            elif program == "python":
                is_module = words[0] == "-m"
                path = words[1].replace(".", "/") + ".py" if is_module else words[0]
                is_ours = not is_module or words[1].startswith("crosscue.")
                assert not is_ours or (ROOT / path).is_file(), f"{code.place}: no file {path}"


def inline_commands() -> Iterator[tuple[str, list[str]]]:
    """Yield place and words of each ``crosscue`` command in inline code and docstrings."""
    for code in [*CODE, *NOTEBOOKS]:
        if code.kind == "inline" and code.text.startswith("crosscue "):
            yield code.place, words_of(code.text)[1:]
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            text = path.read_text(encoding="utf-8")
            for found in re.finditer(r"``crosscue ([^`]+)``", text):
                line = text.count("\n", 0, found.start()) + 1
                yield f"{path.relative_to(ROOT)}:{line}", words_of(found[1])


def test_inline_commands_and_their_options_exist() -> None:
    wrong = []
    for place, words in inline_commands():
        names = commands_in(words)
        actions = [action for name in names for action in cli.parser_of(name)[1]._actions]
        known = {option for action in actions for option in action.option_strings} | {
            "--help",
            "--version",
        }
        unknown = {word.partition("=")[0] for word in words if re.match("--?[a-z]", word)} - known
        if unknown or not (names or words[0] in ("--help", "--version")):
            wrong.append(f"{place}: crosscue {' '.join(words)}: {sorted(unknown) or 'no command'}")

    assert wrong == []


def test_options_in_inline_code_exist() -> None:
    texts = [code for code in [*CODE, *NOTEBOOKS] if code.kind == "inline"]
    named = {
        option: code.place
        for code in texts
        for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", code.text)
    }

    unknown = named.keys() - OPTIONS - OTHERS.keys()
    assert {option: named[option] for option in unknown} == {}


def test_options_in_messages_exist() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{number}: {option}"
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        for option in re.findall(r"(?<![\w(-])--[a-z](?:-?\w)*(?![\w:-])", line)
        if option not in OPTIONS | OTHERS.keys()
    ]

    assert wrong == []


@pytest.mark.parametrize(
    "code",
    [*of_kind("python"), *(c for c in NOTEBOOKS if c.kind == "python")],
    ids=lambda c: c.place,
)
def test_python_examples_use_existing_public_names(code: Code) -> None:
    assert [
        f"{code.page}:{code.line + line - 1}: {fault}" for line, fault in faults_in(code.text)
    ] == []


@pytest.mark.parametrize("code", of_kind("toml"), ids=lambda code: code.place)
def test_settings_are_accepted(code: Code, tmp_path: Path) -> None:
    tree = tomllib.loads(code.text)
    if "gate" in tree:
        path = tmp_path / "gates.toml"
        path.write_text(code.text)
        assert load_gates(path), code.place
    elif "project" in tree:
        assert {*tree["project"]["entry-points"]} == {*GROUPS.values()}
    else:
        vehicle_of(code.text)


def test_documented_default_settings_equal_defaults() -> None:
    texts = {code.page: code.text for code in of_kind("toml")}

    assert vehicle_of(texts["docs/explanation/time_segments.md"]) == Vehicle(version=1)


def test_queries_in_examples_run(tmp_path: Path) -> None:
    runs = crosscue.catalog(runs_below(tmp_path / "runs"))
    queries = 0
    for page in SHELL_PAGES:
        for _, (program, *words) in commands_on(page):
            if program == "crosscue" and words[0] == "query":
                runs.query(words[2])
                queries += 1
            conditions = [
                words[words.index(option) + 1]
                for option in ("--runs", "--against", "--where")
                if words[0] in ("compare", "failures") and option in words
            ]
            for condition in conditions:
                runs.select(condition)
                queries += 1
    assert queries


def test_invalid_example_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    code = (
        "import crosscue\n"
        "log = crosscue.open('a', nope=1)\n"
        "log['x'].tabel()\n"
        "[one.rum for one in crosscue.read_failures('x')]\n"
        "crosscue.nothing()\n"
    )
    assert [line for line, _ in faults_in(code)] == [2, 3, 4, 5]
    assert "no option --gnsss" in fault_of(["replay", "a", "-o", "b", "--gnsss", "off"], capsys)
    assert "invalid" in fault_of(["view", "run", "--approach", "last"], capsys)
    assert "yolox-pico" in fault_of(["replay", "a", "-o", "b", "--detectors", "yolox-pico"], capsys)


def test_every_figure_is_on_a_page_and_every_picture_of_a_page_exists() -> None:
    figures = {path.name for path in (ROOT / "docs" / "figures").iterdir()}
    shown = set()
    for page in [*PAGES, *NOTEBOOK_FILES]:
        for link in re.findall(r"!\[[^\]]*\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            path = page.parent / link
            assert "://" in link or path.is_file(), f"{page.relative_to(ROOT)}: no file {link}"
            shown |= {path.name} if path.parent.name == "figures" else set()
    assert figures == shown


PAGE = (Path(__file__).parents[2] / "CONTRIBUTING.md").read_text(encoding="utf-8")


def _code(title: str) -> list[str]:
    """Return the Python code blocks of one example."""
    (part,) = re.findall(rf"^## Example: {title}\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE)
    return re.findall(r"```python\n(.*?)```", part, re.DOTALL)


def _row(code: str, **names: object) -> Any:
    """Evaluate a row of a table without its trailing comma."""
    code = dedent(code).strip().removesuffix(",")
    return eval("{" + code + "}" if code.startswith('"') else code, names)


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], str]:
    """Return a function that writes an importable module and returns its name."""

    def write(name: str, code: str) -> str:
        (tmp_path / f"{name}.py").write_text(code)
        monkeypatch.syspath_prepend(tmp_path)
        return name

    return write


def test_cue_example_fulfils_contract(module: Callable[[str, str], str]) -> None:
    rule, row = _code("a cue")
    cue: CueSpec = _row(
        row.replace("crosscue.detectors.cues.pedestrians", module("example_cue", rule)),
        CueSpec=CueSpec,
    )

    assert cue.name == "pedestrians"
    check_cue(cue)


def test_reader_example_fulfils_contract(
    module: Callable[[str, str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, row, small_log, damage = _code("a reader")
    place = module("example_reader", reader)
    row = row.replace("crosscue.replay.readers.speed.reader", place)
    monkeypatch.setitem(FORMATS, "speed", _row(row, Format=Format)["speed"])
    every = _row(small_log, _bytes=_bytes)
    write, damage_one = _row(damage, EVERY_FORMAT=every, _garbled_line=one_row._garbled_line)[
        "speed"
    ]

    check_reader(write(tmp_path), damage_one)


def test_detector_example_fulfils_contract(module: Callable[[str, str], str]) -> None:
    (code,) = _code("a detector")
    place = f"{module('example_detector', code)}:Lamp.build"

    check_detector(lambda: make(DetectorChoice("lamp", "lamp"), {**BUILTIN, "lamp": place}))


def test_command_example_has_the_described_options(
    module: Callable[[str, str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (code,) = _code("a command")
    verb = vars(import_module(module("example_command", code)))["longest_gap"]
    monkeypatch.setitem(cli.COMMANDS, "longest-gap", "eval.logs.longest_gap:longest_gap")
    monkeypatch.setitem(
        sys.modules, "crosscue.eval.logs.longest_gap", SimpleNamespace(longest_gap=verb)
    )

    help_text = output_of("longest-gap", "--help")
    for option in ("LOG", "--from", "--to", "--topics", "--max-chunk", "--min-s S", "--json", "-q"):
        assert option in help_text, option
    assert "--min-s -1.0: expected more than 0" in refusal(
        2, "longest-gap", "drive.mcap", "--min-s", "-1"
    )
    with pytest.raises(UsageError, match=r"min_s: -1\.0, expected more than 0"):
        verb("drive.mcap", min_s=-1.0)
