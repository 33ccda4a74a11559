"""Manifests of made-up runs."""

from typing import Any

from crosscue.eval.runs.account import LogAccount, TopicLine, account
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import (
    DetectCounts,
    DetectManifest,
    DetectorRow,
    EstimateCounts,
    EstimateManifest,
    Part,
    PoseSummary,
    TimeSegments,
)
from crosscue.replay.time.segments import ONE_SEGMENT
from crosscue.replay.vehicle.vehicle import Cars, Regions, Vehicle

WHOLE_LOG = Part(start_ns=None, end_ns=None, topics=None)
NOTHING = account([])


def _drive() -> dict[str, Any]:
    return {
        "versions": {"crosscue": "0"},
        "logs": (),
        "selection": WHOLE_LOG,
        "settings": Vehicle(version=1, cars=Cars(kind="pairs"), regions=Regions(kind="picture")),
        "clocks": (),
        "time": TimeSegments(segments=ONE_SEGMENT.segments, clocks=(), notices=()),
        "account": NOTHING,
        "notices": (),
    }


def estimated(**changes: Any) -> EstimateManifest:
    """Manifest of a finished run without rows, with the given changes."""
    content = {
        **_drive(),
        "sources": {},
        "counts": EstimateCounts(odometry={}, track={}, landmarks={}),
        "landmarks": None,
        "pose": PoseSummary(rows=0, travelled_m=0.0, major_axis_m=None),
        "scene": None,
        "detect": None,
    }
    return EstimateManifest(**{**content, **changes})


def detected(camera: str, detectors: dict[str, str], **changes: Any) -> DetectManifest:
    """Manifest of a finished detect stage."""
    content = {
        **_drive(),
        "camera": camera,
        "camera_log": 0,
        "detectors": tuple(
            DetectorRow(
                name=name, identity="0", kind="made up", role=role, labels=None, settings={}
            )
            for name, role in detectors.items()
        ),
        "counts": DetectCounts(frames=0, objects={}),
    }
    return DetectManifest(**{**content, **changes})


def estimate_manifest(run: RunFolder) -> EstimateManifest:
    found = run.manifest()
    assert isinstance(found, EstimateManifest)
    return found


def log_account(log: str, topic: str, **counts: Any) -> LogAccount:
    """Account of a log with one topic; incomplete if messages were dropped."""
    used, skipped, dropped = counts["used"], counts.get("skipped", {}), counts.get("dropped", {})
    found = used + sum(skipped.values())
    one = TopicLine(
        declared=None,
        found=found,
        entered=found + sum(dropped.values()),
        used=used,
        skipped=skipped,
        dropped=dropped,
    )
    return LogAccount(
        log=log, integrity="not checkable", is_whole=not dropped, notices=(), topics={topic: one}
    )
