"""What decides a run: its logs' identity and every setting, kept in the run folder as it begins.

``--resume`` goes on with a run only if both are the same; anything else would be destroyed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from crosscue.detectors.base import Choice
from crosscue.eval.runs.folder import INPUT, LOCK, MANIFEST, RunFolder, part_of
from crosscue.replay.base import (
    DEFAULT_LIMITS,
    Log,
    Selection,
    UsageError,
    json_tree,
    read_at_most,
    strict_json,
    versions,
)
from crosscue.replay.files.identity import identity_of_all, identity_of_log
from crosscue.replay.files.log_identity import Identity, as_row, of_row
from crosscue.replay.files.made_of import difference
from crosscue.replay.remote.logs import version_of
from crosscue.replay.vehicle.vehicle import Vehicle


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
        # Longer texts are no names, and some systems fail on them.
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


def identity_in(run: RunFolder) -> Identity | None:
    """Which logs the run is made of, where it says so."""
    there = _read(run)
    return None if there is None else of_row(there["identity"])
