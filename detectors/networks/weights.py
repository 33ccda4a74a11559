"""What a back end makes a network of."""

from __future__ import annotations

from crosscue.detectors.settings import Settings


class Weights(Settings):
    """Weights as read and verified.

    Attributes:
        name: Of the file, for errors.
        content: Its bytes.
        second: Bytes of an OpenVINO ``.bin``, else empty.
    """

    name: str
    content: bytes
    second: bytes = b""
