"""Runs on an object store, found by one listing and read by byte ranges through fsspec."""

from __future__ import annotations

import hashlib
import posixpath
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import pyarrow as pa

from crosscue.eval.runs.folder import FAILURE, MANIFEST
from crosscue.replay.errors import LogError, UnreadableRunError, UsageError
from crosscue.replay.remote.logs import guarded, opened_store

from .local import BESIDE, CUT_SHORT, DEPTH, SCORE, FoundRun, Stamp, is_cut_short

if TYPE_CHECKING:
    import pyarrow.fs

T = TypeVar("T")
# Names of an object's modification time in various stores; the first that exists is used.
TIMES: Final = ("LastModified", "last_modified", "mtime", "updated", "created")
# Fields that change when an object is replaced.
VERSIONS: Final = ("ETag", "etag", "version_id", "generation", "md5Hash", *TIMES)

Infos = Mapping[str, Mapping[str, Any]]


class RemoteRuns:
    """The runs below a URL."""

    home: Final = None
    """Nothing is written to a store; its index is in the cache."""

    def __init__(self, url: str) -> None:
        """Open the store.

        Raises:
            UnreadableRunError: The protocol is unknown.
        """
        self.name, system, root = _as_run(lambda: opened_store(url))
        self._system: Final[Any] = system
        self._root: Final = root.rstrip("/")
        self._objects: dict[str, dict[str, Mapping[str, Any]]] = {}

    def find(self) -> Iterator[FoundRun]:
        """Yield every run folder, complete or interrupted.

        Raises:
            UnreadableRunError: The store cannot be listed.
        """
        # Some stores' libraries cache the listing of an earlier catalog.
        self._system.invalidate_cache()
        listed = _as_run(
            lambda: guarded(self.name, lambda: self._system.find(self._root, detail=True))
        )
        self._objects = _by_folder(self._root, listed)
        found: list[str] = []
        for folder in sorted(self._objects, key=lambda name: [*name.split("/")]):
            names = self._objects[folder]
            if (
                any(run == "." or folder.startswith(f"{run}/") for run in found[-1:])
                or folder.count("/") >= DEPTH
                or any(part.startswith(".") and part != "." for part in folder.split("/"))
            ):
                continue
            if MANIFEST in names:
                found.append(folder)
                yield FoundRun(folder, self._stamp(folder, MANIFEST), _time_ns(names[MANIFEST]))
            elif folder != "." and FAILURE in names:
                made_ns = _time_ns(names[FAILURE])
                yield FoundRun(folder, self._stamp(folder, FAILURE), made_ns, FAILURE)
            elif folder != "." and is_cut_short({*names}):
                found.append(folder)
                yield FoundRun(folder, CUT_SHORT, 0)

    def files(self, run: str) -> list[str]:
        """Return the names of a run's tables, then of its score's tables, tags and failure log."""
        own = [name for name in self._objects[run] if name.endswith(".parquet") or name in BESIDE]
        scored = self._objects.get(_joined(run, SCORE), {})
        return sorted(own) + [
            f"{SCORE}/{name}" for name in sorted(scored) if name.endswith(".parquet")
        ]

    def read(self, run: str, file: str) -> bytes:
        """Return the content of one of a run's files.

        Raises:
            OSError: The file cannot be read.
        """
        try:
            return bytes(guarded(self.name, lambda: self._system.cat_file(self.place(run, file))))
        except LogError as error:
            raise OSError(str(error)) from None

    def place(self, run: str, file: str) -> str:
        """Return the path of a file in ``filesystem``."""
        return f"{self._root}/{file}" if run == "." else f"{self._root}/{run}/{file}"

    def path(self, run: str) -> Path:
        """Refuse, because a run on a store has no local folder.

        Raises:
            UsageError: Always.
        """
        raise UsageError(
            f"{self.name}: runs on a store have no folder here; query the column run, or copy them"
        )

    @property
    def filesystem(self) -> pyarrow.fs.FileSystem:
        """Arrow's view of the store, which reads only the requested bytes, without read-ahead."""
        import pyarrow.fs

        class Ranged(pyarrow.fs.FSSpecHandler):  # type: ignore[misc]
            def open_input_file(self, path: str) -> pa.PythonFile:
                return pa.PythonFile(self.fs.open(path, mode="rb", cache_type="none"), mode="r")

        return pyarrow.fs.PyFileSystem(Ranged(self._system))

    def _stamp(self, run: str, head: str) -> Stamp:
        own = self._objects[run]
        others = {name: info for name, info in own.items() if name != head}
        scored = self._objects.get(_joined(run, SCORE), {})
        size = int(own[head].get("size") or 0)
        return (_digest({head: own[head]}), size, _digest(others), _digest(scored))


def _as_run(ask: Callable[[], T]) -> T:
    """Return a store's answer; its errors are those of a run."""
    try:
        return ask()
    except LogError as error:
        raise UnreadableRunError(error) from None


def _by_folder(root: str, listed: Infos) -> dict[str, dict[str, Mapping[str, Any]]]:
    folders: dict[str, dict[str, Mapping[str, Any]]] = defaultdict(dict)
    for address, info in listed.items():
        folder, _, name = posixpath.relpath(address, root).rpartition("/")
        folders[folder or "."][name] = info
    return folders


def _joined(run: str, folder: str) -> str:
    return folder if run == "." else f"{run}/{folder}"


def _digest(objects: Infos) -> int:
    digest = hashlib.sha256()
    for name, info in sorted(objects.items()):
        version = next((str(info[key]) for key in VERSIONS if info.get(key) is not None), "")
        digest.update(f"{name}\0{info.get('size')}\0{version}\0".encode())
    return int.from_bytes(digest.digest()[:7])


def _time_ns(info: Mapping[str, Any]) -> int:
    time = next((info[key] for key in TIMES if info.get(key) is not None), 0)
    if isinstance(time, datetime):
        return int((time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp() * 1e9)
    return int(time * 1e9) if isinstance(time, int | float) else 0
