"""The files that crosscue wrote into a folder, which alone ``--overwrite`` may delete.

Those of a run are known from its stage (``folder.own_files``); an export and a site list theirs.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final, TypeAlias

from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import json_tree, strict_json
from crosscue.replay.files.whole_file import cannot_write, write_text
from crosscue.replay.safe_text import visible

MAX_LIST_BYTES: Final = 256 << 20
# Max number of files named in an error.
NAMED: Final = 10

# Whether crosscue wrote a file, given its path in the folder, with slashes.
IsOurs: TypeAlias = Callable[[str], bool]


def of_list(marker: Path) -> IsOurs:
    """Return which files of a folder are those that its ``marker`` lists; see ``write_marker``."""
    try:
        names = frozenset(json_tree(door.read(marker, MAX_LIST_BYTES))["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return lambda name: False
    return lambda name: name in names or name == marker.name


def write_marker(marker: Path, content: dict[str, object]) -> None:
    """Write the file that marks a folder as ours, with a list of all files that are there.

    Raises:
        OutputError: It cannot be written.
    """
    tree = {**content, "files": sorted(files_in(marker.parent))}
    write_text(marker, strict_json(tree) + "\n")


@contextmanager
def new_folder(folder: Path, marker: str) -> Iterator[Path]:
    """Yield an empty folder, which takes the place of ``folder`` when it is complete.

    Call ``check_place`` first. Files of ours, which the marker lists, are deleted then.

    Raises:
        OutputError: Something else is there, or it cannot be written.
    """
    made = folder.with_name(f".{folder.name}.partial")
    try:
        shutil.rmtree(made, ignore_errors=True)
        made.mkdir(parents=True)
        yield made
        if folder.is_dir():
            remove(folder, of_list(folder / marker))
            folder.rmdir()
        made.rename(folder)
    except OSError as error:
        raise cannot_write(Path(error.filename or folder), error) from None
    finally:
        shutil.rmtree(made, ignore_errors=True)


def check_place(folder: Path, marker: str, *, overwrite: bool) -> None:
    """Refuse an output folder that holds anything, or, to be overwritten, what is not ours.

    Raises:
        OutputError: The folder is a file, or holds files and may not be overwritten.
        UsageError: It holds files that its marker does not list.
    """
    try:
        there = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    except OSError as error:
        raise cannot_write(folder, error) from None
    if there and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; give another folder")
    if there and not overwrite:
        raise OutputError(f"{folder}: holds files already; give another folder or --overwrite")
    if there:
        refuse_others(folder, of_list(folder / marker))


def files_in(folder: Path) -> Iterator[str]:
    """Yield the path of every file and link below a folder, relative to it, with slashes.

    Raises:
        OSError: A folder cannot be listed.
    """

    def fail(error: OSError) -> None:
        raise error

    for place, folders, names in os.walk(folder, onerror=fail):
        links = [name for name in folders if os.path.islink(os.path.join(place, name))]  # noqa: PTH114, PTH118
        for name in [*names, *links]:
            yield Path(place, name).relative_to(folder).as_posix()


def refuse_others(folder: Path, is_ours: IsOurs) -> None:
    """Refuse to overwrite a folder that holds files of the user.

    Raises:
        UsageError: It does; the message names them.
        OSError: A folder cannot be listed.
    """
    others = sorted(name for name in files_in(folder) if not is_ours(name))
    if others:
        more = f" and {len(others) - NAMED:,} more" if len(others) > NAMED else ""
        raise UsageError(
            f"{folder}: holds files that are not of a result of this crosscue, so nothing was "
            f"overwritten ({visible(', '.join(others[:NAMED]))}{more}); move them, or give another "
            "folder"
        )


def remove(folder: Path, is_ours: IsOurs) -> None:
    """Delete the files of ours, and folders that are empty then; links are not followed.

    Raises:
        OSError: A file cannot be deleted.
    """
    for name in list(files_in(folder)):
        if is_ours(name):
            (folder / name).unlink()
    for place, _, _ in os.walk(folder, topdown=False):
        if Path(place) != folder:
            with suppress(OSError):
                Path(place).rmdir()
