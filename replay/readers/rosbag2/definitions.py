"""Definitions of the standard ROS 2 messages, for recordings that do not carry their own."""

from __future__ import annotations

from functools import cache


@cache
def known_definition(type_name: str) -> bytes:
    """The definition of ``type_name`` with those it uses, as ROS 2 Humble has it; else empty."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    if type_name not in store.fielddefs:
        return b""
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return text.encode()
