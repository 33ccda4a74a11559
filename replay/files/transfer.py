"""A file of a known SHA-256 from a server or from this machine, checked before it is kept.

A transfer that was cut goes on where it stopped: what has come so far is beside the place of the
whole file, as ``NAME.part``.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from http.client import HTTPResponse
from pathlib import Path
from typing import Any, Final, Protocol
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from crosscue.replay.base import (
    MIB,
    CrosscueError,
    UsageError,
    cannot_write,
    file_sha256,
    one_line,
    write_whole,
)

TIMEOUT_S: Final = 30.0
_PARTIAL: Final = 206
_RANGE_REFUSED: Final = 416

Progress = Callable[[str, int, int], None]
"""Reported a file's name, the bytes that have come, and how many there are."""


class KnownFile(Protocol):
    """A file of which is known what it must be."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    @property
    def size_bytes(self) -> int:
        """How long it is."""
        ...

    @property
    def sha256(self) -> str:
        """In hexadecimal."""
        ...


def is_there(file: KnownFile, place: Path) -> bool:
    """Whether ``place`` holds this very file."""
    return (
        place.is_file()
        and place.stat().st_size == file.size_bytes
        and file_sha256(place) == file.sha256
    )


def take(source: Path, file: KnownFile, place: Path, owner: str) -> None:
    """Copy a file of this machine to its place.

    Args:
        source: The file.
        file: What it must be.
        place: Where it goes.
        owner: What it belongs to, for errors: ``model yolox-nano``.

    Raises:
        UsageError: It is not there, or another file.
        OutputError: The place cannot be written.
    """
    try:
        found = file_sha256(source)
    except OSError as error:
        raise UsageError(f"{source}: {error.strerror}; give {file.name} of {owner}") from None
    if found != file.sha256:
        raise UsageError(f"{source}: SHA-256 {found}, {owner} needs {file.sha256}; give that file")
    write_whole(place, lambda partial: shutil.copyfile(source, partial))


def download(
    url: str, file: KnownFile, place: Path, owner: str, otherwise: str, on_progress: Progress
) -> None:
    """Bring a file from a server to its place.

    Args:
        url: Of the file.
        file: What it must be.
        place: Where it goes; ``NAME.part`` beside it until it is whole.
        owner: What it belongs to, for errors.
        otherwise: What else can be done, for errors: ``give it with --weights FILE``.
        on_progress: Called after each piece.

    Raises:
        CrosscueError: It cannot be had, or is another file.
        OutputError: The place cannot be written.
    """
    import pooch

    pooch.get_logger().setLevel("ERROR")
    partial = place.with_name(f"{place.name}.part")

    def downloader(url: str, output_file: str, _: Any) -> None:
        _resume(url, partial, file, lambda done: on_progress(file.name, done, file.size_bytes))
        partial.replace(output_file)

    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        pooch.retrieve(
            url,
            known_hash=f"sha256:{file.sha256}",
            fname=place.name,
            path=place.parent,
            downloader=downloader,
        )
    except ValueError:
        raise CrosscueError(
            f"{url}: what came is not {file.name} of {owner} (another SHA-256 than "
            f"{file.sha256}); nothing was kept; fetch it elsewhere and {otherwise}"
        ) from None
    except (HTTPError, URLError, TimeoutError, ConnectionError) as error:
        why = error.reason if isinstance(error, URLError) else error
        raise CrosscueError(
            f"{url}: not fetched: {one_line(Exception(str(why)), 160)}; run it again to go on, "
            f"fetch it elsewhere and {otherwise}"
        ) from None
    except OSError as error:
        raise cannot_write(place, error) from None


def _resume(url: str, partial: Path, file: KnownFile, on_bytes: Callable[[int], None]) -> None:
    """Append what is missing to ``partial``, never more than the file is large.

    Raises:
        OSError: The transfer or the disk failed; what has come stays.
    """
    have = partial.stat().st_size if partial.exists() else 0
    if have >= file.size_bytes:
        partial.unlink()
        have = 0
    try:
        answer = _opened(url, have, file.size_bytes)
    except HTTPError as error:
        if error.code != _RANGE_REFUSED or not have:
            raise
        partial.unlink()
        have, answer = 0, _opened(url, 0, file.size_bytes)
    with answer:
        if answer.status != _PARTIAL:
            have = 0
        with partial.open("ab" if have else "wb") as out:
            while have < file.size_bytes and (
                piece := answer.read(min(MIB // 4, file.size_bytes - have))
            ):
                out.write(piece)
                have += len(piece)
                on_bytes(have)
    if have < file.size_bytes:
        raise ConnectionError(f"cut after {have} of {file.size_bytes} bytes")


def _opened(url: str, start: int, size_bytes: int) -> HTTPResponse:
    """What the server sends from byte ``start`` on."""
    if not url.startswith(("http://", "https://")):
        raise URLError(f"expected http:// or https://, got {url[:40]!r}")
    headers = {"Range": f"bytes={start}-{size_bytes - 1}"} if start else {}
    answer: HTTPResponse = urlopen(Request(url, headers=headers), timeout=TIMEOUT_S)  # noqa: S310
    return answer
