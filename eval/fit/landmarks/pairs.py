"""Labelled pairs of pictures for the fit of the match threshold."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.eval.fit.landmarks.database import PosedPictures, drop_picture, place_at
from crosscue.localization.angles import wrap
from crosscue.localization.landmarks.database import LandmarkDatabase, Nearby
from crosscue.localization.landmarks.features import Keypoints, Matcher
from crosscue.localization.landmarks.fit import ScoredPairs
from crosscue.localization.landmarks.images import grey_of, read_encoded
from crosscue.replay.errors import AnnotationError, LogError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.limits import MIB

MAX_PAIRS: Final = 1_000_000
MAX_PAIR_BYTES: Final = 256 * MIB
# Near pictures whose directions differ by more than this are not used as a pair.
SAME_TURN_RAD: Final = math.pi / 4
_LABELS: Final = {"1": True, "0": False, "true": True, "false": False}


def landmark_pairs(path: Path, matcher: Matcher) -> ScoredPairs:
    """Score the pairs of a CSV file ``query,known,same``; picture names are relative to its folder.

    Raises:
        AnnotationError: The table is invalid; the message names the line.
        LogError: A picture cannot be read.
    """

    @lru_cache(maxsize=256)
    def features(name: str) -> Keypoints:
        try:
            return matcher.describe(grey_of(read_encoded(path.parent / name)))
        except LogError as error:
            raise type(error)(f"{path.parent / name}: {error}") from None

    numbers: dict[str, int] = {}
    rows: list[tuple[float, bool, int]] = []
    for query, known, is_same in _labelled(path):
        match = matcher.match(features(query), features(known))
        rows.append((match.score, is_same, numbers.setdefault(query, len(numbers))))
    return _columns(rows)


def _labelled(path: Path) -> Iterator[tuple[str, str, bool]]:
    try:
        content = read_at_most(path, MAX_PAIR_BYTES)
        if content is None:
            raise AnnotationError(f"{path}: more than {MAX_PAIR_BYTES // MIB} MiB; split it")
        with io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig", newline="") as file:
            table = csv.DictReader(file)
            if not {"query", "known", "same"} <= set(table.fieldnames or ()):
                raise AnnotationError(
                    f"{path}:1: expected columns query,known,same; correct the header"
                )
            for row in table:
                label = _LABELS.get(str(row["same"]).strip().lower())
                if label is None or table.line_num > MAX_PAIRS:
                    raise AnnotationError(
                        f"{path}:{table.line_num}: same: expected 1 or 0 (and at most "
                        f"{MAX_PAIRS:,} lines), got {row['same']!r}; correct it"
                    )
                yield str(row["query"]), str(row["known"]), label
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise AnnotationError(f"{path}: {why}; give a CSV file in UTF-8") from None


def pairs_of_drive(
    pictures: PosedPictures,
    database: LandmarkDatabase,
    matcher: Matcher,
    every_m: float,
    near_m: float,
    far_m: float,
    max_per_frame: int,
) -> ScoredPairs:
    """Score frames with known poses against landmarks; near ones are the same place, far ones not.

    Args:
        pictures: Pictures of another drive than the landmarks', else the rates are too good.
        database: The landmarks.
        matcher: Matcher that computes the scores.
        every_m: Distance between the frames used.
        near_m: Max distance of the same place, if the directions also agree.
        far_m: Min distance of different places; pairs in between are not used.
        max_per_frame: Max number of landmarks compared with one frame: all near ones first, then
            far ones drawn with a fixed seed.
    """
    marks = list(database)
    rng = np.random.default_rng(0)
    rows: list[tuple[float, bool, int]] = []
    last = None
    for number, frame in enumerate(pictures.frames):
        place = place_at(frame.t_ns, pictures.poses, 1.0, "frame")
        if place is None or (last is not None and math.dist(place.xy_m, last) < every_m):
            continue
        last = place.xy_m
        try:
            seen = matcher.describe(grey_of(frame.picture))
        except LogError as error:
            drop_picture(pictures.ledgers, frame, error)
            continue
        apart = [math.dist(mark.place.xy_m, place.xy_m) for mark in marks]
        same = [
            i
            for i, metres in enumerate(apart)
            if metres <= near_m and _looks_along(marks[i], place.heading_rad)
        ]
        other = [i for i, metres in enumerate(apart) if metres >= far_m]
        drawn = rng.permutation(other)[: max(max_per_frame - len(same), 0)].tolist()
        for i in (*same, *drawn):
            match = matcher.match(seen, database.features(marks[i].key))
            rows.append((match.score, i in same, number))
    return _columns(rows)


def _looks_along(mark: Nearby, heading_rad: float | None) -> bool:
    if mark.place.heading_rad is None or heading_rad is None:
        return True
    return abs(wrap(mark.place.heading_rad - heading_rad)) <= SAME_TURN_RAD


def _columns(rows: list[tuple[float, bool, int]]) -> ScoredPairs:
    return ScoredPairs(
        np.array([score for score, _, _ in rows], np.float64),
        np.array([is_same for _, is_same, _ in rows], np.bool_),
        np.array([query for _, _, query in rows], np.int64),
    )
