"""Mutation tests of the account, the cue rules and the filters: do the tests notice a changed line?

    python benchmarks/mutation.py [PART ...] [--jobs N] [--only GLOB] [--folder FOLDER]

mutmut changes one operator, constant, argument or condition at a time and runs the tests that reach
the changed function, in a process forked from one that has everything imported. Install it beside
crosscue's own dependencies: ``pip install mutmut==3.8.1``. Nothing else needs it, so it is no
development dependency, and CI does not run this.

Each part of ``PARTS`` is mutated in a copy of the tree, in a temporary folder or in ``--folder``. A
second run in the same folder repeats only what survived, with the tests as they are then. Delete
the folder when the mutated code has changed. ``--only`` selects functions, such as
``*Ledger*settle*``.

mutmut leaves out decorated functions and everything outside functions. So in the copy,

* ``@property def used`` is written as ``def used`` and ``used = property(used)``;
* a function contains the numbers that the file names at its top (``MIN_IOU``), not the names.

* a function decorated with ``lru_cache`` is not, because the cache would outlive the mutant.

Another value of ``strict=True`` of ``zip``, which only guards against errors, or of the type in
``cast`` is no mutant.

``mutation_equivalent.toml`` lists mutants that no test can kill, each with the reason. An entry
that fits no mutant is stale, and one that fits only killed mutants is wrong; both are reported.
Status 1: a part is below ``--min-percent``, or an entry is stale or wrong.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import fnmatch
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Final

ROOT: Final = Path(__file__).parents[1]
EQUIVALENT: Final = Path(__file__).with_name("mutation_equivalent.toml")
PACKAGES: Final = ("replay", "detectors", "fusion", "localization", "datasets", "eval")
VERSION: Final = "3.8.1"
SURVIVED: Final = 0
# Exit status of mutants that no test reaches.
NO_TEST: Final = 33
NOT_RUN: Final = None
NO_EFFECT: Final = re.compile(r",? ?(strict=(True|False|None),?|(?=\)))|(?<=\bcast\()[^,(]*, ")


@dataclass(frozen=True, slots=True)
class Part:
    """Files to mutate, and the tests that have to notice.

    Attributes:
        files: Patterns of files, relative to the repository.
        tests: Files or folders of tests; only quick ones, because each mutant runs them.
        left_out: Tests in them that take too long, or that count the frames of the stack.
    """

    files: tuple[str, ...]
    tests: tuple[str, ...]
    left_out: tuple[str, ...] = ()


PARTS: Final = {
    "ledger": Part(
        ("replay/ledger.py",),
        ("tests/replay/test_ledger.py",),
    ),
    "account": Part(
        ("eval/runs/account.py",),
        ("tests/eval/runs/test_run_account.py",),
        (
            "tests/eval/runs/test_run_account.py::"
            "test_account_of_truncated_log_balances_for_replay_and_estimate",
        ),
    ),
    "cues": Part(
        ("detectors/cues/*.py",),
        tuple(
            f"tests/detectors/cues/test_{name}.py"
            for name in (
                "far_side_by_hand",
                "frames_by_hand",
                "looked_for",
                "pairs_by_hand",
                "road",
                "road_area",
                "road_by_hand",
                "road_openings_by_hand",
            )
        ),
        (
            "tests/detectors/cues/test_far_side_by_hand.py::"
            "test_bus_samples_do_not_depend_on_block_boundaries",
            "tests/detectors/cues/test_looked_for.py::test_built_in_detectors_list_their_labels",
        ),
    ),
    "tracked": Part(
        ("detectors/cues/tracked/*.py",),
        (
            "tests/detectors/cues/test_car_tracks.py",
            "tests/detectors/cues/test_assigned_cars_by_hand.py",
            "tests/detectors/cues/test_tracks_by_hand.py",
        ),
        tuple(
            f"tests/detectors/cues/test_car_tracks.py::test_stationary_car_{law}"
            for law in (
                "never_crosses_clearly_for_any_ego_motion",
                "is_neither_oncoming_nor_outgoing",
                "with_jittering_box_never_crosses",
            )
        ),
    ),
    "fusion": Part(
        ("fusion/*.py",),
        tuple(
            f"tests/fusion/test_{name}.py"
            for name in (
                "approaches",
                "calibrated",
                "factor_graph",
                "persistence",
                "range_track",
                "temporal",
            )
        ),
        tuple(
            f"tests/fusion/test_{name}"
            for name in (
                "approaches.py::test_range_errors_over_drives_match_reported_variance",
                "calibrated.py::test_calibrated_model_beats_source_on_held_out_simulated_approaches",
                "range_track.py::test_filter_errors_match_variance_with_distance_correlated_noise",
                "range_track.py::test_followed_range_errors_match_reported_variance",
            )
        ),
    ),
    "fits": Part(
        ("fusion/fit/*.py",),
        tuple(
            f"tests/fusion/test_{name}.py" for name in ("calibrated", "message_fit", "temporal_fit")
        ),
        tuple(
            f"tests/fusion/test_{name}"
            for name in (
                "calibrated.py::test_calibrated_model_beats_source_on_held_out_simulated_approaches",
                "temporal_fit.py::test_redundant_cue_lowers_exponent",
                "temporal_fit.py::test_filter_recovers_features_of_held_out_drives",
            )
        ),
    ),
    "ekf": Part(
        ("localization/ekf.py",),
        (
            "tests/localization/test_ekf.py",
            "tests/localization/landmarks/test_landmark_update.py",
        ),
    ),
}


@dataclass(frozen=True, slots=True)
class Mutant:
    """One changed line.

    Attributes:
        name: The name by which mutmut knows it.
        file: Path in the repository.
        function: Qualified name within the file.
        was: The lines before, without differences of white space.
        now: The lines after.
        status: Exit status of its tests; None if they did not run.
    """

    name: str
    file: str
    function: str
    was: str
    now: str
    status: int | None

    @property
    def is_killed(self) -> bool:
        """True if a test failed, or did not end in time."""
        return self.status not in (SURVIVED, NO_TEST, NOT_RUN)


@dataclass(slots=True)
class Equivalent:
    """An entry of the list: changes of one line that no test can notice."""

    file: str
    function: str
    was: str
    now: tuple[str, ...]
    why: str
    fits: list[Mutant] = field(default_factory=list)

    def covers(self, mutant: Mutant) -> bool:
        """Return whether the mutant is one of the changes."""
        place = (mutant.file, mutant.function, mutant.was)
        return place == (self.file, self.function, self.was) and mutant.now in self.now


def main(arguments: Sequence[str] | None = None) -> int:
    """Mutate the parts and print what survived."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all")
    parser.add_argument("--jobs", type=int, default=1, help="processes, 1")
    parser.add_argument("--only", help="pattern of the functions to mutate, by mutmut's names")
    parser.add_argument("--folder", type=Path, help="folder of the copies, kept")
    parser.add_argument("--min-percent", type=float, default=95.0, help="percent to be killed, 95")
    parser.add_argument("--toml", action="store_true", help="print survivors in the list's form")
    given = parser.parse_args(arguments)
    if unknown := set(given.parts) - set(PARTS):
        parser.error(f"PART: {', '.join(sorted(unknown))} unknown; there are: {', '.join(PARTS)}")
    os.nice(15)
    passed = True
    with tempfile.TemporaryDirectory() as temporary:
        for name in given.parts or PARTS:
            folder = (given.folder or Path(temporary)).resolve() / name
            mutants = mutate(PARTS[name], folder, given.jobs, given.only)
            passed &= report(name, PARTS[name], mutants, given.min_percent, given.toml, given.only)
    return 0 if passed else 1


