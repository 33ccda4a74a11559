"""Weights and their description as one safetensors file, with a sum by which damage is seen.

Safetensors has no checksum: a flipped bit would be another network. The sum is over description
and weights, and is in the file's own header; files that came with crosscue are known whole.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from torch import Tensor

from crosscue.replay.base import VehicleError, json_tree, one_line

SUM: Final = "crosscue-sha256"
EMBEDDED: Final[Mapping[str, str]] = {
    "compact_simulated.safetensors": (
        "270a8420ddeacd52901b85fe2139ef4f3af4eb19b9b0d8e015ec30776ca3b87d"
    ),
    "road.safetensors": "a1323a9f1f04962a6b6a4af7db8800d3c22e304c48a561c4ffbf808a75fafdc6",
}
"""SHA-256 of the files that come with crosscue."""


def embedded(name: str) -> Path:
    """Where one of ``EMBEDDED`` lies."""
    return Path(__file__).with_name("checkpoints") / name


def packed(tensors: Mapping[str, Tensor], key: str, description: str) -> bytes:
    """The file's bytes.

    Args:
        tensors: On the CPU, contiguous.
        key: Under which the description stands.
        description: Any text.
    """
    from safetensors.torch import save

    whole = dict(tensors)
    return serialised(whole, {key: description, SUM: _sum(description, save(whole))})


def serialised(tensors: Mapping[str, Tensor], words: Mapping[str, str]) -> bytes:
    """Tensors and words as a safetensors file; the same ones are the same bytes.

    The library writes the words in an order that differs from process to process.
    """
    from safetensors.torch import save

    content = save(dict(tensors), dict(words))
    start = _start(content)
    header = json_tree(content[8:start])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return b"".join((len(text).to_bytes(8, "little"), text, memoryview(content)[start:]))


def unpacked(content: bytes, key: str, path: Path) -> tuple[str | None, dict[str, Tensor]]:
    """Description and weights; no description where the file has none under ``key``.

    Raises:
        VehicleError: Damaged, or no safetensors.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        tensors = load(content)
        header = json_tree(content[8 : _start(content)]).get("__metadata__", {})
    except (SafetensorError, ValueError) as error:
        why = one_line(error, 120)
        raise VehicleError(f"{path}: no safetensors file ({why}); is it whole?") from None
    description: str | None = header.get(key)
    if SUM in header and header[SUM] != _sum(description or "", content):
        raise VehicleError(
            f"{path}: damaged: its weights are not those it was written with; copy it again, or "
            "train it again"
        )
    wanted = EMBEDDED.get(path.name)
    if wanted is not None and path == embedded(path.name):
        found = hashlib.sha256(content).hexdigest()
        if found != wanted:
            raise VehicleError(
                f"{path}: damaged: expected sha256 {wanted[:12]}..., got {found[:12]}...; install "
                "crosscue again"
            )
    return description, tensors


def _sum(description: str, content: bytes) -> str:
    digest = hashlib.sha256(description.encode())
    digest.update(b"\0")
    digest.update(memoryview(content)[_start(content) :])
    return digest.hexdigest()


def _start(content: bytes) -> int:
    """Where the weights begin: behind the header, whose length stands first."""
    return 8 + int.from_bytes(content[:8], "little")
