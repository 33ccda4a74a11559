"""The logs of a run: their rows in the manifest, finding them again, and detecting changes.

Paths in a run are relative to its folder. Tables and accounts name a log by its file name alone, so
that they are the same bytes wherever run and logs are stored. A log is opened again only if its
identity is that of the log from which the run was made.

At the start of a run, ``input.json`` records what determines it: the identity of its logs and every
setting. ``--resume`` continues a run only if both are the same, because it would destroy any other.
"""

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import INPUT, LOCK, MANIFEST, RunFolder
from crosscue.replay.base import Log, origin
from crosscue.replay.errors import CrosscueError, UnreadableRunError, UsageError
from crosscue.replay.files import door
from crosscue.replay.files.identity import identity_of_all, identity_of_log, log_identity
from crosscue.replay.files.log_identity import as_row, of_row
from crosscue.replay.files.made_of import SIMULATED, first_difference
from crosscue.replay.files.tree_text import json_tree, spelled, strict_json, unspelled
from crosscue.replay.files.whole_file import file_sha256, sha256_of
from crosscue.replay.logs.opening import open_log
from crosscue.replay.remote.address import LogAddress, is_remote
from crosscue.replay.remote.logs import RangedLog
from crosscue.replay.vehicle.roles import Role, role_of
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.versions import versions

from .manifest import LogRow, selection_record

# Max depth of folders searched for logs that have moved.
DEPTH: Final = 8


def log_names(logs: Sequence[Log]) -> list[str]:
    """Return the names of a drive's logs in its tables: file names, made unique where equal."""
    names = [place_name(origin(log)) for log in logs]
    count = Counter(names)
    return [
        name if count[name] == 1 else f"{name}#{identity_of_log(log).short}"
        for name, log in zip(names, logs, strict=True)
    ]


def place_name(place: Path | str) -> str:
    """Return the last part of a path or URL, as it is spelled in a run."""
    if isinstance(place, str) and is_remote(place):
        return LogAddress(place).name
    return spelled(Path(place).name or Path(place).resolve().name)


def log_rows(logs: Sequence[Log], run: RunFolder) -> tuple[LogRow, ...]:
    """Return the row of every log for the manifest.

    A log that is read by ranges has an identity but no hash, because hashing would fetch all of it.
    """
    return tuple(
        LogRow(
            name=name,
            path=place if isinstance(place := origin(log), str) else run.relative(place),
            format=log.format,
            identity=identity_of_log(log),
            cameras=tuple(sorted(o.name for o in log.topics if role_of(o) is Role.CAMERA)),
            sha256={} if isinstance(log, RangedLog) else sha256_of(log.path),
            is_simulated=is_simulated(log),
        )
        for name, log in zip(log_names(logs), logs, strict=True)
    )


def is_simulated(log: Log) -> bool:
    """Return whether ``simulate`` made a log, by the file that it writes next to it."""
    place = origin(log)
    return isinstance(place, Path) and (place.resolve().parent / SIMULATED).is_file()


def log_location(run: RunFolder, row: LogRow) -> Path | str:
    """Return the present location of a run's log, a URL or a path, after checking its identity.

    Args:
        run: The run; its ``logs`` folder is searched if it is set.
        row: The log's row in the manifest.

    Raises:
        RunError: The log does not exist, or its content has changed.
    """
    where, wanted = row.path, row.identity
    if run.logs is not None:
        places: list[Path | str] = [*_moved(run.logs, Path(unspelled(where)))]
    else:
        places = [where if is_remote(where) else run.absolute(where)]
    others = []
    for place in places:
        if isinstance(place, Path) and not place.exists():
            continue
        try:
            found = log_identity(place)
        except CrosscueError as error:
            raise UnreadableRunError(
                f"{run.path}: its log cannot be examined: {error}; a run keeps no user, password "
                "or query of a URL: name the folder of a copy with --logs DIR, or replay again"
                if isinstance(place, str)
                else f"{run.path}: its log cannot be examined: {error}"
            ) from None
        if found.digest == wanted.digest:
            return place if isinstance(place, str) else Path(os.path.normpath(place))
        others.append((place, found))
    if others:
        place, found = others[0]
        raise UnreadableRunError(
            f"{run.path}: its log {place} has changed since: expected {wanted}, found {found}; "
            "say where the original is with --logs DIR, or replay again"
        )
    gone = f"{places[0]} is gone" if run.logs is None else f"{wanted} is not in {run.logs}"
    raise UnreadableRunError(
        f"{run.path}: its log {gone}; name its folder with --logs DIR, or replay again"
    )


