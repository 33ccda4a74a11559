"""Cache of detectors' results, so that a picture runs once per weights and settings.

It is one SQLite file; the key is a hash of the picture and the detector's identity. A row that
fails its checksum is ignored. Times are not stored: two equal pictures share their result.
"""

import hashlib
import json
import os
import sqlite3
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from crosscue.replay.errors import OutputError
from crosscue.replay.files import door
from crosscue.replay.files.closing import Closing
from crosscue.replay.files.tree_text import json_tree

from .base import Detections, Found, RoadMask
from .images import Encoded

_SCHEMA: Final = (
    "CREATE TABLE IF NOT EXISTS found "
    "(key BLOB PRIMARY KEY, text BLOB NOT NULL, crc INTEGER NOT NULL) WITHOUT ROWID"
)


def picture_key(picture: Encoded) -> bytes:
    """Hash everything that determines a picture's pixels."""
    digest = hashlib.sha256(picture.content)
    digest.update(f"{picture.coding} {picture.layout}".encode())
    return digest.digest()


class ResultCache(Closing):
    """A result cache in a file, or in memory if the path is None; a context manager."""

    def __init__(self, path: Path | None) -> None:
        """Open the cache, or create it.

        Raises:
            OutputError: The file cannot be written, or is not a cache.
        """
        self._path: Final = path
        try:
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                os.close(door.opened(path, os.O_CREAT | os.O_RDWR))
            self._file = sqlite3.connect(":memory:" if path is None else path, timeout=30.0)
            self._file.execute(_SCHEMA)
        except (sqlite3.Error, OSError) as error:
            raise OutputError(f"{path}: {error}; use another file with --cache") from None

    def get(self, picture: bytes, identity: str, t_ns: int) -> Found | None:
        """Return a detector's result for a picture, with the frame's time; None if not cached."""
        row = self._file.execute(
            "SELECT text, crc FROM found WHERE key = ?", (_key(picture, identity),)
        ).fetchone()
        if row is None or zlib.crc32(row[0]) != row[1]:
            return None
        try:
            return replace(_from_json(json_tree(zlib.decompress(row[0]))), t_ns=t_ns)
        except (ValueError, KeyError, TypeError, zlib.error):
            return None

    def put(self, rows: Sequence[tuple[bytes, str, Found]]) -> None:
        """Store detectors' results for pictures, either all or none of them.

        Raises:
            OutputError: The disk is full.
        """
        packed = []
        for picture, identity, found in rows:
            text = zlib.compress(json.dumps(_as_json(found)).encode(), 1)
            packed.append((_key(picture, identity), text, zlib.crc32(text)))
        try:
            with self._file:
                self._file.executemany("INSERT OR REPLACE INTO found VALUES (?, ?, ?)", packed)
        except sqlite3.Error as error:
            raise OutputError(
                f"{self._path}: {error}; free disk space, or use another --cache"
            ) from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _key(picture: bytes, identity: str) -> bytes:
    return hashlib.sha256(picture + identity.encode()).digest()


def _as_json(found: Found) -> dict[str, Any]:
    if isinstance(found, RoadMask):
        return {
            "size_px": found.size_px,
            "mask": found.mask.decode("ascii"),
            "mask_size_px": found.mask_size_px,
        }
    return {
        "size_px": found.size_px,
        "boxes_px": found.boxes_px.tolist(),
        "scores": found.scores.tolist(),
        "labels": found.labels,
        "masks": [mask.decode("ascii") for mask in found.masks],
        "lenses": found.lenses,
        "looks": found.looks,
    }


def _from_json(kept: dict[str, Any]) -> Found:
    width, height = kept["size_px"]
    if "mask" in kept:
        mask_width, mask_height = kept["mask_size_px"]
        text = kept["mask"].encode("ascii")
        return RoadMask(0, (width, height), text, (mask_width, mask_height))
    return Detections(
        0,
        (width, height),
        np.array(kept["boxes_px"], np.float64).reshape(-1, 4),
        np.array(kept["scores"], np.float64),
        tuple(kept["labels"]),
        tuple(mask.encode("ascii") for mask in kept["masks"]),
        tuple(kept["lenses"]),
        looks=tuple(kept["looks"]),
    )
