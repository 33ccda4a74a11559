"""Encode pictures as ROS 2 messages: compressed and raw pictures, and packets of video streams."""

from dataclasses import replace
from typing import Final

import numpy as np

from crosscue.replay.columns import Block, Images, Int64s, Messages
from crosscue.replay.ledger import Ledger

from .outgoing import Outgoing, stamps, standard_type
from .template import ENCAPSULATION

VIDEO: Final = frozenset({"h264", "h265", "av1"})
PICTURE, STREAM, RAW = 0, 1, 2
UNSTATED: Final = "raw picture without size"


def image_messages(block: Block, images: Images, ledger: Ledger) -> list[Outgoing]:
    """Return pictures in the types of their codings; nearly every topic has only one."""
    kinds = np.array([_kind(coding) for coding in images.coding])
    out: list[Outgoing] = []
    for kind in dict.fromkeys(kinds.tolist()):
        which = kinds == kind
        part, some = (block, images) if which.all() else (block.take(which), images.take(which))
        if kind == RAW:
            out += _raw(part, some, ledger)
        else:
            out.append(_encoded(part, some, is_video=kind == STREAM))
    return out


def _kind(coding: str) -> int:
    return STREAM if coding in VIDEO else RAW if coding == "raw" else PICTURE


def _encoded(block: Block, images: Images, *, is_video: bool) -> Outgoing:
    name = "foxglove_msgs/msg/CompressedVideo" if is_video else "sensor_msgs/msg/CompressedImage"
    parts = []
    for i, t_ns in enumerate(stamps(block).tolist()):
        picture, coding = images.bytes_.payload(i), images.coding[i]
        head = _header(t_ns, block.topic)
        if is_video:
            parts.append((_with_bytes(head, picture), _string(b"", coding)))
        else:
            parts.append((_with_bytes(_string(head, coding), picture), b""))
    return Outgoing(standard_type(name)[0], replace(block, rows=_joined(parts, images)))


def _raw(block: Block, images: Images, ledger: Ledger) -> list[Outgoing]:
    width, height, step = images.width_px, images.height_px, images.step_bytes
    if width is None or height is None or step is None or images.pixel_format is None:
        first = int(block.log_ns[0])
        ledger.skip(block.topic, UNSTATED, len(block), "", first)
        return []
    parts = []
    for i, t_ns in enumerate(stamps(block).tolist()):
        head = _header(t_ns, block.topic)
        head += bytes(-len(head) % 4)
        head += int(height[i]).to_bytes(4, "little") + int(width[i]).to_bytes(4, "little")
        head = _string(head, images.pixel_format[i]) + b"\x00"
        head += bytes(-len(head) % 4) + int(step[i]).to_bytes(4, "little")
        parts.append((_with_bytes(head, images.bytes_.payload(i)), b""))
    kind = standard_type("sensor_msgs/msg/Image")[0]
    return [Outgoing(kind, replace(block, rows=_joined(parts, images)))]


def _header(t_ns: int, frame_id: str) -> bytes:
    seconds, rest = divmod(t_ns, 1_000_000_000)
    head = seconds.to_bytes(4, "little", signed=True) + rest.to_bytes(4, "little")
    return _string(head, frame_id)


def _string(head: bytes, text: str) -> bytes:
    raw = text.encode("utf-8") + b"\x00"
    return head + bytes(-len(head) % 4) + len(raw).to_bytes(4, "little") + raw


def _with_bytes(head: bytes, content: memoryview) -> bytes:
    """Return the bytes before the picture: the head and the length of the picture."""
    return head + bytes(-len(head) % 4) + len(content).to_bytes(4, "little")


def _joined(parts: list[tuple[bytes, bytes]], images: Images) -> Messages:
    """Join encapsulation, head, picture and tail of all messages in one buffer."""
    sizes = (images.bytes_.stop - images.bytes_.start).tolist()
    length: list[int] = []
    for (head, tail), size in zip(parts, sizes, strict=True):
        inner = len(head) + size
        length.append(len(ENCAPSULATION) + inner + (-inner % 4 + len(tail) if tail else 0))
    stop: Int64s = np.cumsum(np.array(length, np.int64))
    start = stop - np.array(length, np.int64)
    buffer = np.zeros(int(stop[-1]) if len(stop) else 0, np.uint8)
    view = buffer.data
    for i, (head, tail) in enumerate(parts):
        at = int(start[i])
        whole = ENCAPSULATION + head
        view[at : at + len(whole)] = whole
        at += len(whole)
        view[at : at + sizes[i]] = images.bytes_.payload(i)
        if tail:
            end = int(stop[i])
            view[end - len(tail) : end] = tail
    return Messages(buffer, start, stop)
