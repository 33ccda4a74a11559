"""Store weights and their description as one safetensors file with a checksum.

Safetensors has no checksum of its own, and a flipped bit would silently change the network. The
checksum covers description and weights and is stored in the file's header. For the embedded files
the hash of the whole file is known.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from torch import Tensor

from crosscue.replay.errors import VehicleError, one_line
from crosscue.replay.files.tree_text import json_tree

SUM: Final = "crosscue-sha256"
# SHA-256 of the files that are part of the crosscue package.
EMBEDDED: Final[Mapping[str, str]] = {
    "compact_simulated.safetensors": (
        "270a8420ddeacd52901b85fe2139ef4f3af4eb19b9b0d8e015ec30776ca3b87d"
    ),
    "road.safetensors": "a1323a9f1f04962a6b6a4af7db8800d3c22e304c48a561c4ffbf808a75fafdc6",
}


def embedded(name: str) -> Path:
    """Path of one of the ``EMBEDDED`` files."""
    return Path(__file__).with_name("checkpoints") / name


def pack_weights(tensors: Mapping[str, Tensor], key: str, description: str) -> bytes:
    """Return the bytes of a file with weights and description.

    Args:
        tensors: Weights, on the CPU and contiguous.
        key: Header key of the description.
        description: Any text.
    """
    from safetensors.torch import save

    whole = dict(tensors)
    return serialised(whole, {key: description, SUM: _sum(description, save(whole))})


def serialised(tensors: Mapping[str, Tensor], words: Mapping[str, str]) -> bytes:
    """Serialise tensors and header entries as safetensors; equal input yields equal bytes.

    The library itself writes the entries in an order that differs between processes.
    """
    from safetensors.torch import save

    content = save(dict(tensors), dict(words))
    start = _start(content)
    header = json_tree(content[8:start])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return b"".join((len(text).to_bytes(8, "little"), text, memoryview(content)[start:]))


def unpack_weights(content: bytes, key: str, path: Path) -> tuple[str | None, dict[str, Tensor]]:
    """Return description and weights; the description is None if ``key`` is missing.

    Raises:
        VehicleError: The file is damaged or not safetensors.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    try:
        tensors = load(content)
        header = json_tree(content[8 : _start(content)]).get("__metadata__", {})
    except (SafetensorError, ValueError) as error:
        why = one_line(error, 120)
        raise VehicleError(f"{path}: not a safetensors file ({why}); is it complete?") from None
    description: str | None = header.get(key)
    if SUM in header and header[SUM] != _sum(description or "", content):
        raise VehicleError(
            f"{path}: damaged: its weights do not match their checksum; copy the file again, or "
            "train again"
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
    """Offset of the weights: after the header, whose length is stored first."""
    return 8 + int.from_bytes(content[:8], "little")
