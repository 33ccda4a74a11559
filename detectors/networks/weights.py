"""Verified weights, the input of a back end."""

from crosscue.detectors.settings import Settings


class Weights(Settings):
    """Content of a weights file, of verified hash.

    Attributes:
        name: Name of the file, for errors.
        content: Bytes of the file.
        second: Bytes of an OpenVINO ``.bin``, else empty.
    """

    name: str
    content: bytes
    second: bytes = b""
