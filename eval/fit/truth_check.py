"""Checking a truth file against its log."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.truth.annotations import (
    LogPictures,
    check_boxes,
    cues_by_label,
    match_frames,
)
from crosscue.datasets.truth.coco import read_coco
from crosscue.datasets.truth.truth import Truth
from crosscue.datasets.truth.tum import read_tum
from crosscue.eval.scoring import truth as score_truth
from crosscue.replay.columns import Int64s
from crosscue.replay.errors import SchemaError
from crosscue.replay.files.whole_file import sha256_of
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.safe_text import counted
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import Result

from .log_images import LogSpan, log_pictures, log_span

# Max time by which truth may exceed its log, because clocks and last pictures differ slightly.
SLACK_NS: Final = 1_000_000_000


@dataclass(frozen=True, slots=True, repr=False)
class TruthFit(Result):
    """Content of a truth file that fits its log.

    Attributes:
        seconds: Duration of the truth.
        approaches: Number of approaches.
        cues: Number of statements about cues.
        moments_with_frame: Number of ``moments`` at which the log has a picture.
        moments: Number of statements about a single moment.
        objects: Number of labelled objects.
        ranges: Number of rows with true ranges.
        poses: Number of poses of the track.
        outside: Number of approaches and cues outside the log's stamps; above 0 only if the log's
            clock was set back.
        is_checked_by_hash: True if the truth names the log's hash.
        log: The log; None if the truth was checked without one.
    """

    seconds: float
    approaches: int
    cues: int
    moments_with_frame: int
    moments: int
    objects: int
    ranges: int
    poses: int
    outside: int
    is_checked_by_hash: bool
    log: Path | None

    def lines(self) -> Iterator[str]:
        """Yield what the truth contains, and what of it was not checked."""
        yield f"fits       {self.seconds:.1f} s of truth"
        approaches = counted(self.approaches, "approach", "approaches")
        yield f"holds      {approaches}, {counted(self.cues, 'statement')} about cues,"
        objects, ranges = counted(self.objects, "object"), counted(self.ranges, "range")
        yield f"           {objects}, {ranges}, {counted(self.poses, 'pose')}"
        if self.outside:
            text = "of them reach beyond the log, whose clock was set back"
            yield f"outside    {self.outside} {text}"
        if self.log is None:
            yield "log        not compared: name the log, too"
            return
        if self.moments:
            met = f"{self.moments_with_frame} of {self.moments}"
            yield f"moments    {met} meet a picture of the log"
        if not self.is_checked_by_hash:
            yield "log        not checked by hash: the truth names none (log_sha256)"


def check_truth(
    truth: Path | str,
    log: Path | str | None = None,
    vehicle: Vehicle | Path | str | None = None,
    *,
    limits: Limits = DEFAULT_LIMITS,
) -> TruthFit:
    """Check a truth file, against its log if that is named.

    All files that it names are checked, too. The check fails for times outside the log, unknown
    cues or classes, overlapping approaches, boxes outside the picture, pictures of another size,
    and the hash of another log.

    Args:
        truth: Truth file, or its folder.
        log: Log that the truth belongs to; None to check the files of the truth alone.
        vehicle: Vehicle file: camera topic, if the log has several cameras.
        limits: Limits for reading the log.

    Raises:
        SchemaError: The truth does not fit the log; the first error found is reported.
        LogError: The log or the track cannot be read.
    """
    path, log_path = Path(truth), None if log is None else Path(log)
    drive = score_truth.read_scored_truth(path, str(log_path))
    known = drive.truth
    folder = path if path.is_dir() else path.parent
    has_hash = bool(known.log_sha256) and log_path is not None
    outside = 0 if log_path is None else _check_log(known, path, log_path, limits)
    poses = 0
    if known.pose is not None:
        track = read_tum(folder / known.pose)
        poses = len(track.t_ns)
        _check_overlap(f"{folder / known.pose}: track", track.t_ns, known, path)
    moments = np.array([one.t_ns for one in known.cues if one.t_ns is not None], np.int64)
    pictures, objects = None, 0
    if log_path is not None and (len(moments) or known.objects is not None):
        pictures = log_pictures(log_path, vehicle_given(vehicle), limits)
    if known.objects is not None:
        objects = _check_objects(folder / known.objects, pictures, known.own_cues)
    matched = 0 if pictures is None else int(np.isin(moments, pictures.t_ns).sum())
    if len(moments) and pictures is not None and not matched:
        raise SchemaError(
            f"{path}: cues: {log_path} has no picture at their times, {len(moments)} in all; they "
            "are of another log or clock"
        )
    ranges = 0 if drive.ranges is None else len(drive.ranges.t_ns)
    return TruthFit(
        (known.end_ns - known.start_ns) * 1e-9,
        len(known.approaches),
        len(known.cues),
        matched,
        len(moments),
        objects,
        ranges,
        poses,
        outside,
        has_hash,
        log_path,
    )


def _check_log(truth: Truth, path: Path, log_path: Path, limits: Limits) -> int:
    """Refuse truth of another log by its hash or times; return the number of parts outside it."""
    wanted = set(truth.log_sha256.values())
    if wanted and not wanted & set(sha256_of(log_path).values()):
        raise SchemaError(
            f"{path}: belongs to {truth.log or 'another log'} by its hash, not to {log_path}"
        )
    return _check_times(truth, log_span(log_path, limits), path, log_path)


def _check_times(truth: Truth, span: LogSpan, path: Path, log_path: Path) -> int:
    """Refuse truth outside its log; return the number of parts outside a log that was set back.

    If the log's clock was set back, truth may exceed the log's stamps. As in ``score``, the two
    then only have to overlap.
    """
    first, last = span.start_ns - SLACK_NS, span.end_ns + SLACK_NS
    where = f"{log_path} lasts from {span.start_ns} to {span.end_ns} ns; give the truth of this log"
    if truth.start_ns >= last or truth.end_ns <= first:
        raise SchemaError(f"{path}: truth from {truth.start_ns} to {truth.end_ns} ns, but {where}")
    outside = [
        f"{what} from {begin} to {end} ns"
        for what, begin, end in _parts(truth)
        if begin < first or end > last
    ]
    if outside and not span.was_set_back:
        raise SchemaError(f"{path}: {outside[0]}, but {where}")
    return len(outside)


def _parts(truth: Truth) -> Iterator[tuple[str, int, int]]:
    """Yield the description, first and last moment of each part of a truth."""
    for one in truth.approaches:
        yield f"approach {one.id}", one.start_ns, one.enter_ns
    for number, cue in enumerate(truth.cues):
        begin = cue.t_ns if cue.start_ns is None else cue.start_ns
        end = cue.t_ns if cue.end_ns is None else cue.end_ns
        assert begin is not None
        assert end is not None
        yield f"cues.{number} ({cue.cue})", begin, end


def _check_overlap(what: str, t_ns: Int64s, truth: Truth, path: Path) -> None:
    if not ((t_ns >= truth.start_ns - SLACK_NS) & (t_ns < truth.end_ns + SLACK_NS)).any():
        raise SchemaError(
            f"{what} from {t_ns.min()} to {t_ns.max()} ns, but {path} covers {truth.start_ns} "
            f"to {truth.end_ns} ns; it belongs to another log"
        )


def _check_objects(path: Path, pictures: LogPictures | None, own_cues: Sequence[str]) -> int:
    annotations = read_coco(path)
    cues_by_label(annotations, {}, own_cues, any_thing=True)
    if pictures is not None:
        match_frames(annotations, pictures)
    check_boxes(annotations)
    return sum(len(picture.things) for picture in annotations.pictures)
