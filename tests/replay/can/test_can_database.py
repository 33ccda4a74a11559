"""CAN databases: read correctly, doubtful contents reported, layouts cached for the next start."""

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
from crosscue.replay.can.layout import CanMessage, CanSignal
from crosscue.replay.can.layout_cache import VARIABLE, layout_cache_folder
from crosscue.replay.can.sources import DatabaseText
from crosscue.replay.errors import CrosscueError, LogTooLargeError, SchemaError
from support.can_layouts import dbc_text, messages
from support.data import shared
from support.trees import written

YAW = CanMessage(
    "Yaw",
    0x123,
    False,
    8,
    (
        CanSignal("rate", 7, 16, is_big_endian=True, is_signed=True, scale=0.01, unit="°/s"),
        CanSignal("state", 16, 2, choices={0: "off", 1: "on"}),
        CanSignal("load", 32, 32, is_float=True, minimum=-5, maximum=5),
    ),
)
WHEEL = CanMessage("Wheel", 0x456, True, 4, (CanSignal("speed", 0, 16, scale=0.1, unit="km/h"),))

# One frame with one signal, in the fewest elements that AUTOSAR allows.
ARXML = """<?xml version="1.0" encoding="UTF-8"?>
<AUTOSAR xmlns="http://autosar.org/schema/r4.0"
    xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
    xsi:schemaLocation="http://autosar.org/schema/r4.0 AUTOSAR_4-2-1.xsd">
<AR-PACKAGES><AR-PACKAGE><SHORT-NAME>P</SHORT-NAME><ELEMENTS>
<CAN-CLUSTER><SHORT-NAME>Bus</SHORT-NAME><CAN-CLUSTER-VARIANTS><CAN-CLUSTER-CONDITIONAL>
<PHYSICAL-CHANNELS><CAN-PHYSICAL-CHANNEL><SHORT-NAME>Channel</SHORT-NAME><FRAME-TRIGGERINGS>
<CAN-FRAME-TRIGGERING><SHORT-NAME>Trigger</SHORT-NAME>
<FRAME-REF DEST="CAN-FRAME">/P/Wheel</FRAME-REF>
<CAN-ADDRESSING-MODE>EXTENDED</CAN-ADDRESSING-MODE>
<CAN-FRAME-TX-BEHAVIOR>CAN-20</CAN-FRAME-TX-BEHAVIOR><IDENTIFIER>1110</IDENTIFIER>
</CAN-FRAME-TRIGGERING>
</FRAME-TRIGGERINGS></CAN-PHYSICAL-CHANNEL></PHYSICAL-CHANNELS>
</CAN-CLUSTER-CONDITIONAL></CAN-CLUSTER-VARIANTS></CAN-CLUSTER>
<CAN-FRAME>
<SHORT-NAME>Wheel</SHORT-NAME><FRAME-LENGTH>4</FRAME-LENGTH><PDU-TO-FRAME-MAPPINGS>
<PDU-TO-FRAME-MAPPING><SHORT-NAME>Mapping</SHORT-NAME>
<PACKING-BYTE-ORDER>MOST-SIGNIFICANT-BYTE-LAST</PACKING-BYTE-ORDER>
<PDU-REF DEST="I-SIGNAL-I-PDU">/P/Pdu</PDU-REF><START-POSITION>0</START-POSITION>
</PDU-TO-FRAME-MAPPING></PDU-TO-FRAME-MAPPINGS></CAN-FRAME>
<I-SIGNAL-I-PDU>
<SHORT-NAME>Pdu</SHORT-NAME><LENGTH>4</LENGTH><I-SIGNAL-TO-PDU-MAPPINGS>
<I-SIGNAL-TO-I-PDU-MAPPING><SHORT-NAME>Signal</SHORT-NAME>
<I-SIGNAL-REF DEST="I-SIGNAL">/P/speed</I-SIGNAL-REF>
<PACKING-BYTE-ORDER>MOST-SIGNIFICANT-BYTE-LAST</PACKING-BYTE-ORDER>
<START-POSITION>0</START-POSITION>
</I-SIGNAL-TO-I-PDU-MAPPING></I-SIGNAL-TO-PDU-MAPPINGS></I-SIGNAL-I-PDU>
<I-SIGNAL>
<SHORT-NAME>speed</SHORT-NAME>
<LENGTH>16</LENGTH>
<SYSTEM-SIGNAL-REF DEST="SYSTEM-SIGNAL">/P/speed_of_wheel</SYSTEM-SIGNAL-REF></I-SIGNAL>
<SYSTEM-SIGNAL><SHORT-NAME>speed_of_wheel</SHORT-NAME></SYSTEM-SIGNAL>
</ELEMENTS></AR-PACKAGE></AR-PACKAGES></AUTOSAR>
"""


def write_file(folder: Path, text: str | bytes, name: str = "bus.dbc") -> Path:
    return written(folder / name, text.encode() if isinstance(text, str) else text)


