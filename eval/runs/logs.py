"""A run's logs: what its manifest says of them, how they are found again, and whether they changed.

Paths in a run are relative to its folder; tables and accounts name a log by its file name alone, so
that they are the same bytes wherever run and logs lie. A log is opened again only if it is the one
that the run was made of, by its identity.

As a run begins, ``input.json`` keeps what decides it: the identity of its logs and every setting.
``--resume`` continues a run only if both are the same; anything else would be destroyed.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from crosscue.detectors.base import Choice
from crosscue.eval.runs.folder import INPUT, LOCK, MANIFEST, LogRow, RunFolder, part_of
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    CrosscueError,
    Log,
    Selection,
    UnreadableRunError,
    UsageError,
    is_remote,
    json_tree,
    origin,
    read_at_most,
    sha256_of,
    strict_json,
    versions,
)
from crosscue.replay.files.identity import identity_of, identity_of_all, identity_of_log
from crosscue.replay.files.log_identity import as_row, of_row
from crosscue.replay.files.made_of import SIMULATED, difference
from crosscue.replay.logs.opening import open_log
from crosscue.replay.remote.logs import RangedLog, version_of
from crosscue.replay.vehicle.roles import Role, role_of
from crosscue.replay.vehicle.vehicle import Vehicle

DEPTH: Final = 8
"""Of folders looked through for logs that have moved."""


def log_names(logs: Sequence[Log]) -> list[str]:
    """What the logs of a drive are called in its tables: file names, told apart where equal."""
    names = [place_name(origin(log)) for log in logs]
    count = Counter(names)
    return [
        name if count[name] == 1 else f"{name}#{identity_of_log(log).short}"
        for name, log in zip(names, logs, strict=True)
    ]


def place_name(place: Path | str) -> str:
    """The last part of a path or URL."""
    if isinstance(place, str) and is_remote(place):
        return place.rstrip("/").rpartition("/")[2]
    return Path(place).name or Path(place).resolve().name


def log_rows(logs: Sequence[Log], run: RunFolder) -> tuple[LogRow, ...]:
    """Name, place, format, identity, cameras and hashes of every log, for the manifest.

    A log that is read by ranges is known by its identity alone: a hash would fetch all of it.
    """
    return tuple(
        LogRow(
            name=name,
            path=place if isinstance(place := origin(log), str) else relative(place, run),
            format=log.format,
            identity=identity_of_log(log),
            cameras=tuple(sorted(o.name for o in log.topics if role_of(o) is Role.CAMERA)),
            sha256={} if isinstance(log, RangedLog) else sha256_of(log.path),
            is_simulated=is_simulated(log),
        )
        for name, log in zip(log_names(logs), logs, strict=True)
    )


def is_simulated(log: Log) -> bool:
    """Whether ``simulate`` made a log, by the file that it writes beside one."""
    place = origin(log)
    return isinstance(place, Path) and (place.resolve().parent / SIMULATED).is_file()


def relative(place: Path, run: RunFolder) -> str:
    """A path as a run's manifest holds it: from the run's folder."""
    whole = place.absolute()
    return os.path.relpath(whole.parent.resolve() / whole.name, (run.home or run.path).resolve())


def place_of(run: RunFolder, said: LogRow) -> Path | str:
    """Where a log of a run lies now: a URL, or a path whose content is what the run was made of.

    Args:
        run: The run; its ``logs`` folder is where its logs have moved to, if anybody said so.
        said: The log's row in the manifest.

    Raises:
        RunError: It is gone, or another log is there.
    """
    where, wanted = said.path, said.identity
    if is_remote(where):
        places: list[Path | str] = [where]
    elif run.logs is None:
        places = [(run.home or run.path).resolve() / where]
    else:
        places = list(_moved(run.logs, Path(where)))
    others = []
    for place in places:
        if isinstance(place, Path) and not place.exists():
            continue
        try:
            found = identity_of(place)
        except CrosscueError as error:
            raise UnreadableRunError(f"{run.path}: its log cannot be examined: {error}") from None
        if found.digest == wanted.digest:
            return place if isinstance(place, str) else Path(os.path.normpath(place))
        others.append((place, found))
    if others:
        place, found = others[0]
        raise UnreadableRunError(
            f"{run.path}: its log {place} has changed since: {found} there, {wanted} wanted; "
            "--logs DIR says where that is, or replay again"
        )
    gone = f"{places[0]} is gone" if run.logs is None else f"{wanted} is not in {run.logs}"
    raise UnreadableRunError(
        f"{run.path}: its log {gone}; say where it is with --logs DIR, or replay again"
    )


def _moved(folder: Path, where: Path) -> Iterator[Path]:
    """Places below ``folder`` where a log of this name may have gone, the likeliest first."""
    parts = [part for part in where.parts if part != ".."]
    for count in range(len(parts), 0, -1):
        yield folder.joinpath(*parts[-count:])
    for place, folders, names in os.walk(folder):
        depth = len(Path(place).relative_to(folder).parts)
        folders[:] = sorted(n for n in folders if not n.startswith(".")) if depth < DEPTH else []
        if where.name in names or where.name in folders:
            yield Path(place, where.name)


def reopened(run: RunFolder, said: LogRow) -> Log:
    """A log of a run, open.

    Raises:
        RunError: As ``place_of``.
        LogError: It cannot be opened.
    """
    return open_log(place_of(run, said), run.limits)


def input_of(
    logs: Sequence[Log],
    vehicle: Vehicle,
    selection: Selection,
    choices: Sequence[Choice],
    draw: int,
    landmarks: Path | None,
) -> dict[str, object]:
    """The content of ``input.json``.

    Args:
        logs: All logs of the drive, open.
        vehicle: What the vehicle file says.
        selection: Which part of the logs.
        choices: Detectors, in order.
        draw: How many pictures are drawn.
        landmarks: The database that frames are compared with.
    """
    settings = {
        "vehicle": vehicle.model_dump(mode="json"),
        "selection": part_of(selection).as_json(),
        "detectors": [asdict(choice) for choice in choices],
        "draw": draw,
        "landmarks": None if landmarks is None else str(landmarks.resolve()),
        "versions": versions(),
    }
    identity = identity_of_all([identity_of_log(log) for log in logs])
    return {
        "identity": as_row(identity),
        "settings": json_tree(strict_json({**settings, "files": files_named_in(settings)})),
    }


def refuse_another(run: RunFolder, mine: Mapping[str, Any]) -> None:
    """Let ``--resume`` go on with a run of this very input, or with an empty folder.

    Raises:
        UsageError: The folder holds another run, or one of which nothing is known.
        RunError: It holds a run of another version of crosscue.
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
    different = difference(there["settings"], mine["settings"])
    if different is not None:
        raise UsageError(
            f"{run.path}: holds a run of {theirs} with other settings ({different}), which "
            f"--resume of {ours} would destroy; give another folder or --overwrite"
        )


