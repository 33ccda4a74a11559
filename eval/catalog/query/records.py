"""Rows of one run in a catalog, read from its manifest, tags and score."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, Final, Literal, TypeAlias

import pyarrow as pa
from pydantic import BaseModel, Field, ValidationError

from crosscue.eval.runs.account import Account
from crosscue.eval.runs.folder import FAILURE, MANIFEST, TAGS, TIMINGS
from crosscue.eval.runs.manifest import (
    FORMAT_VERSION,
    LogRow,
    PoseSummary,
    SceneSummary,
    TimeSegments,
    Timings,
)
from crosscue.eval.runs.settings_hash import text_and_sha256
from crosscue.eval.runs.tags import parse_tags
from crosscue.replay.errors import one_line
from crosscue.replay.files.identity import identity_of_all

from .local import BESIDE, FoundRun

Row: TypeAlias = dict[str, Any]
JUDGED: Final = "score/approaches.parquet"
_EPOCH: Final = datetime(1970, 1, 1)
# Stages of folders that are not runs of a single drive.
NOT_A_RUN: Final = frozenset({"merged", "decode"})


class _Head(BaseModel):
    format_version: Any = None
    stage: str = ""


class _Detect(BaseModel):
    detectors: tuple[dict[str, Any], ...]
    counts: dict[str, Any]


class _Manifest(BaseModel):
    """The parts of a run's manifest that become columns; the settings are not validated.

    Validating the settings takes ten times as long, and there may be 100,000 runs.
    """

    format_version: Literal[8]
    stage: Literal["detect", "estimate"]
    versions: dict[str, str]
    logs: tuple[LogRow, ...]
    selection: dict[str, Any]
    settings: dict[str, Any]
    time: TimeSegments
    account: Account
    notices: tuple[str, ...]
    pose: PoseSummary | None = None
    scene: SceneSummary | None = None
    detect: _Detect | None = None
    detectors: tuple[dict[str, Any], ...] = ()
    counts: dict[str, Any] = Field(default_factory=dict)


@dataclass(slots=True)
class RunRows:
    """Rows of one run in each table of the index."""

    run: Row
    approaches: list[Row] = field(default_factory=list)
    dropped: list[Row] = field(default_factory=list)

    def table(self, name: str) -> list[Row]:
        """Return the rows of one table."""
        return {"runs": [self.run], "approaches": self.approaches, "dropped": self.dropped}[name]


def run_rows(
    found: FoundRun, name: str, head: bytes, files: Sequence[str], read: Callable[[str], bytes]
) -> RunRows | None:
    """Return the rows of one run; None for a folder that is not a run, such as merged tables.

    Args:
        found: The run.
        name: Name of its folder.
        head: Content of ``manifest.json``, or of a failed run's ``failure.log``.
        files: Paths of its tables, those of its score, and what is beside them.
        read: Function that reads one of these files.

    Raises:
        ValueError: The manifest or the tags are damaged or of another version.
        OSError: A file cannot be read.
    """
    tags = parse_tags(read(TAGS)) if TAGS in files else {}
    if found.file == FAILURE:
        row = _failed_row(found, name, head, tags)
        return None if row is None else RunRows(row)
    try:
        manifest = _Manifest.model_validate_json(head)
    except ValidationError as error:
        _check_other(head, error)
        return None
    detect = manifest.detect
    if manifest.stage == "detect":
        detect = _Detect.model_construct(detectors=manifest.detectors, counts=manifest.counts)
    results = _results(read(JUDGED)) if JUDGED in files else []
    run = found.run
    failure = _failure(read(FAILURE)) if FAILURE in files else {}
    return RunRows(
        _run_row(found, name, manifest, detect, files, tags, results)
        | {"error": failure.get("error")}
        | {"seconds": _seconds(read(TIMINGS)) if TIMINGS in files else None},
        _approaches(run, manifest, results, tags),
        _dropped(run, manifest.account),
    )


def _check_other(head: bytes, error: ValidationError) -> None:
    """Accept the manifest of a folder that is not a run, such as merged tables."""
    try:
        kind = _Head.model_validate_json(head)
    except ValidationError as of_head:
        error, kind = of_head, _Head(format_version=FORMAT_VERSION)
    if kind.format_version != FORMAT_VERSION:
        raise ValueError(
            f"{MANIFEST}: format {kind.format_version!r}, this crosscue reads {FORMAT_VERSION}; "
            "replay again"
        )
    if kind.stage in NOT_A_RUN:
        return
    first = error.errors(include_url=False)[0]
    place = ".".join(str(part) for part in first["loc"])
    where = f"{place}: " if place else ""
    raise ValueError(f"{MANIFEST}: unreadable ({where}{first['msg'].lower()}); replay again")


def _results(content: bytes) -> list[Row]:
    """Return the results of the approaches in the truth, from a score's ``approaches.parquet``."""
    import pyarrow.parquet as pq

    try:
        # Without threads, which take longer to start than a run's few rows to read.
        file = pq.ParquetFile(pa.BufferReader(content), page_checksum_verification=True)
        rows: list[Row] = file.read(use_threads=False).to_pylist() if file.metadata.num_rows else []
        return rows
    except (OSError, pa.ArrowException) as error:
        raise ValueError(f"{JUDGED}: damaged ({one_line(error)}); score the run again") from None


