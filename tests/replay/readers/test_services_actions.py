"""Service events and actions in bags are recognised and counted, and not reported as damage."""

import json
import struct
from pathlib import Path
from typing import Literal

import pyarrow.parquet as pq
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from crosscue.eval import cli
from crosscue.replay.logs.opening import open_log
from support.ros_messages import ros2_topic

ROWS = 7
SERVICE = "/add/_service_event"
FEEDBACK = "/fibonacci/_action/feedback"
STATUS = "/fibonacci/_action/status"
TYPES = {
    SERVICE: "example_interfaces/srv/AddTwoInts_Event",
    FEEDBACK: "example_interfaces/action/Fibonacci_FeedbackMessage",
    STATUS: "action_msgs/msg/GoalStatusArray",
    "/word": "std_msgs/msg/String",
}
END = "=" * 80 + "\n"
TIME = "int32 sec\nuint32 nanosec\n"
UUID = f"{END}MSG: unique_identifier_msgs/UUID\nuint8[16] uuid\n"
EVENT_TEXT = (
    "service_msgs/ServiceEventInfo info\n"
    "example_interfaces/srv/AddTwoInts_Request[<=1] request\n"
    "example_interfaces/srv/AddTwoInts_Response[<=1] response\n"
    f"{END}MSG: service_msgs/ServiceEventInfo\nuint8 event_type\nbuiltin_interfaces/Time stamp\n"
    f"char[16] client_gid\nint64 sequence_number\n{END}MSG: builtin_interfaces/Time\n{TIME}"
    f"{END}MSG: example_interfaces/srv/AddTwoInts_Request\nint64 a\nint64 b\n"
    f"{END}MSG: example_interfaces/srv/AddTwoInts_Response\nint64 sum\n"
)
FEEDBACK_TEXT = (
    "unique_identifier_msgs/UUID goal_id\nexample_interfaces/action/Fibonacci_Feedback feedback\n"
    f"{END}MSG: example_interfaces/action/Fibonacci_Feedback\nint32[] sequence\n{UUID}"
)
SERVICE_TEXTS = {
    "complete": EVENT_TEXT,
    "service definition": "int64 a\nint64 b\n---\nint64 sum\n",
    "types missing": EVENT_TEXT.partition(END)[0],
    "none": "",
}
FEEDBACK_TEXTS = {
    "complete": FEEDBACK_TEXT,
    "action definition": "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n",
    "types missing": FEEDBACK_TEXT.partition(END)[0],
    "none": "",
}
Storage = Literal["sqlite3", "mcap"]


def payload(topic: str, i: int) -> bytes:
    """Return a message as a recorder stores it."""
    head = b"\x00\x01\x00\x00"
    if topic == SERVICE:  # Event, stamp, client, number; one request; no response.
        fixed = struct.pack("<B3xiI16sq", 1, i, 0, bytes(range(16)), i)
        return head + fixed + struct.pack("<I4xqqI", 1, i, 2 * i, 0)
    if topic == FEEDBACK:
        return head + bytes(16) + struct.pack("<I3i", 3, i, i + 1, i + 2)
    if topic == STATUS:
        return head + struct.pack("<I16siIb", 1, bytes(16), i, 0, 2)
    return head + struct.pack("<I", 3) + b"%02d\0" % i


def bag(folder: Path, storage: Storage, texts: dict[str, str]) -> Path:
    """Write a bag folder with a service, an action and a topic."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        links = {
            name: writer.add_connection(name, TYPES[name], msgdef=text, rihs01="RIHS01_0")
            for name, text in texts.items()
        }
        for i in range(ROWS):
            for k, (name, link) in enumerate(links.items()):
                writer.write(link, 10**18 + i * 10**8 + k, payload(name, i))
    return folder


def texts(service: str, feedback: str) -> dict[str, str]:
    """Return a definition for each topic."""
    return {
        SERVICE: SERVICE_TEXTS[service],
        FEEDBACK: FEEDBACK_TEXTS[feedback],
        **{name: ros2_topic(name, TYPES[name]).schema.decode() for name in (STATUS, "/word")},
    }


def opened(folder: Path, as_folder: bool) -> Path:
    """Return the folder, or the only storage file in it."""
    return folder if as_folder else next(p for p in folder.iterdir() if p.suffix != ".yaml")


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("as_folder", [True, False])
@pytest.mark.parametrize("service", list(SERVICE_TEXTS))
def test_service_events_are_skipped_with_their_reason(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    storage: Storage,
    service: str,
    as_folder: bool,
) -> None:
    path = opened(bag(tmp_path / "bag", storage, texts(service, "complete")), as_folder)

    status = cli.run(["convert", str(path), "-o", str(tmp_path / "out.mcap"), "--json"])
    output = capsys.readouterr()

    account = json.loads(output.out)["topics"]
    assert account[SERVICE]["skipped"] == {"service event": ROWS}
    assert account[SERVICE]["found"] == ROWS
    assert not any(topic["skipped"] for name, topic in account.items() if name != SERVICE)
    assert status == 3
    assert "damaged" not in output.out + output.err

    cli.run(["info", str(path)])
    shown = capsys.readouterr()
    assert "service event" in shown.out
    assert "damaged" not in shown.out + shown.err


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
@pytest.mark.parametrize("feedback", list(FEEDBACK_TEXTS))
def test_action_feedback_is_read_if_its_definition_is_stored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], storage: Storage, feedback: str
) -> None:
    path = bag(tmp_path / "bag", storage, texts("complete", feedback))

    cli.run(["decode", str(path), "-o", str(tmp_path / "tables"), "--json"])
    output = capsys.readouterr()

    accounts = json.loads((tmp_path / "tables" / "manifest.json").read_text())["account"]["reading"]
    topics = accounts[0]["topics"]
    is_complete = feedback in ("complete", "action definition")
    skipped = {} if is_complete else {"action feedback without a complete definition": ROWS}
    assert topics[FEEDBACK]["skipped"] == skipped
    assert topics[STATUS]["skipped"] == {}
    assert topics[SERVICE]["skipped"] == {"service event": ROWS}
    assert "damaged" not in output.out + output.err
    if is_complete:
        table = pq.read_table(tmp_path / "tables" / "fibonacci__action_feedback.parquet")
        assert table.num_rows == ROWS
    with open_log(path) as log:
        assert {topic.name for topic in log.topics} == set(TYPES)
