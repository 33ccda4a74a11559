"""Bounded reading of text and files, partial files, and processes that end early."""

import ast
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Final

import pytest
import tomlkit
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import crosscue
from crosscue.datasets.labels.table import read_tool_labels
from crosscue.datasets.truth import truth
from crosscue.detectors.catalog.card import read_card
from crosscue.eval import cli
from crosscue.eval.fit.ranges.fit import range_pairs
from crosscue.eval.runs.folder import create, locked
from crosscue.eval.scoring.gates import load_gates
from crosscue.replay.errors import CrosscueError
from crosscue.replay.files import partial_file
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.partial_file import PARTIAL, Scratch, sweep
from crosscue.replay.files.tree_text import MAX_DEPTH, json_tree, strict_json, toml_tree, yaml_tree
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.processes import in_processes
from crosscue.replay.vehicle import vehicle
from support import faults, scenes
from support.every_format import EVERY_FORMAT
from support.measured import measured

PARSERS: Final = {
    *("json.loads", "json.load", "tomllib.loads", "tomllib.load"),
    *("tomlkit.parse", "tomlkit.loads", "tomlkit.load"),
}
DEEP_JSON: Final = (
    "[" * 100_000,
    '{"a":' * 100_000,
    "[" * 200 + "]" * 200,
    '{"a":' * 900 + "1" + "}" * 900,
)
DEEP_TOML: Final = (
    "a = " + "[" * 100_000,
    "a = " + "{a=" * 5_000,
    "a." * 10_000 + "a = 1",
    "a." * 20_000 + "b=1",
    "[" + "a . " * 20_000 + "b]",
    '\'a\'."\\"#".' * 20_000 + "b = 1",
    "a = {" + "a." * 20_000 + "b = 1}",
    "a = " + "[" * 900 + "]" * 900,
)


_VALUES: Final = st.recursive(
    st.none() | st.integers() | st.text('[]{}"\\a', max_size=6),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text('[]{}"\\', max_size=3), inner, max_size=4)
    ),
    max_leaves=40,
)


# There is no deadline, because generating nested values is slow on some machines.
@settings(suppress_health_check=[HealthCheck.too_slow])
@given(_VALUES, st.integers(0, MAX_DEPTH + 5))
def test_json_within_depth_limit_equals_json_loads(value: object, around: int) -> None:
    text = "[" * around + json.dumps(value) + "]" * around
    depth = _depth(json.loads(text))

    for form in (text, text.encode()):
        if depth <= MAX_DEPTH:
            assert json_tree(form) == json.loads(text)
        else:
            with pytest.raises(ValueError, match=f"nested over {MAX_DEPTH} levels"):
                json_tree(form)


@given(_VALUES | st.lists(st.floats() | st.booleans() | st.text(max_size=3)))
def test_strict_json_is_sorted_and_indented_as_by_json(value: object) -> None:
    """Numbers without a JSON form are null; other text is what ``json`` itself makes."""

    def plain(one: object) -> object:
        if isinstance(one, list):
            return [plain(item) for item in one]
        return None if isinstance(one, float) and not math.isfinite(one) else one

    assert strict_json(value) == json.dumps(plain(value), sort_keys=True, indent=2)
    assert strict_json({1: ("\udcff",), "a": {}}) == (
        '{\n  "1": [\n    "\\\\xff"\n  ],\n  "a": {}\n}'
    )


def _depth(value: object) -> int:
    if not isinstance(value, dict | list):
        return 0
    below = value.values() if isinstance(value, dict) else value
    return 1 + max(map(_depth, below), default=0)


@pytest.mark.parametrize(
    ("parse", "text"),
    [
        *((json_tree, text) for text in DEEP_JSON),
        *(pytest.param(toml_tree, text, marks=pytest.mark.slow) for text in DEEP_TOML),
    ],
)
def test_deeply_nested_text_is_refused(parse: Callable[[str], object], text: str) -> None:
    with pytest.raises(ValueError, match="nested"):
        parse(text)


_TEXTS: Final = st.text("[]{}.=#\"'\\\na ", max_size=90)


