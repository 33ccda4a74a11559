"""Download or copy a file with a known SHA-256, which is checked before the file is kept.

An interrupted transfer continues where it stopped. The incomplete file is stored as ``NAME.part``
in the same folder.
"""

import contextlib
import os
import shutil
from collections.abc import Callable
from http.client import HTTPResponse
from pathlib import Path
from typing import Any, Final, Protocol
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from crosscue.replay.errors import CrosscueError, UsageError, one_line
from crosscue.replay.limits import MIB

from . import door
from .whole_file import cannot_write, file_sha256, write_whole

TIMEOUT_S: Final = 30.0
_PARTIAL: Final = 206
_RANGE_REFUSED: Final = 416

# Called with a file's name, the number of bytes received, and their total number.
Progress = Callable[[str, int, int], None]


class KnownFile(Protocol):
    """A file with a known name, size and hash."""

    @property
    def name(self) -> str:
        """Name of the file."""

    @property
    def size_bytes(self) -> int:
        """Size of the file."""

    @property
    def sha256(self) -> str:
        """SHA-256 in hexadecimal."""


def is_there(file: KnownFile, place: Path) -> bool:
    """Return whether ``place`` holds this file."""
    return (
        place.is_file()
        and place.stat().st_size == file.size_bytes
        and file_sha256(place) == file.sha256
    )


def take(source: Path, file: KnownFile, place: Path, owner: str) -> None:
    """Copy a local file to its place.

    Args:
        source: Path of the file.
        file: Expected name, size and hash.
        place: Path of the copy.
        owner: Owner of the file, for errors: ``model yolox-nano``.

    Raises:
        UsageError: The file does not exist, or is a different file.
        OutputError: The place cannot be written.
    """
    try:
        found = file_sha256(source)
    except OSError as error:
        raise UsageError(f"{source}: {error.strerror}; expected {file.name} of {owner}") from None
    if found != file.sha256:
        raise UsageError(f"{source}: SHA-256 {found}; {owner} requires the file {file.sha256}")
    write_whole(place, lambda partial: shutil.copyfile(source, partial))


def download(
    url: str, file: KnownFile, place: Path, owner: str, otherwise: str, on_progress: Progress
) -> None:
    """Download a file to its place.

    Args:
        url: URL of the file.
        file: Expected name, size and hash.
        place: Path of the file; it is ``NAME.part`` in the same folder until it is complete.
        owner: Owner of the file, for errors.
        otherwise: Alternative remedy, for errors: ``give it with --from FILE``.
        on_progress: Called after each chunk.

    Raises:
        CrosscueError: The download failed, or it is a different file.
        OutputError: The place cannot be written.
    """
    import pooch

    pooch.get_logger().setLevel("ERROR")
    partial = place.with_name(f"{place.name}.part")

    def downloader(url: str, output_file: str, _: Any) -> None:
        _resume(url, partial, file, lambda done: on_progress(file.name, done, file.size_bytes))
        partial.replace(output_file)

    made = [one for one in (place.parent, *place.parent.parents) if not one.exists()]
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
            f"{url}: the download is not {file.name} of {owner} (expected SHA-256 "
            f"{file.sha256}); it was deleted; fetch the file elsewhere and {otherwise}"
        ) from None
    except (HTTPError, URLError, TimeoutError, ConnectionError) as error:
        why = error.reason if isinstance(error, URLError) else error
        raise CrosscueError(
            f"{url}: not fetched: {one_line(Exception(str(why)), 160)}; run it again to continue, "
            f"or fetch the file elsewhere and {otherwise}"
        ) from None
    except OSError as error:
        raise cannot_write(place, error) from None
    finally:
        with contextlib.suppress(OSError):
            # Folders made for a file of which nothing came are empty.
            for folder in made:
                folder.rmdir()


def _resume(url: str, partial: Path, file: KnownFile, on_bytes: Callable[[int], None]) -> None:
    """Append the missing bytes to ``partial``, never beyond the size of the file.

    Raises:
        OSError: The transfer or the disk failed; the received bytes are kept.
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
        how = os.O_WRONLY | os.O_CREAT | (os.O_APPEND if have else os.O_TRUNC)
        with os.fdopen(door.opened(partial, how), "wb") as out:
            while have < file.size_bytes and (
                piece := answer.read(min(MIB // 4, file.size_bytes - have))
            ):
                out.write(piece)
                have += len(piece)
                on_bytes(have)
    if have < file.size_bytes:
        raise ConnectionError(f"interrupted after {have} of {file.size_bytes} bytes")


def _opened(url: str, start: int, size_bytes: int) -> HTTPResponse:
    """Open the server's response from byte ``start`` on."""
    if not url.startswith(("http://", "https://")):
        raise URLError(f"expected http:// or https://, got {url[:40]!r}")
    headers = {"Range": f"bytes={start}-{size_bytes - 1}"} if start else {}
    answer: HTTPResponse = urlopen(Request(url, headers=headers), timeout=TIMEOUT_S)  # noqa: S310
    return answer
