"""Layouts of CAN databases: read directly from the text, and cached for the next start."""

import random
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.replay.can import database
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.dbc_text import read_dbc
from crosscue.replay.can.layout import CanMessage
from crosscue.replay.can.layout_cache import VARIABLE, layout_cache_folder
from crosscue.replay.can.sources import DatabaseText
from crosscue.replay.errors import SchemaError
from support.can_layouts import dbc_text, messages
from support.data import shared

EXTENDED = """VERSION ""
BU_: ECU Vector__XXX
BO_ 2147484000 Wide: 8 ECU
 SG_ kind M : 0|4@1+ (1,0) [0|0] "" ECU,Vector__XXX
 SG_ inner m1M : 4|4@1+ (1,0) [0|15] "" ECU
 SG_ deep m3 : 8|16@1- (0.5,-40) [-40|100] "\u00b0C" ECU
 SG_ whole m2 : 8|16@1+ (2.0,1.0) [0|1] "" ECU
 SG_ other : 63|8@0+ (1.0,0) [0|0] "" ECU
BO_ 100 Fd: 64 ECU
 SG_ real : 0|32@1- (1,0) [0|0] "" ECU
CM_ SG_ 100 real "a \\" quote
and a second line";
BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","StandardCAN_FD";
BA_DEF_DEF_ "VFrameFormat" "ExtendedCAN";
BA_ "VFrameFormat" BO_ 100 2;
VAL_ 2147484000 other 1 "one" 2 "two" ;
SIG_VALTYPE_ 100 real : 1;
SG_MUL_VAL_ 2147484000 inner kind 1-1;
SG_MUL_VAL_ 2147484000 deep inner 3-3, 7-9;
SG_MUL_VAL_ 2147484000 whole kind 2-2;
"""


def _layout_by_cantools(source: DatabaseText) -> list[CanMessage]:
    parsed = database._parse(source, "dbc")
    distinguishes_fd = database._distinguishes_fd(parsed, "dbc")
    return [database._message(one, "dbc", distinguishes_fd) for one in parsed.messages]


def _reprs(messages: list[CanMessage]) -> list[str]:
    """Return each message's repr: 1 and 1.0 differ, as their columns do, and sets are sorted."""
    return [
        repr(replace(m, signals=()))
        + "".join(repr((replace(s, branches=frozenset()), sorted(s.branches))) for s in m.signals)
        for m in messages
    ]


@pytest.mark.slow
@given(message=st.one_of(messages(), messages(multiplexed=True)))
@settings(max_examples=100)
def test_random_layouts_equal_cantools(message: CanMessage) -> None:
    source = DatabaseText(Path("x.dbc"), dbc_text([message]))

    quick = read_dbc(source.text)

    assert quick is not None
    assert _reprs(quick) == _reprs(_layout_by_cantools(source))


@pytest.mark.parametrize("text", [EXTENDED, "savvycan/bms.dbc", "savvycan/LeafPowertrainBus.dbc"])
def test_layouts_of_damaged_files_equal_cantools(text: str) -> None:
    intact = text if "\n" in text else shared("can", *text.split("/")).read_text()
    chance = random.Random(7)
    compared = 0
    for _ in range(150):
        at, count = chance.randrange(len(intact)), chance.randrange(1, 9)
        patch = chance.choice(["", intact[at : at + count] * 2, chance.choice(' ;:"|@M0-_\n\\')])
        source = DatabaseText(Path("x.dbc"), intact[:at] + patch + intact[at + count :])
        quick = read_dbc(source.text)
        if quick is None:
            continue
        try:
            theirs = _layout_by_cantools(source)
        except SchemaError:
            continue  # decoding does not use the damaged statement
        assert _reprs(quick) == _reprs(theirs), source.text
        compared += 1
    assert compared > 20


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("SG_ other :", 'SG_ real : 0|8@1+ (1,0) [0|0] "" ECU\n SG_ real :'),
        ("BO_ 100 Fd", "BO_ 2147484000 Fd"),
        ("BO_ 100 Fd", "BO_ 4000 Fd"),
        ("VAL_ 2147484000 other", "VAL_ 2147484000 unknown"),
        ("SIG_VALTYPE_ 100 real", "SIG_VALTYPE_ 100 unknown"),
        ("deep inner 3-3", "inner inner 3-3"),
        ("0|32@1-", "0|0@1-"),
        ("(2.0,1.0)", "(.5,1.0)"),
        ("Fd: 64", "Fd: 064"),
        ('"VFrameFormat" BO_ 100 2', '"SystemMessageLongSymbol" BO_ 100 "Long"'),
        ('"VFrameFormat" BO_ 100 2', '"VFrameFormat" BO_ 100 20'),
        ("\nVAL_ 2147484000", "\nBOGUS_ 2147484000"),
        ("7-9;\n", "7-9\n"),
    ],
)
def test_unusual_statements_are_left_to_cantools(old: str, new: str) -> None:
    assert EXTENDED.count(old) == 1

    assert read_dbc(EXTENDED.replace(old, new)) is None