@given(st.dictionaries(_TEXTS, _TEXTS | st.lists(_TEXTS, max_size=3), max_size=4), _TEXTS)
def test_toml_with_brackets_and_dots_in_texts_equals_tomllib(
    value: dict[str, object], comment: str
) -> None:
    text = tomlkit.dumps(value) + "# " + comment.replace("\n", " ")
    assert toml_tree(text) == tomllib.loads(text) == value


_DBC: Final = 'VERSION ""\nBU_: A\nBO_ 100 M: 8 A\n SG_ S : 0|8@1+ (1,0) [0|255] "" A\n'
# Texts whose parsing must take time and memory in proportion to their size, and if they are read.
# DBC files with long comments are read; the others are refused.
BOMBS: Final[dict[str, tuple[str, Callable[[], str], bool]]] = {
    "toml dotted key": ("toml", lambda: "a." * 20_000 + "b=1", False),
    "toml table name": ("toml", lambda: "[" + "a." * 20_000 + "b]", False),
    "toml brackets": ("toml", lambda: "a = " + "[" * 250_000, False),
    "yaml anchors": ("yaml", lambda: "".join(f"a{i}: &x 1\n" for i in range(20_000)), False),
    "yaml brackets": ("yaml", lambda: "[" * 500_000, False),
    "yaml blocks": ("yaml", lambda: "- " * 250_000, False),
    "dbc comment": ("dbc", lambda: _DBC + 'CM_ "' + "x" * 10_000_000 + '";\n', True),
    "dbc comment with quotes": ("dbc", lambda: _DBC + 'CM_ "' + '\\"' * 5_000_000 + '";\n', True),
    "dbc comment with paths": ("dbc", lambda: _DBC + 'CM_ "' + "C:\\a" * 2_500_000 + '";\n', True),
    "dbc nodes": ("dbc", lambda: _DBC + "BU_ :" + " a" * 5_000_000 + "\n", True),
    "dbc unclosed text": ("dbc", lambda: _DBC + 'CM_ "' + "x" * 10_000_000, False),
    "dbc signals on one bit": (
        "dbc",
        lambda: (
            _DBC
            + "".join(f' SG_ S{i} : 0|8@1+ (1,0) [0|255] "" A\n' for i in range(20_000))
            + 'CM_ "";\n'
        ),
        True,
    ),
    "kcd names": ("kcd", lambda: "<Message " * 1_000_000, False),
    "sym words": ("sym", lambda: "Var " * 2_500_000, False),
}
REFUSED: Final = {"toml": 2, "yaml": 3, "dbc": 4, "kcd": 4, "sym": 4}
CPU_S: Final = 20
MAX_MB: Final = 400


@pytest.mark.slow
@pytest.mark.parametrize("case", BOMBS)
def test_text_takes_memory_and_time_in_proportion(case: str, tmp_path: Path) -> None:
    suffix, text, is_read = BOMBS[case]
    (tmp_path / "can.log").write_text("(1.000000) can0 064#0000000000000000\n")
    (tmp_path / f"bomb.{suffix}").write_text(text())
    vehicle = tmp_path / "bomb.toml"
    if suffix == "yaml":
        log = EVERY_FORMAT["rosbag2"](tmp_path)
        (tmp_path / "bomb.yaml").rename(log / "metadata.yaml")
        argv = ["info", str(log)]
    else:
        if suffix != "toml":
            vehicle.write_text(f'version = 1\n[can]\ndbc = ["bomb.{suffix}"]\n')
        log = tmp_path / "can.log"
        argv = ["decode", str(log), "-o", str(tmp_path / "out"), "--vehicle", str(vehicle)]

    status, output, peak_mb = measured(argv, cpu_s=CPU_S)

    assert peak_mb < MAX_MB
    assert status == (0 if is_read else REFUSED[suffix]), output
    assert len(output) < 3_000 or is_read, output[:3_000]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 9_000, "nested"),
        ("\n".join(" " * i + "a:" for i in range(70)), "nested"),
        ("b: [*a, *a]", "alias"),
        ("a: &a [x, x]\nb: 1", "anchor"),
        ("a: " + "x" * (1 << 20), "the limit is 1048576"),
        ("a: [", "found"),
    ],
)
def test_deeply_nested_or_invalid_yaml_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        yaml_tree(text)


