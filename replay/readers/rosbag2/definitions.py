"""Definitions of the standard ROS 2 messages, for recordings without definitions."""

from __future__ import annotations

from functools import cache


@cache
def known_definition(type_name: str) -> bytes:
    """Return the ROS 2 Humble definition of ``type_name`` and of the types it uses, or empty."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    if type_name not in store.fielddefs:
        return b""
    text, _ = store.generate_msgdef(type_name, ros_version=2)
    return text.encode()