@pytest.mark.parametrize(
    ("old", "new", "where", "error"),
    [
        ("SG_ rate", "SG_ rate rate rate", "7: not a readable DBC file: .*line 7", SchemaError),
        ("BO_ 291", "BO_ dreihundert", "6: ", SchemaError),
        ("VAL_ 291", "VAL_ 292", "10: .*unused VAL_.*; correct that line or get a", SchemaError),
        ("BO_ 291", "BO_ 4000", "6: .*more than 11 bits in message Yaw", SchemaError),
        ("7|16@", "7|99999999999@", "7: signal length 99999999999 is large", LogTooLargeError),
        ("7|16@", "99999999999|16@", "7: start bit", LogTooLargeError),
        ("Yaw: 8", "Yaw: 99999999", "6: message length", LogTooLargeError),
        ("VAL_", "SG_MUL_VAL_ 291 a b 0-4000000000;\nVAL_", "10: multiplexer", LogTooLargeError),
    ],
)
def test_invalid_dbc_file_is_refused_with_line_number(
    old: str, new: str, where: str, error: type[CrosscueError], tmp_path: Path
) -> None:
    text = dbc_text([replace(YAW, signals=YAW.signals[:2])])

    with pytest.raises(error, match=rf"bus\.dbc:{where}") as refused:
        CanDatabase.load([write_file(tmp_path, text.replace(old, new, 1))])
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("empty.dbc", b"", r"empty\.dbc:1: empty; expected a CAN database"),
        ("zeros.dbc", b"VERSION \n\0\0\0", r"zeros\.dbc:2: contains zero bytes"),
        ("none.dbc", b'VERSION ""\nBU_: A\n', r"none\.dbc: defines no message"),
        ("bus.txt", b"", r"bus\.txt: not a CAN database; expected a name ending in \.dbc"),
        ("bus.kcd", b"<a>\n<b></a>", r"bus\.kcd:2: not a readable KCD file"),
        ("bus.kcd", b"<a></a>", r"bus\.kcd:1: not a readable KCD file: .*Expected root element"),
        ("bus.arxml", b"<a>", r"bus\.arxml:1: not a readable ARXML file"),
        ("bus.sym", b"FormatVersion=5.0", r"bus\.sym:1: not a readable SYM file: .*6\.0"),
    ],
)
def test_file_that_is_not_a_database_is_refused(
    name: str, content: bytes, words: str, tmp_path: Path
) -> None:
    with pytest.raises(SchemaError, match=words):
        CanDatabase.load([write_file(tmp_path, content, name)])


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path: Path) -> None:
    drawn = random.Random(5)
    text = dbc_text([YAW, WHEEL]).encode()
    for _ in range(150):
        damaged = bytearray(text)
        for _ in range(drawn.randint(1, 4)):
            damaged[drawn.randrange(len(damaged))] = drawn.randrange(256)
        words = ""
        try:
            CanDatabase.load([write_file(tmp_path, bytes(damaged))])
        except CrosscueError as error:
            words = str(error)
        assert "\n" not in words
        assert not words or "bus.dbc" in words


def test_arxml_file_defines_frames(tmp_path: Path) -> None:
    database = CanDatabase.load([write_file(tmp_path, ARXML, "bus.arxml")])

    wheel = database.named("Wheel")
    assert replace(wheel, source="", topic="") == replace(
        WHEEL, signals=(CanSignal("speed", 0, 16),), is_fd=False
    )
    assert wheel.source == "bus.arxml:16"
    huge = ARXML.replace("<LENGTH>16<", "<LENGTH>99999999999<")
    with pytest.raises(LogTooLargeError, match=r"bus\.arxml:30: length or position"):
        CanDatabase.load([write_file(tmp_path, huge, "bus.arxml")])


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("Yaw: 8", "Yaw: 4", "signal load does not fit into 4 bytes"),
        (
            "SG_ state ",
            "SG_ state m3",
            "signal state is multiplexed, but its multiplexer is not specified",
        ),
    ],
)
def test_only_invalid_message_is_not_decodable(
    old: str, new: str, problem: str, tmp_path: Path
) -> None:
    text = dbc_text([YAW, WHEEL]).replace(old, new)

    database = CanDatabase.load([write_file(tmp_path, text)])

    assert database.named("Yaw").problem == problem
    assert not database.named("Wheel").problem
    assert any("Yaw cannot be decoded" in notice for notice in database.notices)


@pytest.mark.parametrize("encoding", ["utf-8", "cp1252", "utf-8-sig", "utf-16"])
def test_units_are_read_in_every_text_encoding(encoding: str, tmp_path: Path) -> None:
    path = write_file(tmp_path, dbc_text([YAW]).encode(encoding))

    assert CanDatabase.load([path]).named("Yaw").signal("rate").unit == "°/s"


def test_messages_of_same_name_get_distinct_topic_names(tmp_path: Path) -> None:
    text = dbc_text([YAW, replace(YAW, arbitration_id=0x124)])

    database = CanDatabase.load([write_file(tmp_path, text)])

    assert [m.topic_name for m in database.messages] == ["Yaw_0x123", "Yaw_0x124"]
    assert database.named("Yaw_0x124").arbitration_id == 0x124
    with pytest.raises(ValueError, match="2 messages are named 'Yaw'; choose one of: Yaw_0x123"):
        database.named("Yaw")


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


def test_cache_folder_follows_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for text, folder in (("/a", Path("/a")), ("off", None)):
        monkeypatch.setenv(VARIABLE, text)
        assert layout_cache_folder() == folder
    monkeypatch.delenv(VARIABLE)
    # The XDG specification requires that relative paths are ignored.
    for base, home in (("/b", Path("/b")), ("relative", Path.home() / ".cache")):
        monkeypatch.setenv("XDG_CACHE_HOME", base)
        assert layout_cache_folder() == home / "crosscue" / "can_layouts"


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