@pytest.mark.parametrize(
    "text", ['"' + '\\"' * 2_000_000, '"\\' * 2_000_000, "[" * 70 + '"\\"' * 900_000]
)
def test_unterminated_quotes_are_refused_quickly(text: str) -> None:
    began = time.process_time()
    with pytest.raises(ValueError):  # noqa: PT011
        json_tree("[" * 70 + text)
    assert time.process_time() - began < 2.0


@pytest.mark.slow
def test_product_parses_json_toml_and_yaml_only_in_tree_text() -> None:
    """All readers of such files count the nesting first."""
    root = Path(crosscue.__file__).parent
    paths = [path for room in root.iterdir() if room.is_dir() for path in room.rglob("*.py")]
    assert len(paths) > 500
    for path in (one for one in paths if one.name != "tree_text.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            assert not (isinstance(node, ast.Name) and node.id == "YAML"), path
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                assert f"{node.value.id}.{node.attr}" not in PARSERS, path
                assert node.attr != "load_string" or path.name == "database.py", path


ENDLESS = Path("/dev/zero")
LABELS = [partial(read_tool_labels, sizes={}, kind=kind) for kind in ("coco", "cvat", "fiftyone")]


@given(content=st.binary(max_size=40), max_count=st.integers(0, 40))
def test_file_over_limit_is_not_read(content: bytes, max_count: int) -> None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(content)
        file.flush()

        assert read_at_most(Path(file.name), max_count) == (
            content if len(content) <= max_count else None
        )


@pytest.mark.skipif(not ENDLESS.exists(), reason="no /dev/zero here")
@pytest.mark.parametrize(
    "read", [vehicle.load, read_card, load_gates, truth.read_truth, range_pairs, *LABELS]
)
def test_endless_file_is_refused(read: Callable[[Path], object]) -> None:
    with pytest.raises(CrosscueError, match=r"/dev/zero: over \d+ MiB"):
        read(ENDLESS)


def _partials(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob(f".*{PARTIAL}"))


@contextmanager
def _child_process(code: str) -> Iterator[subprocess.Popen[str]]:
    """Run ``code`` in a process that prints a line once it has started, and kill it at the end."""
    lines = f"{code}\nprint('begun', flush=True)\nimport time; time.sleep(60)\n"
    with subprocess.Popen(
        [sys.executable, "-c", lines], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        try:
            yield process
        finally:
            process.kill()


def test_only_partial_files_of_dead_processes_are_swept(tmp_path: Path) -> None:
    code = (
        "from pathlib import Path\nfrom crosscue.replay.files.partial_file import PartialFile\n"
        f"held = PartialFile(Path({str(tmp_path)!r}, 'a.txt'))"
    )
    with _child_process(code) as process:
        sweep(tmp_path, again=True)
        write_text(tmp_path / "b.txt", "b")
        assert len(_partials(tmp_path)) == 1
        process.send_signal(signal.SIGKILL)
        process.wait()

    # The process number may be in use again by now; it is not examined.
    sweep(tmp_path, again=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.txt"]


def test_temporary_folders_of_killed_processes_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    code = (
        "from crosscue.replay.files.partial_file import Scratch\n"
        "held = Scratch(); (held.path / 'copy.db3').write_text('large')"
    )
    with _child_process(code) as process:
        with Scratch():
            assert len(list(tmp_path.iterdir())) == 2
        assert len(list(tmp_path.iterdir())) == 1
        process.kill()
        process.wait()

    with Scratch() as folder:
        assert list(tmp_path.iterdir()) == [folder]
    assert not list(tmp_path.iterdir())


def test_run_of_dead_process_is_unlocked_despite_reused_pid(tmp_path: Path) -> None:
    run = create(tmp_path / "run", overwrite=False)
    code = (
        "from pathlib import Path\nfrom crosscue.eval.runs.folder import RunFolder, locked\n"
        f"held = locked(RunFolder(Path({str(run.path)!r}))); held.__enter__()"
    )
    with _child_process(code) as process:
        process.kill()
        process.wait()
    text = run.file(".lock").read_text()
    assert text.startswith(f"{process.pid} ")
    # The process number is replaced by that of a running process, the parent.
    run.file(".lock").write_text(text.replace(str(process.pid), str(os.getppid()), 1))

    with locked(run):
        pass


def _convert(folder: Path) -> list[str]:
    log = folder / "can0.log"
    log.write_text(
        "".join(f"(1700000000.{i:06d}) can0 123#{i % 256:02X}\n" for i in range(0, 9000, 3))
    )
    return ["convert", str(log), "-o", str(folder / "out" / "a.mcap"), "--overwrite", "-q"]


def _simulate(folder: Path) -> list[str]:
    out = str(folder / "out")
    return ["simulate", "C", "-o", out, "--width", "64", "--overwrite", "-q"]


@pytest.mark.slow
@pytest.mark.parametrize("command", [_convert, _simulate])
def test_run_after_kill_leaves_no_partial_files(
    tmp_path: Path, command: Callable[[Path], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Forked processes inherit the patch.
    scenes.shorten(monkeypatch, pictures=5)
    argv = command(tmp_path)
    out = tmp_path / "out"
    count = len(faults.operations(out, faults.CHANGES, argv))
    left = 0

    for operation in (2, count // 2, count - 2):
        shutil.rmtree(out)
        assert faults.killed_before(out, operation, argv).status == -signal.SIGKILL
        left += len(_partials(out))
        time.sleep(partial_file.SWEEP_S)
        assert cli.run(argv) == 0
        assert not _partials(out)
    assert left


def test_files_of_other_programs_are_not_swept(tmp_path: Path) -> None:
    others = [".a.txt.1234.partial", "a.partial", ".drive.crosscue-xyz.partial", ".a.partial"]
    for name in others:
        (tmp_path / name).write_text("of another program")
    (tmp_path / f".folder.crosscue-{'0' * 16}.partial").mkdir()
    (tmp_path / f".link.crosscue-{'0' * 16}.partial").symlink_to(tmp_path / others[0])
    os.mkfifo(tmp_path / f".pipe.crosscue-{'0' * 16}.partial")
    before = sorted(path.name for path in tmp_path.iterdir())

    sweep(tmp_path, again=True)

    assert sorted(path.name for path in tmp_path.iterdir()) == before


def fail_at_two(number: int) -> int:
    if number == 2:
        raise ValueError("two")
    return number


@pytest.mark.parametrize("workers", [1, 2])
def test_failure_is_raised_after_earlier_results(workers: int) -> None:
    found = in_processes(fail_at_two, range(4), workers)

    assert [next(found), next(found)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(found)


SLEEPS: Final = """
import sys, time
from crosscue.replay.errors import CrosscueError
from crosscue.replay.processes import in_processes
if __name__ == "__main__":
    try:
        list(in_processes(time.sleep, [0.05] * 200, 2))
    except CrosscueError as error:
        sys.exit(str(error))
"""
# After the first worker was started: it imports modules, then works.
MOMENTS_S: Final = (0.0, 0.03, 0.1, 0.3, 0.8)


def _children(pid: int) -> list[int]:
    """Return the worker processes of a process."""
    pids = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    command = {int(one): Path(f"/proc/{one}/cmdline").read_bytes() for one in pids}
    return [one for one, words in command.items() if b"serve_pipe" in words]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="finds workers in /proc")
@pytest.mark.parametrize("killed", ["parent", "workers", "all", "one worker"])
def test_killed_processes_leave_neither_traceback_nor_processes(
    killed: str, tmp_path: Path
) -> None:
    (tmp_path / "sleeps.py").write_text(SLEEPS)
    for moment_s in MOMENTS_S:
        parent = subprocess.Popen(
            [sys.executable, tmp_path / "sleeps.py"], stderr=subprocess.PIPE, text=True
        )
        while not (workers := _children(parent.pid)):
            assert parent.poll() is None
            time.sleep(0.002)
        time.sleep(moment_s)
        workers = _children(parent.pid)[: 1 if killed == "one worker" else None]

        for pid in {"parent": [parent.pid], "all": [parent.pid, *workers]}.get(killed, workers):
            os.kill(pid, signal.SIGKILL)

        # The end of stderr shows that the last process has ended.
        _, error = parent.communicate(timeout=20)
        assert "Traceback" not in error
        if killed in ("parent", "all"):
            assert (parent.returncode, error) == (-signal.SIGKILL, "")
        else:
            assert parent.returncode == 1
            assert error == "a worker process was killed by SIGKILL (out of memory?); run again\n"
