"""Weights from their publisher, a mirror, a folder or a file, checked before they are kept.

A transfer that was cut goes on where it stopped: what has come so far lies beside the place of the
whole file, as ``NAME.part``. ``$CROSSCUE_MODEL_MIRROR`` names a server that is asked instead of the
publisher, for ``MIRROR/NAME``; ``$CROSSCUE_DATA`` a folder whose ``weights`` are looked through.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from http.client import HTTPResponse
from pathlib import Path
from typing import Any, Final
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

from .card import ModelCard, WeightFile
from .entries import entry, place_of

MIRROR: Final = "CROSSCUE_MODEL_MIRROR"
DATA: Final = "CROSSCUE_DATA"
TIMEOUT_S: Final = 30.0
_PARTIAL: Final = 206
_RANGE_REFUSED: Final = 416

Progress = Callable[[str, int, int], None]
"""Reported a file's name, the bytes that have come, and how many there are."""


@dataclass(frozen=True, slots=True)
class Fetched:
    """Where a model's file is now, and where it came from."""

    path: Path
    came_from: str


def fetch(
    name: str,
    given: Path | None = None,
    on_progress: Progress = lambda name, done, total: None,
    environment: Mapping[str, str] = os.environ,
) -> list[Fetched]:
    """Bring all files of a catalog's model into the cache.

    Args:
        name: As ``crosscue model list`` prints it.
        given: A file, or a folder with the files, to take them from; no network is used.
        on_progress: Reported of each piece.
        environment: For the variables named above.

    Raises:
        UsageError: No such model, or ``given`` is not there or another file.
        CrosscueError: It cannot be had, or is not the file that the catalog means.
        OutputError: The cache cannot be written.
    """
    card = entry(name)
    if not card.files:
        raise UsageError(f"model {name}: comes with crosscue; there is nothing to fetch")
    return [_fetched(name, card, file, given, on_progress, environment) for file in card.files]


def _fetched(
    name: str,
    card: ModelCard,
    file: WeightFile,
    given: Path | None,
    on_progress: Progress,
    environment: Mapping[str, str],
) -> Fetched:
    place = place_of(card, file)
    if place.exists() and file_sha256(place) == file.sha256:
        return Fetched(place, "the cache")
    if given is not None:
        source = given / file.name if given.is_dir() else given
        _take(source, file, place, name)
        return Fetched(place, str(source))
    for source in _at_hand(file, environment):
        if file_sha256(source) == file.sha256:
            _take(source, file, place, name)
            return Fetched(place, str(source))
    mirror = environment.get(MIRROR)
    url = f"{mirror.rstrip('/')}/{file.name}" if mirror else file.url
    _download(url, file, place, name, on_progress)
    return Fetched(place, url)


def _at_hand(file: WeightFile, environment: Mapping[str, str]) -> Iterator[Path]:
    """Files of that name and size below ``$CROSSCUE_DATA/weights``."""
    folder = environment.get(DATA)
    if folder:
        for path in sorted(Path(folder, "weights").glob(f"*/{file.name}")):
            if path.stat().st_size == file.size_bytes:
                yield path


def _take(source: Path, file: WeightFile, place: Path, name: str) -> None:
    try:
        found = file_sha256(source)
    except OSError as error:
        raise UsageError(f"{source}: {error.strerror}; give {file.name} of model {name}") from None
    if found != file.sha256:
        raise UsageError(
            f"{source}: SHA-256 {found}, model {name} needs {file.sha256}; give that file"
        )
    write_whole(place, lambda partial: shutil.copyfile(source, partial))


def _download(url: str, file: WeightFile, place: Path, name: str, on_progress: Progress) -> None:
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
            f"{url}: what came is not {file.name} of model {name} (another SHA-256 than "
            f"{file.sha256}); nothing was kept; fetch it elsewhere and give it with --weights FILE"
        ) from None
    except (HTTPError, URLError, TimeoutError, ConnectionError) as error:
        why = error.reason if isinstance(error, URLError) else error
        raise CrosscueError(
            f"{url}: not fetched: {one_line(Exception(str(why)), 160)}; run it again to go on, "
            f"fetch it elsewhere and give it with --weights FILE, or name a mirror in {MIRROR}"
        ) from None
    except OSError as error:
        raise cannot_write(place, error) from None


def _resume(url: str, partial: Path, file: WeightFile, on_bytes: Callable[[int], None]) -> None:
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
