"""What an option names: files, missing or unusable, and things that do not exist.

For a missing or empty file, noise, a folder or other text, the exit status is 4 for input and 2 for
settings. One line names the file, and no file is written. Files and names of options are looked up
before a log is read.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval import cli
from support.command_lines import LOGS, VALID, valid_inputs
from support.opened_files import opened_files
from support.refusals import refusal
from support.trees import tree

MASKS: Final = VALID["train mask-rcnn"]
# Lines other than the valid one with its file, or one more option, that is ``{gone}``.
OTHER: Final[dict[tuple[str, str], str]] = {
    ("browse", "--logs"): "{failures} -o {out} --logs {gone}",
    ("check", "--picture"): "{card} --picture {gone} -o {out}.jpg",
    ("fit detector", "--test"): "{run} --labels {coco} --test {gone} --test-labels {coco}",
    ("fit detector", "--test-labels"): (
        "{run} --labels {coco} --test {run} --test-labels {gone}.json"
    ),
    ("fit ranges", "--runs"): "--cue stop_sign --truth {truth} --runs {gone}",
    ("fit ranges", "--truth"): "--cue stop_sign --truth {gone}",
    ("fit signs", "--test"): "{labels} --label stop --test {gone}.csv",
    ("landmarks add", "--coordinates"): "{out}.db --images {pictures} --coordinates {gone}",
    ("landmarks add", "--images"): "{out}.db --images {gone} --coordinates {places}",
    ("landmarks add", "DB"): "{gone} --images {pictures} --coordinates {places}",
    ("model init", "MODEL"): "{gone}.onnx",
    ("model show", "MODEL"): "{gone}.toml",
    ("train mask-rcnn", "--measure"): "--data {coco} --images {pictures} --measure {gone}",
    ("train road", "--measure"): "--data {masks} --measure {gone}",
    ("truth import", "--export"): "{coco} --export {gone} -o {out}",
    ("train mask-rcnn", "--val-data"): f"{MASKS} --val-data {{gone}} --val-images {{pictures}}",
    ("train mask-rcnn", "--val-images"): f"{MASKS} --val-data {{coco}} --val-images {{gone}}",
}
# Endings by which a file is recognised.
ENDINGS: Final = {
    "--labels": ".json", "ANNOTATIONS": ".json", "LABELS": ".csv", "--dbc": ".dbc",
    "--detectors": ".toml",
}  # fmt: skip
# Files of settings: exit status 2, and of all others 4.
SETTINGS: Final = {
    "MODEL", "--card", "--class-names", "--detectors", "--from", "--gate", "--init", "--measure",
    "--spec", "--vehicle",
}  # fmt: skip
# Commands that read the DBC files of a vehicle file.
READS_DBC_FILES: Final[dict[str, str]] = {
    "decode": "{log} -o {out} --vehicle {vehicle}",
    "replay": "{log} -o {out} --vehicle {vehicle} --no-cache",
    "estimate": "{run} --vehicle {vehicle}",
    "info": "{log} --vehicle {vehicle}",
}
# Options whose file is created if it is missing.
WRITTEN: Final = {"--output", "--junit", "--cache", "--page"}
# Arguments that are not files.
NO_FILES: Final = {"LAYOUT", "NAME", "SQL"}
# Commands whose arguments accept any file, or no file.
ANY_BYTES: Final = {"seal", "model fetch", "completion"}
# Arguments whose file is created if it is missing or empty.
CREATED_IF_MISSING: Final = {("landmarks add", "DB")}
# Arguments that accept a folder; an empty folder is another error.
FOLDERS: Final = {
    ("estimate", "--logs"), ("score", "--logs"), ("view", "--logs"), ("report", "--logs"),
    ("score detector", "--logs"), ("fit detector", "--logs"), ("landmarks add", "--images"),
    ("train road", "--data"), ("train mask-rcnn", "--images"), ("train mask-rcnn", "--val-images"),
    ("merge", "RUNS"), ("query", "RUNS"), ("status", "RUNS"), ("history", "RUNS"),
    ("failures", "RUN"), ("browse", "RUN"), ("browse", "--logs"), ("export", "--logs"),
    ("truth import", "--export"), ("truth import", "ANNOTATIONS"),
}  # fmt: skip
DAMAGE: Final[dict[str, Callable[[Path], object]]] = {
    "missing": lambda path: None,
    "empty": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(bytes(range(256)) * 8),
    "a folder": lambda path: path.mkdir(),
    "text": lambda path: path.write_text("nothing of the kind\n"),
    "nested": lambda path: path.write_text(f"a = {'[' * 3000}{']' * 3000}\n"),
}


def _named_files() -> set[tuple[str, str]]:
    """Return all arguments, and options whose value is an input path or a network."""
    found = set()
    for name in cli.COMMANDS:
        _, parser = cli.parser_of(name)
        for action in parser._actions:
            if action.option_strings and (action.type is Path or action.metavar == "NETWORK"):
                found.add((name, action.option_strings[-1]))
            elif not action.option_strings and name not in ANY_BYTES:
                found.add((name, str(action.metavar)))
    return {(name, option) for name, option in found if option not in {*WRITTEN, *NO_FILES}}


def _line(name: str, option: str) -> str:
    """Return a command line in which the value of one argument or option is ``{gone}``."""
    if (name, option) in OTHER:
        return OTHER[name, option]
    words, gone = VALID[name].split(), f"{{gone}}{ENDINGS.get(option, '')}"
    if option in words:
        words[words.index(option) + 1] = gone
    elif option.startswith("--"):
        words += [option, gone]
    else:
        actions = cli.parser_of(name)[1]._actions
        arguments = [one.metavar for one in actions if not one.option_strings]
        words[arguments.index(option)] = gone
    return " ".join(words)


DETECTORS: Final = {("detect", "--detectors"), ("replay", "--detectors")}
CASES: Final = {case: _line(*case) for case in sorted(_named_files() | DETECTORS)}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("case", CASES, ids=" ".join)
def test_unusable_input_file_is_refused_in_one_line(
    case: tuple[str, str],
    damage: str,
    names: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Otherwise weights that the user has fetched would be used instead of the file.
    monkeypatch.setenv("CROSSCUE_MODELS", str(tmp_path / "models"))
    command, line, expected = case[0], CASES[case], 2 if case[1] in SETTINGS else 4
    DAMAGE[damage](tmp_path / ("gone" + line.partition("{gone}")[2].partition(" ")[0]))
    if damage == "a folder" and case in FOLDERS:
        pytest.skip("expects a folder; an empty one is another error")
    if case in CREATED_IF_MISSING and damage in ("missing", "empty"):
        pytest.skip("created if missing")
    if case[1] == "--class-names" and damage in ("text", "nested"):
        pytest.skip("expects text")
    is_option = case[1].startswith("--")
    log = names[LOGS[[*DAMAGE].index(damage) % len(LOGS) if is_option else 0]]
    places = {**names, "log": log, "gone": tmp_path / "gone", "out": tmp_path / "out"}
    argv = line.format(**places).split()

    opened = _assert_refused([*command.split(), *argv], expected, "gone", names, tmp_path)

    assert not is_option or not {str(names[one]) for one in LOGS} & {*opened}


def _assert_refused(
    argv: list[str], expected: int, named: str, names: dict[str, Path], out: Path
) -> list[str]:
    """Check how a command ends, and return the files that it opened."""
    inputs = names["masks"].parent
    before, here = tree(inputs), tree(out)

    with opened_files() as opened:
        error = refusal(expected, *argv)

    assert named in error
    assert "bug" not in error
    assert tree(inputs) == before
    assert {name for name in tree(out) if Path(out / name).is_file()} == here.keys()
    return opened


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("command", READS_DBC_FILES)
def test_unusable_dbc_file_of_vehicle_file_is_refused_in_one_line(
    command: str, damage: str, names: dict[str, Path], tmp_path: Path
) -> None:
    DAMAGE[damage](tmp_path / "gone.dbc")
    vehicle = tmp_path / "strange.toml"
    vehicle.write_text(names["car"].read_text().replace("simulated_car.dbc", "gone.dbc"))
    line = READS_DBC_FILES[command]
    argv = line.format(**names, vehicle=vehicle, out=tmp_path / "out").split()

    _assert_refused([command, *argv], 4, "gone.dbc", names, tmp_path)


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


NAME_CASES: Final = [
    (name, option, spelling, "log" if option == "--map" else LOGS[number % len(LOGS)])
    for name, option in OPTIONS
    for number, spelling in enumerate(NONEXISTENT.get(option, ()), len(name))
]


def test_every_option_has_spelling_of_nonexistent_thing_or_names_nothing() -> None:
    assert {option for _, option in OPTIONS} == NONEXISTENT.keys() | NAMES_NOTHING.keys()
    assert not NONEXISTENT.keys() & NAMES_NOTHING.keys()
    assert all(name in BASE or (name, option) in OTHER_BASE for name, option, _, _ in NAME_CASES)
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
    ("name", "option", "spelling", "log"), NAME_CASES, ids=lambda one: str(one).strip("{}-")
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