def mutate(part: Part, folder: Path, jobs: int, only: str | None) -> list[Mutant]:
    """Run mutmut in a copy of the tree."""
    copy_tree(part, folder)
    forget_survivors(part, folder)
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder / "mutants"),
        "CI": "1",  # Hypothesis then draws the same examples in every run.
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [mutmut(), "run", "--max-children", str(jobs), *([] if only is None else [only])]
    done = subprocess.run(
        command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True, check=False
    )
    (folder / "mutmut.log").write_text(done.stdout, encoding="utf-8")
    if done.returncode:
        seen = re.sub(r"^\S (Generating|Running|Listing).*\n", "", done.stdout, flags=re.MULTILINE)
        sys.exit(f"mutmut run in {folder}: status {done.returncode}\n{seen[-4000:]}")
    return results(part, folder)


def forget_survivors(part: Part, folder: Path) -> None:
    """Let the next run repeat the mutants that survived and are not known to be equivalent."""
    known = equivalents(part)
    names = {
        one.name
        for one in results(part, folder)
        if not one.is_killed and not any(entry.covers(one) for entry in known)
    }
    for meta in (folder / "mutants").rglob("*.py.meta"):
        content = json.loads(meta.read_text())
        statuses: dict[str, int | None] = content["exit_code_by_key"]
        if not names.isdisjoint(statuses):
            statuses |= dict.fromkeys(names & statuses.keys())
            meta.write_text(json.dumps(content))