def files_named_in(settings: object) -> dict[str, str]:
    """Files that settings name, such as DBC files and model cards, with size and time of each.

    A name alone would not show that a file was edited.
    """
    if isinstance(settings, str):
        # Longer texts are not names, and some systems fail on them.
        is_file = "/" in settings and len(settings) < 4096 and Path(settings).is_file()
        return {settings: version_of(settings)} if is_file else {}
    if isinstance(settings, Mapping):
        settings = list(settings.values())
    if isinstance(settings, list | tuple):
        return {name: of for one in settings for name, of in files_named_in(one).items()}
    return {}


def _read(run: RunFolder) -> Mapping[str, Any] | None:
    """What the folder's run is made of; None where nothing believable says so."""
    try:
        content = read_at_most(run.file(INPUT), DEFAULT_LIMITS.record_bytes)
        found = json_tree(content or b"")
        of_row(found["identity"])
        return found if isinstance(found["settings"], dict) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def settings_changed(run: RunFolder, vehicle: Vehicle) -> dict[str, Any] | None:
    """``input.json`` with other vehicle settings, after which ``estimate`` estimates again."""
    there = _read(run)
    if there is None:
        return None
    settings = {**there["settings"], "vehicle": vehicle.model_dump(mode="json")}
    settings.pop("files", None)
    settings["files"] = files_named_in(settings)
    return {**there, "settings": settings}