def _moved(folder: Path, where: Path) -> Iterator[Path]:
    """Yield possible paths of a moved log below ``folder``, the most likely first."""
    parts = [part for part in where.parts if part != ".."]
    for count in range(len(parts), 0, -1):
        yield folder.joinpath(*parts[-count:])
    for place, folders, names in os.walk(folder):
        depth = len(Path(place).relative_to(folder).parts)
        folders[:] = sorted(n for n in folders if not n.startswith(".")) if depth < DEPTH else []
        if where.name in names or where.name in folders:
            yield Path(place, where.name)


def reopened(run: RunFolder, row: LogRow) -> Log:
    """Open a log of a run.

    Raises:
        RunError: As for ``log_location``.
        LogError: The log cannot be opened.
    """
    return open_log(log_location(run, row), run.limits)


def input_of(run: RunFolder, drive: Drive, options: Mapping[str, object]) -> dict[str, object]:
    """Return the content of ``input.json``: all that determines a run.

    Args:
        run: The run.
        drive: The drive.
        options: Options of the stages, by name, as JSON values.
    """
    settings = {
        "vehicle": drive.vehicle.model_dump(mode="json"),
        "selection": selection_record(drive.selection).as_json(),
        **options,
        "versions": versions(),
    }
    identity = identity_of_all([identity_of_log(log) for log in drive.logs])
    return {"identity": as_row(identity), "settings": _stored(run, settings)}


def _stored(run: RunFolder, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as JSON values, with the hashes of the files that they name, as ``files``.

    Paths of files are relative to the run's folder.
    """
    names = {name: run.relative(name) for name in files_named_in(settings)}
    files = {name: file_sha256(Path(name)) for name in names}
    stored: dict[str, Any] = json_tree(strict_json(_renamed({**settings, "files": files}, names)))
    return stored


def _renamed(tree: object, names: Mapping[str, str]) -> Any:
    if isinstance(tree, Mapping):
        return {names.get(key, key): _renamed(value, names) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [_renamed(one, names) for one in tree]
    return names.get(tree, tree) if isinstance(tree, str) else tree


def refuse_other_input(run: RunFolder, mine: Mapping[str, Any]) -> None:
    """Refuse to resume a run of any other input; an empty folder is accepted.

    Raises:
        UsageError: The folder holds another run, or a run of unknown input.
        RunError: The folder holds a run of another version of crosscue.
    """
    there = _read(run)
    if there is None:
        if run.file(MANIFEST).exists():
            run.manifest()
        if any(entry.name != LOCK for entry in run.path.iterdir()):
            raise UsageError(
                f"{run.path}: holds a run without {INPUT}, so its input is unknown; --resume "
                "would destroy it: give another folder or --overwrite"
            )
        return
    theirs, ours = of_row(there["identity"]), of_row(mine["identity"])
    if theirs.digest != ours.digest:
        raise UsageError(
            f"{run.path}: holds a run of {theirs}, not of {ours}: --resume would destroy it; give "
            "another folder or --overwrite"
        )
    different = first_difference(there["settings"], mine["settings"])
    if different is not None:
        raise UsageError(
            f"{run.path}: holds a run of {theirs} with other settings ({different}), which "
            f"--resume of {ours} would destroy; give another folder or --overwrite"
        )


def files_named_in(settings: object) -> dict[str, str]:
    """Return the files that settings name, such as DBC files and model cards, with size and time.

    The name alone would not show that a file was edited.
    """
    if isinstance(settings, str):
        # Longer texts are not file names, and some systems fail on them.
        if "/" not in settings or len(settings) >= 4096 or not Path(settings).is_file():
            return {}
        found = Path(settings).stat()
        return {settings: f"{found.st_size} {found.st_mtime_ns}"}
    if isinstance(settings, Mapping):
        settings = list(settings.values())
    if isinstance(settings, list | tuple):
        return {name: of for one in settings for name, of in files_named_in(one).items()}
    return {}


def _read(run: RunFolder) -> Mapping[str, Any] | None:
    """Return the content of ``input.json``; None if it is missing or damaged."""
    try:
        found = json_tree(door.read(run.file(INPUT)))
        of_row(found["identity"])
        return found if isinstance(found["settings"], dict) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def settings_changed(run: RunFolder, vehicle: Vehicle) -> dict[str, Any] | None:
    """Return ``input.json`` with the settings of a repeated estimate; None if it is missing."""
    there = _read(run)
    if there is None:
        return None
    settings = dict(there["settings"])
    names = {name: os.path.normpath(run.absolute(name)) for name in settings.pop("files", ())}
    settings = _renamed(settings, names) | {"vehicle": vehicle.model_dump(mode="json")}
    return {**there, "settings": _stored(run, settings)}