def mutmut() -> str:
    """Return the path of mutmut: that of this Python if it has one."""
    beside = Path(sys.executable).with_name("mutmut")
    found = str(beside) if beside.exists() else shutil.which("mutmut")
    if found is None:
        sys.exit(f"mutmut: not installed; pip install mutmut=={VERSION}")
    return found


def copy_tree(part: Part, folder: Path) -> None:
    """Write the package, its tests and mutmut's settings to a folder."""
    mutated = [path for pattern in part.files for path in sorted(ROOT.glob(pattern))]
    for source in (*(ROOT / name for name in PACKAGES), ROOT / "crosscue", ROOT / "tests"):
        inside = folder if source.name in ("crosscue", "tests") else folder / "crosscue"
        for path in sorted(source.rglob("*")):
            is_link = source.name == "crosscue" and path.parent != source
            if path.is_dir() or "__pycache__" in path.parts or is_link:
                continue
            target = inside / path.relative_to(ROOT)
            content = path.read_bytes()
            if path in mutated:
                content = rewritten(content.decode()).encode()
            if not target.exists() or target.read_bytes() != content:
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(content)
    shutil.copy(ROOT / "pyproject.toml", folder)
    (folder / "mutants").mkdir(exist_ok=True)  # Python ignores a path that is absent at its start.
    lines = [
        "[mutmut]",
        _setting("source_paths", ["crosscue"]),
        _setting("only_mutate", [f"crosscue/{path.relative_to(ROOT)}" for path in mutated]),
        _setting("pytest_add_cli_args_test_selection", part.tests),
        _setting(
            "pytest_add_cli_args",
            ["-p", "no:cacheprovider", *(f"--deselect={name}" for name in part.left_out)],
        ),
        _setting("do_not_mutate_patterns", [r"^\s+raise NotImplementedError"]),
        "on_dependency_change = ignore",
    ]
    (folder / "setup.cfg").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _setting(name: str, values: Sequence[str]) -> str:
    return "\n".join([f"{name} =", *(f"    {value}" for value in values)])


def rewritten(source: str) -> str:
    """Return a module in the form that mutmut can mutate; see the docstring above."""
    source = _with_numbers(source)
    lines = source.splitlines()
    for node in reversed(list(_decorated(ast.parse(source)))):
        indent = " " * node.col_offset
        names = [ast.unparse(one) for one in node.decorator_list]
        wrapped = node.name
        for name in reversed(names):
            wrapped = f"{name}({wrapped})"
        if not any(name.startswith("lru_cache") for name in names):
            lines.insert(node.end_lineno or node.lineno, f"{indent}{node.name} = {wrapped}")
        del lines[node.decorator_list[0].lineno - 1 : node.lineno - 1]
    return "\n".join(lines) + "\n"


