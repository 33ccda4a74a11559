"""The conformance files of the MCAP project, in two families.

The data folder has the suite's descriptions in JSON, and a script that rebuilds the files from
them. The second family has the same combinations of features with a ROS 2 type and profile.
"""

import hashlib
import importlib.util
import json
import re
import tarfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from support.data import shared
from support.mcap_files import Message


@dataclass(frozen=True, slots=True)
class Conformance:
    """One file of the suite and its content.

    Attributes:
        name: Name of the family and of the file.
        coded: Bytes of the file.
        types: Message type of every topic.
        messages: Messages by topic, in stored order.
    """

    name: str
    coded: bytes
    types: Mapping[str, str]
    messages: Mapping[str, list[Message]]


def suite() -> Iterator[Conformance]:
    """Yield the files of both families; skip the test if the data is missing."""
    folder = shared("mcap_conformance")
    spec = importlib.util.spec_from_file_location("rebuild", folder / "rebuild.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    with tarfile.open(folder / "descriptions.tar.gz") as packed:
        texts = {
            one.name: file.read() for one in packed if (file := packed.extractfile(one)) is not None
        }
    for name in sorted(one for one in texts if one.endswith(".json")):
        described = json.loads(texts[name])
        features = set(described["meta"]["variant"]["features"])
        pointer = re.search(rb"sha256:([0-9a-f]{64})", texts[name[:-5] + ".mcap"])
        assert pointer is not None
        records = script.data_records(described)
        for family, is_ros in (("plain", False), ("ros2", True)):
            own = script.retarget(records) if is_ros else records
            coded = script.build(own, features, retarget=is_ros)
            # The suite has no file of the second family, and so no hash.
            assert is_ros or hashlib.sha256(coded).hexdigest().encode() == pointer[1], name
            yield Conformance(f"{family} {Path(name).stem}", coded, *_content(own))


def _content(
    records: list[tuple[str, dict[str, Any]]],
) -> tuple[dict[str, str], dict[str, list[Message]]]:
    names = {f["id"]: f["name"] for kind, f in records if kind == "Schema"}
    channels = {f["id"]: f for kind, f in records if kind == "Channel"}
    found: dict[str, list[Message]] = {}
    for kind, f in records:
        if kind == "Message":
            content = bytes(int(number) for number in f["data"])
            one = (int(f["log_time"]), int(f["publish_time"]), content)
            found.setdefault(channels[f["channel_id"]]["topic"], []).append(one)
    return {f["topic"]: names.get(f["schema_id"], "") for f in channels.values()}, found
