"""Database files are read correctly, and doubtful contents are reported."""

import random
from dataclasses import replace
from pathlib import Path

import pytest

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.layout import CanMessage, CanSignal
from crosscue.replay.errors import CrosscueError, LogTooLargeError, SchemaError
from support.can_layouts import dbc_text
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