def _decorated(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """Yield decorated functions and methods that mutmut would leave out, in order."""
    for node in tree.body:
        for one in [node, *(node.body if isinstance(node, ast.ClassDef) else [])]:
            if isinstance(one, ast.FunctionDef) and one.decorator_list:
                names = [ast.unparse(name) for name in one.decorator_list]
                if names not in (["staticmethod"], ["classmethod"]):
                    yield one


def _with_numbers(source: str) -> str:
    """Replace names of numbers by the numbers, within functions."""
    tree = ast.parse(source)
    numbers: dict[str, str] = {}
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value:
            text = ast.unparse(node.value)
            if node.target.id.lstrip("_").isupper() and re.fullmatch(r"-?[\d._e-]+", text):
                numbers[node.target.id] = text if text[0] != "-" else f"({text})"
    places = [
        (name.lineno, name.col_offset, name.id)
        for function in ast.walk(tree)
        if isinstance(function, ast.FunctionDef)
        for statement in function.body
        for name in ast.walk(statement)
        if isinstance(name, ast.Name) and name.id in numbers
    ]
    lines = [line.encode() for line in source.splitlines()]
    for number, column, name_of in sorted(set(places), reverse=True):
        line = lines[number - 1]
        rest = line[column + len(name_of.encode()) :]
        lines[number - 1] = line[:column] + numbers[name_of].encode() + rest
    return b"\n".join(lines).decode() + "\n"


def results(part: Part, folder: Path) -> list[Mutant]:
    """Read what mutmut has found so far."""
    found: list[Mutant] = []
    for pattern in part.files:
        for path in sorted(ROOT.glob(pattern)):
            file = path.relative_to(ROOT).as_posix()
            mutated = folder / "mutants" / "crosscue" / file
            meta = mutated.with_name(mutated.name + ".meta")
            if meta.exists():
                by_name: dict[str, int | None] = json.loads(meta.read_text())["exit_code_by_key"]
                texts = _functions(mutated.read_text(encoding="utf-8"))
                found += [_mutant(name, file, texts, status) for name, status in by_name.items()]
    return [one for one in found if NO_EFFECT.sub("", one.was) != NO_EFFECT.sub("", one.now)]


def _functions(source: str) -> dict[str, str]:
    """Text of every function and method by name, with another name that is always the same."""
    lines = source.splitlines()
    return {
        node.name: "\n".join(lines[node.lineno - 1 : node.end_lineno]).replace(node.name, "_", 1)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.FunctionDef) and "__mutmut_" in node.name
    }


def _mutant(name: str, file: str, texts: dict[str, str], status: int | None) -> Mutant:
    short = name.rpartition(".")[2]
    mangled = short.rpartition("__mutmut_")[0]
    changed = difflib.ndiff(
        texts[f"{mangled}__mutmut_orig"].splitlines(), texts[short].splitlines()
    )
    was: list[str] = []
    now: list[str] = []
    for line in changed:
        if line[:2] in ("- ", "+ "):
            (was if line[0] == "-" else now).append(" ".join(line[2:].split()))
    function = mangled.removeprefix("x_").removeprefix("xǁ").replace("ǁ", ".")
    return Mutant(name, file, function, " ".join(was), " ".join(now), status)


def report(
    name: str,
    part: Part,
    mutants: Sequence[Mutant],
    min_percent: float,
    as_toml: bool,
    only: str | None,
) -> bool:
    """Print one part's counts and survivors; return whether it passes."""
    selected = [one for one in mutants if only is None or fnmatch.fnmatch(one.name, only)]
    known = equivalents(part)
    survived: list[Mutant] = []
    for one in mutants:
        fitting = [entry for entry in known if entry.covers(one)]
        for entry in fitting:
            entry.fits.append(one)
        if one in selected and not one.is_killed and not fitting:
            survived.append(one)
    killed = sum(one.is_killed for one in selected)
    equivalent = len(selected) - killed - len(survived)
    fraction = 100.0 * killed / max(killed + len(survived), 1)
    print(
        f"{name}: {len(selected)} mutants, {killed} killed, {equivalent} equivalent, "
        f"{len(survived)} survived: {fraction:.1f} % killed of those that can be"
    )
    for one in survived:
        print(_entry(one) if as_toml else _lines(one))
    wrong = [entry for entry in known if not any(not one.is_killed for one in entry.fits)]
    for entry in wrong if only is None else []:
        word = "killed" if entry.fits else "stale"
        print(f"  {word} entry: {entry.file} {entry.function}\n    - {entry.was}")
    return fraction >= min_percent and (only is not None or not wrong)


def equivalents(part: Part) -> list[Equivalent]:
    """Entries of the list for a part."""
    table = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))
    return [
        Equivalent(one["file"], one["function"], one["was"], tuple(one["now"]), one["why"])
        for one in table.get("equivalent", [])
        if any(PurePosixPath(one["file"]).match(pattern) for pattern in part.files)
    ]


def _lines(one: Mutant) -> str:
    note = {NO_TEST: " (no test reaches it)", NOT_RUN: " (not run)"}.get(one.status, "")
    return f"  {one.file} {one.function}{note}\n    - {one.was}\n    + {one.now}"


def _entry(one: Mutant) -> str:
    keys = {"file": one.file, "function": one.function, "was": one.was}
    head = [f"{key} = {json.dumps(text, ensure_ascii=False)}" for key, text in keys.items()]
    now = json.dumps([one.now], ensure_ascii=False)
    return "\n".join(["[[equivalent]]", *head, f"now = {now}", 'why = ""', ""])


if __name__ == "__main__":
    sys.exit(main())
