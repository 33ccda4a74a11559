"""The rows of one run in a catalog, from its manifest, tags and score."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final, Literal, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError

from crosscue.eval.runs.folder import (
    FORMAT_VERSION,
    MANIFEST,
    Account,
    LogRow,
    PoseSummary,
    SceneSummary,
    TimeSegments,
)
from crosscue.replay.base import strict_json
from crosscue.replay.files.identity import identity_of_all

Row: TypeAlias = dict[str, Any]
M = TypeVar("M", bound=BaseModel)
NOT_A_RUN: Final = frozenset({"merged", "decode"})
"""Stages of folders that hold no run of their own."""


class _Head(BaseModel):
    format_version: Any = None
    stage: str = ""


class _Timings(BaseModel):
    seconds: float


class _Detector(BaseModel):
    name: str
    identity: str


class _Counts(BaseModel):
    frames: int


class _Detect(BaseModel):
    detectors: tuple[dict[str, Any], ...]
    counts: _Counts


class _Manifest(BaseModel):
    """The parts of a run's manifest that are columns; the settings stay as they are.

    Checking the settings, too, takes ten times as long, and there may be 100,000.
    """

    stage: Literal["detect", "estimate"]
    versions: dict[str, str]
    logs: tuple[LogRow, ...]
    selection: dict[str, Any]
    settings: dict[str, Any]
    time: TimeSegments
    account: Account
    notices: tuple[str, ...]
    timings: _Timings
    pose: PoseSummary | None = None
    scene: SceneSummary | None = None
    detect: _Detect | None = None


@dataclass(slots=True)
class RunRows:
    """What one run adds to each table of the index."""

    run: Row
    approaches: list[Row] = field(default_factory=list)
    dropped: list[Row] = field(default_factory=list)


def rows_of(
    run: str,
    name: str,
    manifest: bytes,
    made_ns: int,
    files: Sequence[str],
    tags: dict[str, str],
    judged: Callable[[], list[Row]],
) -> RunRows | None:
    """The rows of one run; None for a folder that was merged of runs, or holds a decoded log.

    Args:
        run: Its path in the catalog.
        name: Of its folder.
        manifest: Content of ``manifest.json``.
        made_ns: When that was written.
        files: Parquet files, from the run's folder.
        tags: See ``crosscue tag``.
        judged: Reads the rows of its approaches in its score.

    Raises:
        ValueError: The manifest is damaged or of another version.
    """
    head = _read(_Head, manifest)
    if head.format_version != FORMAT_VERSION:
        raise ValueError(
            f"{MANIFEST}: format {head.format_version!r}, this crosscue reads {FORMAT_VERSION}; "
            "replay again"
        )
    if head.stage in NOT_A_RUN:
        return None
    found = _read(_Manifest, manifest)
    detect = found.detect
    if found.stage == "detect":
        detect = _read(_Detect, manifest)
    results = judged() if "score/approaches.parquet" in files else []
    approaches = _approaches(run, found, results, tags)
    dropped = _dropped(run, found.account)
    lines = [one for _, _, one in found.account.lines()]
    segments = found.time.segments
    identity = identity_of_all([log.identity for log in found.logs]) if found.logs else None
    row: Row = {
        "run": run,
        "name": name,
        "outcome": "whole" if found.account.is_whole else "losses",
        "exit_status": 0 if found.account.is_whole else 3,
        "stage": found.stage,
        "identity": None if identity is None else identity.digest,
        "logs": [log.name for log in found.logs],
        "is_simulated": any(log.is_simulated for log in found.logs),
        "vehicle": found.settings.get("name"),
        "crosscue": found.versions.get("crosscue"),
        "crosscue_commit": found.versions.get("crosscue commit"),
        "models": [
            {"name": one["name"], "identity": one["identity"]}
            for one in (() if detect is None else detect.detectors)
        ],
        "settings": strict_json(found.settings),
        "settings_sha256": _settings_sha256(found, detect),
        "tags": list(tags.items()),
        "conditions": sorted({tag for one in results for tag in one["conditions"]}),
        "start_ns": segments[0].start_ns if segments else None,
        "end_ns": segments[-1].end_ns if segments else None,
        "made_at": datetime.fromtimestamp(made_ns / 1e9, UTC).replace(tzinfo=None),
        "seconds": found.timings.seconds,
        "travelled_m": None if found.pose is None else found.pose.travelled_m,
        "frames": None if detect is None else detect.counts.frames,
        "approaches": 0 if found.scene is None else len(found.scene.approaches),
        "is_scored": "score/by_drive.parquet" in files,
        "rows_in": sum(one.entered for one in lines),
        "rows_used": sum(one.used for one in lines),
        "rows_skipped": sum(n for one in lines for n in one.skipped.values()),
        "rows_dropped": sum(n for one in lines for n in one.dropped.values()),
        "notices": list(found.notices),
        "tables": list(files),
    }
    return RunRows(row, approaches, dropped)


def _read(model: type[M], content: bytes) -> M:
    try:
        return model.model_validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        where = f"{place}: " if place else ""
        raise ValueError(
            f"{MANIFEST}: unreadable ({where}{first['msg'].lower()}); replay again"
        ) from None


def _settings_sha256(found: _Manifest, detect: _Detect | None) -> str:
    """As in the manifest of merged runs: of settings, detectors and the part of the logs."""
    detectors = None if detect is None else list(detect.detectors)
    made_with = [found.settings, detectors, found.selection]
    return hashlib.sha256(strict_json(made_with).encode()).hexdigest()


def _approaches(run: str, found: _Manifest, results: list[Row], tags: dict[str, str]) -> list[Row]:
    """Those of the run, each with its result where it was scored; then those it has none for."""
    own = () if found.scene is None else found.scene.approaches
    by_number = {one["approach"]: one for one in results if one["approach"] is not None}
    shared = {"run": run, "tags": list(tags.items())}
    seen = [
        {
            **by_number.get(one.number, {}),
            **shared,
            "approach": one.number,
            "start_ns": one.start_ns,
            "end_ns": one.end_ns,
            "detected_ns": one.detected_ns,
            "detected_range_m": one.detected_m,
            "reference": one.reference,
            "probabilities": list(one.probabilities.items()),
            "not_seen": list(one.not_seen),
        }
        for one in own
    ]
    numbers = {one.number for one in own}
    return seen + [{**one, **shared} for one in results if one["approach"] not in numbers]


def _dropped(run: str, account: Account) -> list[Row]:
    rows = []
    for stage, stream, line in account.lines():
        counts: list[tuple[str, int | None]] = [*line.dropped.items()]
        counts += [(reason, None) for reason in line.unknown]
        rows += [
            {"run": run, "stage": stage, "stream": stream, "reason": reason, "rows": count}
            for reason, count in counts
        ]
    return rows
