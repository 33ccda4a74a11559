"""Bounded reading of text and files."""

import ast
import json
import tempfile
import time
import tomllib
from collections.abc import Callable
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
from crosscue.eval.fit.ranges.fit import range_pairs
from crosscue.eval.scoring.gates import load_gates
from crosscue.replay.errors import CrosscueError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.tree_text import MAX_DEPTH, json_tree, toml_tree, yaml_tree
from crosscue.replay.vehicle import vehicle
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