@pytest.fixture
def cache_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Use an empty cache folder."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def _dbc_file(tmp_path: Path, text: str = EXTENDED, name: str = "x.dbc") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def _record_parses(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Collect the names of the files that are parsed from now on."""
    parsed: list[str] = []
    read = database._read_layout

    def counted(source: DatabaseText, form: str) -> tuple[list[CanMessage], list[str]]:
        parsed.append(source.path.name)
        return read(source, form)

    monkeypatch.setattr(database, "_read_layout", counted)
    return parsed


def test_cache_entry_depends_on_text_name_and_code(
    tmp_path: Path, cache_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed = _record_parses(monkeypatch)
    CanDatabase.load([_dbc_file(tmp_path)])
    CanDatabase.load([_dbc_file(tmp_path, EXTENDED.replace("-40|100", "-40|101"))])
    CanDatabase.load([_dbc_file(tmp_path, name="y.dbc")])
    monkeypatch.setattr("crosscue.replay.can.layout_cache._made_by", lambda: "other code")
    CanDatabase.load([_dbc_file(tmp_path)])

    assert parsed == ["x.dbc", "x.dbc", "y.dbc", "x.dbc"]
    assert len(list(cache_dir.iterdir())) == 4


def test_damaged_cache_entry_is_parsed_again(
    tmp_path: Path, cache_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _dbc_file(tmp_path)
    intact = CanDatabase.load([path])
    (entry,) = cache_dir.iterdir()
    stored = entry.read_bytes()
    parsed = _record_parses(monkeypatch)
    chance = random.Random(3)
    copies = [b"", stored[:-1], stored[:20], b"null", b"\n{}"]
    for _ in range(40):
        at = chance.randrange(len(stored))
        copies.append(
            stored[:at] + bytes([stored[at] ^ 1 << chance.randrange(8)]) + stored[at + 1 :]
        )
    for copy in copies:
        entry.write_bytes(copy)
        again = CanDatabase.load([path])
        assert _reprs([*again.messages]) == _reprs([*intact.messages])
        assert again.notices == intact.notices
        assert entry.read_bytes() == stored

    assert len(parsed) == len(copies)


def test_cache_folder_follows_environment() -> None:
    assert layout_cache_folder({VARIABLE: "/a"}) == Path("/a")
    assert layout_cache_folder({VARIABLE: "off"}) is None
    assert layout_cache_folder({"XDG_CACHE_HOME": "/b"}) == Path("/b/crosscue/can_layouts")
    home = Path.home() / ".cache/crosscue/can_layouts"
    assert layout_cache_folder({}) == home
    assert layout_cache_folder({"XDG_CACHE_HOME": "relative"}) == home


_LOAD_OFTEN = """
import sys
from pathlib import Path
from crosscue.replay.can.database import CanDatabase
path, folder = sys.argv[1:]
first = CanDatabase.load([path])
for _ in range(20):
    for entry in Path(folder).glob("*.json"):
        entry.unlink(missing_ok=True)
    assert CanDatabase.load([path]) == first
"""


@pytest.mark.slow
def test_concurrent_loads_do_not_interfere(tmp_path: Path, cache_dir: Path) -> None:
    path = _dbc_file(tmp_path)
    command = [sys.executable, "-c", _LOAD_OFTEN, str(path), str(cache_dir)]
    running = [subprocess.Popen(command) for _ in range(3)]

    assert [one.wait(timeout=60) for one in running] == [0, 0, 0]
    assert not list(cache_dir.glob(".*"))


def test_old_cache_entries_are_removed(tmp_path: Path, cache_dir: Path) -> None:
    for k in range(70):
        CanDatabase.load([_dbc_file(tmp_path, name=f"{k}.dbc")])

    assert len(list(cache_dir.iterdir())) == 64
