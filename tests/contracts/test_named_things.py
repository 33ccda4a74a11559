"""A name in an option is looked up before a log is read, and refused if nothing has it.

Options that name a file are in ``test_auxiliary_files.py``.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval import cli
from support.command_lines import LOGS, VALID, valid_inputs
from support.opened_files import opened_files
from support.refusals import refusal

# A command line of each command with such options, without the option to be tested.
BASE: Final[dict[str, str]] = {
    **VALID,
    "train road": "--layouts L0 -o {out}.safetensors",
    "study intersections": "-o {out} --layouts A --runs 1 --width 160 --no-attribution",
}

OTHER_BASE: Final[dict[tuple[str, str], str]] = {
    ("compare", "--runs"): "{runs} --against true",
    ("compare", "--against"): "{runs} --runs true",
    ("study intersections", "--layouts"): "-o {out}",
    ("train road", "--layouts"): "-o {out}.safetensors",
}

# How to spell a thing that does not exist, by option.
NONEXISTENT: Final[dict[str, tuple[str, ...]]] = {
    "--against": ("nosuch=1",),
    "--detector": ("nosuch",),
    "--detectors": ("nosuch", "{gone}.toml", "nosuch.module:build", "os:nosuch"),
    "--kind": ("nosuch",),
    "--layouts": ("nosuch",),
    "--map": ("nosuch=a",),
    "--only": ("nosuch",),
    "--runs": ("nosuch=1",),
    "--test-layouts": ("nosuch",),
    "--topics": ("/nosuch",),
    "--val-layouts": ("nosuch",),
    "--where": ("nosuch=1",),
}

# Options whose value is not the name of something that exists.
NAMES_NOTHING: Final[dict[str, str]] = {
    "--at": "a time",
    "--by": "a tag that runs may lack; if all do, the result is empty, see test_paired.py",
    "--classes": "new names of the user",
    "--experiment": "made if missing",
    "--from": "a time",
    "--label": "a label that files may lack; if all do, the result is empty",
    "--max-chunk": "a number",
    "--metrics": "a pattern; one that fits nothing has an empty result, see test_paired.py",
    "--mlflow": "an address that only the server can refuse, see test_pages.py",
    "--near": "numbers",
    "--output": "written",
    "--ray": "an address that only a cluster can refuse",
    "--remove": "a tag that a run may lack",
    "--shard": "numbers",
    "--size": "numbers",
    "--source": "a name to store",
    "--subset": "numbers",
    "--to": "a time",
    "--tolerance": "a pattern; one that fits nothing allows nothing",
}

# Options whose value is looked up in the log itself, or in labels of its pictures.
NEEDS_LOG: Final = {"--topics", "--map"}

NUMBERS: Final = ("int", "float", "metres", "_fraction")


def _options() -> Iterator[tuple[str, str]]:
    """Yield each command and option whose value the parser does not check by itself."""
    for name in cli.COMMANDS:
        for action in cli.parser_of(name)[1]._actions:
            kind = getattr(action.type, "__name__", "")
            is_free = action.nargs != 0 and not action.choices and kind not in NUMBERS
            is_file = action.type is Path or action.metavar == "NETWORK"
            if (
                action.option_strings
                and is_free
                and not is_file
                and "--help" not in action.option_strings
            ):
                yield name, action.option_strings[-1]


OPTIONS: Final = tuple(_options())


CASES: Final = [
    (name, option, spelling, "log" if option == "--map" else LOGS[number % len(LOGS)])
    for name, option in OPTIONS
    for number, spelling in enumerate(NONEXISTENT.get(option, ()), len(name))
]


def test_every_option_has_spelling_of_nonexistent_thing_or_names_nothing() -> None:
    assert {option for _, option in OPTIONS} == NONEXISTENT.keys() | NAMES_NOTHING.keys()
    assert not NONEXISTENT.keys() & NAMES_NOTHING.keys()
    assert all(name in BASE or (name, option) in OTHER_BASE for name, option, _, _ in CASES)
    assert {*OTHER_BASE} <= {*OPTIONS}


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Valid inputs of every kind, and things that do not exist."""
    folder = tmp_path_factory.mktemp("inputs")
    found = valid_inputs(folder)
    score = ["score", str(found["run"]), "--truth", str(found["truth"]), "--without-figures"]
    assert cli.run(score) == 0
    return {**found, "gone": folder / "nosuch_gone", "runs": folder}


@pytest.mark.parametrize(
    ("name", "option", "spelling", "log"), CASES, ids=lambda one: str(one).strip("{}-")
)
def test_option_that_names_nonexistent_thing_is_refused_before_log_is_read(
    name: str,
    option: str,
    spelling: str,
    log: str,
    names: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    known = {**names, "log": names[log], "out": tmp_path / "out"}
    word = spelling.format(**known)
    base = OTHER_BASE.get((name, option), BASE.get(name, ""))
    argv = [*name.split(), *base.format(**known).split(), option, word]

    with opened_files() as opened:
        error = refusal((2, 4), *argv)

    assert Path(word.partition("=")[0]).name in error
    assert not list(tmp_path.iterdir())
    if option not in NEEDS_LOG:
        assert str(known["log"]) not in opened