def _run_row(
    found: FoundRun,
    name: str,
    manifest: _Manifest,
    detect: _Detect | None,
    files: Sequence[str],
    tags: Mapping[str, str],
    results: Sequence[Row],
) -> Row:
    lines = [one for _, _, one in manifest.account.lines()]
    segments = manifest.time.segments
    detectors = None if detect is None else list(detect.detectors)
    text, sha256 = text_and_sha256(manifest.settings, detectors, manifest.selection)
    identity = identity_of_all([log.identity for log in manifest.logs]) if manifest.logs else None
    return {
        "run": found.run,
        "name": name,
        "outcome": "whole" if manifest.account.is_whole else "losses",
        "exit_status": 0 if manifest.account.is_whole else 3,
        "stage": manifest.stage,
        "identity": None if identity is None else identity.digest,
        "logs": [log.name for log in manifest.logs],
        "is_simulated": any(log.is_simulated for log in manifest.logs),
        "vehicle": manifest.settings.get("name"),
        "crosscue": manifest.versions.get("crosscue"),
        "crosscue_commit": manifest.versions.get("crosscue_commit"),
        "models": [{"name": one["name"], "identity": one["identity"]} for one in detectors or ()],
        "settings": text,
        "settings_sha256": sha256,
        "tags": list(tags.items()),
        "conditions": sorted({tag for one in results for tag in one["conditions"]}),
        "start_ns": segments[0].start_ns if segments else None,
        "end_ns": segments[-1].end_ns if segments else None,
        "made_at": _made_at(found),
        "travelled_m": None if manifest.pose is None else manifest.pose.travelled_m,
        "frames": None if detect is None else detect.counts["frames"],
        "approaches": 0 if manifest.scene is None else len(manifest.scene.approaches),
        "is_scored": "score/by_drive.parquet" in files,
        "rows_in": sum(one.entered for one in lines),
        "rows_used": sum(one.used for one in lines),
        "rows_skipped": sum(n for one in lines for n in one.skipped.values()),
        "rows_dropped": sum(n for one in lines for n in one.dropped.values()),
        "notices": list(manifest.notices),
        "tables": [file for file in files if file not in BESIDE],
    }


def _made_at(found: FoundRun) -> datetime | None:
    made_us = found.made_ns // 1000
    return _EPOCH + timedelta(microseconds=made_us) if made_us else None


def _seconds(content: bytes) -> float | None:
    """Return the wall time of a run; None if its record is damaged, which no result depends on."""
    try:
        return Timings.model_validate_json(content).seconds
    except ValidationError:
        return None


def _failure(content: bytes) -> dict[str, str]:
    """Return the header fields of a ``failure.log``; empty if it is not a log of crosscue."""
    head, _, _ = content.decode("utf-8", "replace").partition("\n\n")
    fields = {line[:10].rstrip(): line[10:] for line in head.splitlines()}
    return fields if {"drive", "error"} <= fields.keys() else {}


def _failed_row(found: FoundRun, name: str, content: bytes, tags: Mapping[str, str]) -> Row | None:
    fields = _failure(content)
    if not fields:
        return None
    status = fields.get("status", "")
    versions = dict(one.partition(" ")[::2] for one in fields.get("versions", "").split(", "))
    return {
        "run": found.run,
        "name": name,
        "outcome": "failed",
        "exit_status": int(status) if status.isdecimal() else None,
        "error": fields["error"],
        "crosscue": versions.get("crosscue"),
        "crosscue_commit": versions.get("crosscue_commit"),
        "tags": list(tags.items()),
        "made_at": _made_at(found),
        "is_scored": False,
        "tables": [],
    }


def _approaches(
    run: str, manifest: _Manifest, results: Sequence[Row], tags: Mapping[str, str]
) -> list[Row]:
    """Return the run's approaches with their results if scored, then those that it did not find."""
    own = () if manifest.scene is None else manifest.scene.approaches
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
