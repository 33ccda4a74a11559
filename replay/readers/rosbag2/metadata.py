"""Contents of a ROS 2 bag folder's ``metadata.yaml``, which is a hint only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.tree_text import yaml_tree

METADATA_BYTES: Final = 1 << 20


@dataclass(frozen=True, slots=True)
class SplitHint:
    """The metadata of one storage file.

    Attributes:
        name: File name without a folder.
        count: Number of messages, or None.
        range_ns: First and last log time, or None.
    """

    name: str
    count: int | None = None
    range_ns: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True)
class Metadata:
    """The metadata of the folder.

    Attributes:
        splits: Storage files in the listed order.
        counts: Number of messages by topic.
        fault: Reason why the file could not be read, or empty.
    """

    splits: tuple[SplitHint, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    fault: str = ""


def read_metadata(path: Path) -> Metadata:
    """Read ``metadata.yaml``; if it is missing or unreadable, only ``fault`` is set."""
    try:
        raw = read_at_most(path, METADATA_BYTES)
        if raw is None:
            return Metadata(fault="implausibly large")
        said = yaml_tree(raw.decode("utf-8", "backslashreplace"), "base")
    except FileNotFoundError:
        return Metadata(fault="missing")
    except (OSError, ValueError, TypeError, LookupError) as error:
        return Metadata(fault=f"unreadable ({type(error).__name__})")
    about = _mapping(_mapping(said).get("rosbag2_bagfile_information"))
    if not about:
        return Metadata(fault="without rosbag2_bagfile_information")
    return Metadata(_splits(about), _counts(about))


def _splits(about: Mapping[str, Any]) -> tuple[SplitHint, ...]:
    hints = {name: SplitHint(name) for name in map(_name, _sequence(about, "relative_file_paths"))}
    for line in map(_mapping, _sequence(about, "files")):
        name = _name(line.get("path"))
        start = _number(_mapping(line.get("starting_time")).get("nanoseconds_since_epoch"))
        length = _number(_mapping(line.get("duration")).get("nanoseconds"))
        known = start is not None and length is not None
        range_ns = (start or 0, (start or 0) + (length or 0)) if known else None
        hints[name] = SplitHint(name, _number(line.get("message_count")), range_ns)
    hints.pop("", None)
    return tuple(hints.values())


def _counts(about: Mapping[str, Any]) -> dict[str, int]:
    counts: dict[str, int] = {}
    for line in map(_mapping, _sequence(about, "topics_with_message_count")):
        name = _mapping(line.get("topic_metadata")).get("name")
        count = _number(line.get("message_count"))
        if isinstance(name, str) and name and count is not None:
            counts[name] = counts.get(name, 0) + count
    return counts


def _mapping(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _sequence(about: Mapping[str, Any], name: str) -> list[Any]:
    value = about.get(name)
    return value if isinstance(value, list) else []


def _name(value: object) -> str:
    """Return the last part of a path, because a folder (as in old bags) is never followed."""
    return PurePosixPath(value).name if isinstance(value, str) else ""


def _number(value: object) -> int | None:
    """Return a count or time if it is an integer in the range of int64, else None."""
    if not isinstance(value, str) or not value.lstrip("-").isdecimal() or len(value) > 20:
        return None
    number = int(value)
    return number if -(2**63) <= number < 2**63 else None
