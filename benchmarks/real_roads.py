"""Scoreboard of real drives: one line each for lights, stop signs, legs, pieces and ranges.

Run it as ``python benchmarks/real_roads.py OUT [DRIVE ...]``; without names it replays every drive
of ``$CROSSCUE_DATA`` (or ``../shared/data``), pictures alone unless the name says otherwise.
Detections are cached in OUT. ``--fusion FILE`` adds the sections of ``crosscue fit temporal`` to
each vehicle file. Drives marked ``*`` were used in development and prove nothing.

``real_roads.json`` has drives of public repositories that are not in ``$CROSSCUE_DATA``: put the
file of ``source`` to ``sequences/`` + ``pictures`` there, or the drive is left out. Its annotations
were made by eye and frozen before the first run. Frames of cues and approaches are inclusive, of
the pictures that ``cut`` takes (first, last, step); null is uncertain and not scored.

A leg counts by the highest belief within the annotated frames: above 0.9 it is believed, and wrong
where there is none. At its prior it is not seen; below, a missing leg is right. Anything else is
undecided. Beside it stand the messages: the legs that are there, and those that are not, that a
road cue shows in any of the frames. ``OUT/wrong`` has a picture of each missed or false cue, and of
each wrong leg and intersection, named after drive and frame. Below, each cue and leg has a line
with the numbers of drives and places it stands on, apart for drives of development (``*``), and so
have the messages; then the sums of legs and intersections. Times, frames and distances are those of
the annotations; ranges are scored only where a track or an annotation gives the true distance.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.catalog.fetch import fetch_weights
from crosscue.eval.drives.replay import replay_drive
from crosscue.eval.pipeline.run import Run
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.replay.columns import Floats

DATA: Final = Path(os.environ.get("CROSSCUE_DATA", "../shared/data"))
# Frames between those whose cues are scored.
EVERY: Final = 5
CUES: Final = ("traffic_light", "stop_sign")
FEATURES: Final = ("left", "right", "straight")
BELIEVED: Final = 0.9
DETECTORS: Final = """
[cars]
labels = ["car", "truck", "bus"]
score = 0.5
[detectors.yolox-nano]
kind = "yolox-nano"
[detectors.road-segmentation-adas-0001]
kind = "road-segmentation-adas-0001"
"""
MODELS: Final = {
    "yolox-nano": "yolox_nano/yolox_nano.onnx",
    "road-segmentation-adas-0001": "road-segmentation-adas-0001",
}
KITTI: Final = "x_m = 1.03\nz_m = 1.65\n"


class Approach(NamedTuple):
    """One annotated approach, or a stretch without any: frames inclusive, None for uncertain."""

    first: int
    last: int
    features: Mapping[str, bool | None]


@dataclass(frozen=True, slots=True)
class Drive:
    """One real drive.

    Attributes:
        folder: Folder below ``sequences``.
        pictures: Pattern of its pictures, or of a video.
        rate_hz: Rate of the pictures.
        camera: Lines of ``[camera]``; empty where nothing is known.
        approaches: Approaches; empty to read ``annotation.json``.
        mouth_m: Start and end of the intersection along the track of ``travelled``.
        travelled: Distance of each picture along the true track of the camera.
        is_development: True if it was used in development.
        has_odometry: True to replay the folder itself, with its odometry.
        cut: First, last and step of the pictures that are used.
        rows: First row and row behind the last; None for all.
        in_view: Ranges of frames of each cue, and whether it is in view.
        starts: Of each intersection, some frames and the distance from the camera to its start.
    """

    folder: str
    pictures: str
    rate_hz: float
    camera: str = ""
    approaches: tuple[Approach, ...] = ()
    mouth_m: tuple[float, float] | None = None
    travelled: Callable[[Path], Floats] | None = None
    is_development: bool = True
    has_odometry: bool = False
    cut: tuple[int, int, int] = (0, 10**6, 1)
    rows: tuple[int, int] | None = None
    in_view: Mapping[str, Sequence[tuple[int, int, bool | None]]] = field(default_factory=dict)
    starts: Sequence[Sequence[tuple[int, float]]] = ()


def kitti_travelled(folder: Path) -> Floats:
    """Distance along the track of ``poses.txt``."""
    lines = folder.joinpath("poses.txt").read_text().splitlines()
    rows = np.array([[float(word) for word in line.split()[:12]] for line in lines])
    return _along(rows.reshape(-1, 3, 4)[:, :, 3])


def pandaset_travelled(folder: Path) -> Floats:
    """Distance along the track of ``poses.json``."""
    poses = json.loads(folder.joinpath("camera/front_camera/poses.json").read_text())
    return _along(np.array([[one["position"][axis] for axis in "xyz"] for one in poses]))


def _along(xyz_m: Floats) -> Floats:
    steps = np.linalg.norm(np.diff(xyz_m, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def recorded_drives() -> Iterator[tuple[str, Drive]]:
    """Yield the drives of ``real_roads.json``."""
    tree = json.loads(Path(__file__).with_suffix(".json").read_text())
    for name, one in tree.items():
        folder, pictures = one["pictures"].split("/")
        yield (
            name,
            Drive(
                folder,
                pictures,
                one["rate_hz"],
                _CAMERAS[one["camera"]] if "camera" in one else "",
                tuple(
                    Approach(first, last, approach["features"])
                    for approach in one["approaches"]
                    for first, last in (approach["frames"],)
                ),
                is_development=one["is_development"],
                cut=tuple(one["cut"]),
                rows=tuple(one["rows"]) if "rows" in one else None,
                in_view={cue: one[cue] for cue in CUES},
                starts=[each["start_m"] for each in one["approaches"] if "start_m" in each],
            ),
        )


# Cameras of KITTI by the month and day of their calibration; raw is before rectification.
_CAMERAS: Final = {
    "kitti_360": "focal_px = 552.55\ncenter_px = [682.05, 238.77]\nx_m = 1.6\nz_m = 1.55\n",
    "kitti_0926_raw": f"focal_px = 984.2\ncenter_px = [690.0, 233.2]\n{KITTI}",
    "kitti_0926": f"focal_px = 721.5\ncenter_px = [609.6, 172.9]\n{KITTI}",
    "kitti_0930": f"focal_px = 707.0912\ncenter_px = [601.8873, 183.1104]\n{KITTI}",
    "kitti_1003": f"focal_px = 718.856\ncenter_px = [607.1928, 185.2157]\n{KITTI}",
}
_PANDASET: Final = Drive(
    "pandaset_002",
    "camera/front_camera/*.jpg",
    10.0,
    "focal_px = 1970.0\ncenter_px = [970.0, 483.3]\nsize_px = [1920, 1080]\nz_m = 2.1\nx_m = 1.8\n",
    (Approach(0, 79, dict.fromkeys(("intersection", *FEATURES), True)),),
    (59.0, 79.0),
    pandaset_travelled,
)
DRIVES: Final[dict[str, Drive]] = {
    "kitti_t_junction": Drive(
        "kitti_t_junction",
        "image_0/*",
        9.64,
        _CAMERAS["kitti_0930"],
        # By eye: kerb corners in pictures 28 and 40, on the ground by the camera's height.
        mouth_m=(45.0, 61.0),
        travelled=kitti_travelled,
    ),
    "kitti_right_turn": Drive(
        "kitti_seq2_right_turn_98deg",
        "image_l/*",
        9.64,
        _CAMERAS["kitti_1003"],
        # By eye: a slip road that meets a carriageway, which carries on to the right only.
        (Approach(0, 28, {"intersection": True, "left": None, "right": True, "straight": False}),),
        travelled=kitti_travelled,
    ),
    "pandaset_002": _PANDASET,
    "pandaset_002_odometry": replace(_PANDASET, has_odometry=True),
    "kitti_red_light_queue": Drive(
        "kitti_red_light_queue",
        "*.jpg",
        10.0,
        _CAMERAS["kitti_0926"],
    ),
    "camvid_0016e5_light": Drive("camvid_0016e5_light", "*.jpg", 15.0),
    "highway_straight": Drive("highway_straight", "*.mp4", 12.5, cut=(0, 10**6, 2)),
    "us_dashcam": Drive(
        "us_signalized_intersection_dashcam",
        "*.jpg",
        15.0,
        approaches=(
            Approach(0, 110, {"intersection": True, "left": None, "right": True, "straight": True}),
        ),
    ),
    **dict(recorded_drives()),
}


@dataclass(slots=True)
class Score:
    """Counts of one drive.

    Attributes:
        cues: Frames of each cue: right, missed and false.
        legs: What is believed of each leg.
        messages: Whether each leg is there, and whether a road cue shows it.
        first: Where the intersection is first believed.
        pieces: Believed approaches to each annotated intersection.
        false_intersections: Believed approaches to none.
        unannotated: Those of them outside all stretches annotated as without intersection.
        ranges: Numbers of ranges inside their interval, and of all.
        minutes: Duration.
        brier: Error of each feature of an approach.
        wrong: Time of a frame, and what is wrong in it.
    """

    cues: dict[str, Counter[str]] = field(default_factory=dict)
    legs: dict[str, str] = field(default_factory=dict)
    messages: dict[str, tuple[bool, bool]] = field(default_factory=dict)
    first: str = "-"
    pieces: list[int] = field(default_factory=list)
    false_intersections: int = 0
    unannotated: int = 0
    ranges: tuple[int, int] = (0, 0)
    minutes: float = 0.0
    brier: list[float] = field(default_factory=list)
    wrong: list[tuple[int, str]] = field(default_factory=list)


def pictures_of(source: Path, pattern: str) -> Iterator[Path | NDArray[np.uint8]]:
    """Yield the pictures of a folder, or of the video there."""
    for path in sorted(source.glob(pattern)):
        if path.suffix in (".png", ".jpg"):
            yield path
        elif path.suffix in (".mp4", ".gif"):
            video = cv2.VideoCapture(str(path))
            while (read := video.read())[0]:
                yield np.asarray(read[1], np.uint8)


def log_of(name: str, drive: Drive, out: Path) -> Path:
    """Return the folder to replay, with the pictures and their rate."""
    source = DATA / "sequences" / drive.folder
    if drive.has_odometry:
        return source
    folder = out / "logs" / name
    if folder.is_dir():
        return folder
    folder.mkdir(parents=True)
    first, last, step = drive.cut
    for number, picture in enumerate(pictures_of(source, drive.pictures)):
        if first <= number <= last and (number - first) % step == 0:
            if isinstance(picture, Path):
                shutil.copy(picture, folder)
            else:
                rows = slice(*(drive.rows or (None,)))
                cv2.imwrite(str(folder / f"{number:04}.png"), picture[rows])
    folder.joinpath("timestamps.txt").write_text(f"rate_hz: {drive.rate_hz}\n")
    return folder


def replayed(name: str, drive: Drive, out: Path, fusion: str = "") -> Run:
    """Replay a drive; detections come from the cache in ``out`` where they are known."""
    vehicle = out / f"{name}.toml"
    camera = f"[camera]\n{drive.camera}" if drive.camera else ""
    topics = '[topics]\ncamera = "front_camera"\nodometry = "odometry"\n'
    vehicle.write_text(
        f"version = 1\n{topics if drive.has_odometry else ''}{camera}{DETECTORS}{fusion}"
    )
    return replay_drive(
        log_of(name, drive, out),
        out / "runs" / name,
        vehicle=vehicle,
        cache=out / "detections.sqlite",
        overwrite=True,
    )


def annotated(drive: Drive) -> tuple[tuple[Approach, ...], list[tuple[int, str, bool]]]:
    """Return the approaches, and of frames whether a cue is in view where that is certain."""
    file = DATA / "sequences" / drive.folder / "annotation.json"
    if not file.is_file():
        return drive.approaches, [
            (frame, cue, is_there)
            for cue, ranges in drive.in_view.items()
            for first, last, is_there in ranges
            for frame in range(-(-first // EVERY) * EVERY, last + 1, EVERY)
            if is_there is not None
        ]
    tree = json.loads(file.read_text())
    approaches = tuple(
        Approach(one["frames"][0], one["frames"][1], one["features"]) for one in tree["approaches"]
    )
    return approaches, [
        (one["frame"], cue, one["cues"][cue])
        for one in tree["frames"]
        for cue in CUES
        if one["cues"][cue] is not None
    ]


def scored(run: Run, drive: Drive) -> Score:
    """Score one run."""
    approaches, in_view = annotated(drive)
    times = np.sort(run["frames"]["t_ns"].to_numpy())
    score = Score(minutes=float(times[-1] - times[0]) / 60e9)
    found = {(row["t_ns"], row["cue"]): row["count"] > 0 for row in run["cues"].to_pylist()}
    score.cues = {cue: Counter() for cue in CUES}
    for frame, cue, is_there in in_view:
        is_found = found.get((times[frame], cue)) if frame < len(times) else None
        if is_found is not None:
            kind = "right" if is_found == is_there else "missed" if is_there else "false"
            score.cues[cue][kind] += 1
            if kind != "right":
                score.wrong.append((int(times[frame]), f"{kind} {cue}"))
    beliefs = run["belief"].to_pylist()
    frame_of = {int(t_ns): i for i, t_ns in enumerate(times)}
    believed: dict[int, list[int]] = {}
    for row in beliefs:
        if row["intersection"] > BELIEVED:
            believed.setdefault(row["approach"], []).append(frame_of[row["t_ns"]])
    travelled = None
    if drive.travelled is not None:
        travelled = drive.travelled(DATA / "sequences" / drive.folder)
    claimed: set[int] = set()
    for number, approach in enumerate(approaches, 1):
        rows = [r for r in beliefs if approach.first <= frame_of[r["t_ns"]] <= approach.last]
        prefix = f"{number} " if len(approaches) > 1 else ""
        _legs(score, approach, rows, prefix)
        within = times[approach.first : approach.last + 1].tolist()
        for leg in FEATURES:
            if (truth := approach.features.get(leg)) is not None:
                is_shown = any(found.get((t_ns, f"road_{leg}")) for t_ns in within)
                score.messages[prefix + leg] = truth, is_shown
        believes = {frame_of[row["t_ns"]]: row for row in rows}
        inside = range(approach.first, min(approach.last + 1, len(times)))
        for feature, truth in approach.features.items():
            if truth is not None and inside:
                values = [believes.get(frame, {}).get(feature, 0.5) for frame in inside]
                score.brier.append(float(np.mean((np.array(values) - truth) ** 2)))
        ours = {
            number
            for number, frames in believed.items()
            if any(approach.first <= frame <= approach.last for frame in frames)
        }
        if not approach.features.get("intersection"):
            continue
        claimed |= ours
        score.pieces.append(len(ours))
        frames = [frame for number in ours for frame in believed[number]]
        if frames:
            score.first = f"frame {min(frames)}"
            if travelled is not None and drive.mouth_m is not None:
                score.first = f"{drive.mouth_m[0] - travelled[min(frames)]:.1f} m"
    false = sorted(believed.keys() - claimed)
    score.false_intersections = len(false)
    none = [one for one in approaches if one.features.get("intersection") is False]
    score.unannotated = sum(
        not any(one.first <= frame <= one.last for one in none for frame in believed[number])
        for number in false
    )
    score.wrong += [(int(times[min(believed[one])]), "false intersection") for one in false]
    if travelled is not None and drive.mouth_m is not None:
        score.ranges = _ranges(run, drive, frame_of, travelled)
    elif drive.starts:
        score.ranges = _ranges_to_starts(run, drive, frame_of)
    return score


def _legs(
    score: Score, approach: Approach, rows: Sequence[Mapping[str, float]], prefix: str
) -> None:
    for name in FEATURES:
        truth = approach.features.get(name)
        if truth is None:
            continue
        best = max((row[name] for row in rows), default=0.5)
        is_seen = any(row[name] != 0.5 for row in rows)
        if best > BELIEVED:
            score.legs[prefix + name] = "right" if truth else "WRONG"
            if not truth:
                surest = max(rows, key=lambda row: row[name])
                score.wrong.append((int(surest["t_ns"]), f"false {name}"))
        elif not is_seen:
            score.legs[prefix + name] = "not seen"
        elif not truth and rows[-1][name] < 0.5:
            score.legs[prefix + name] = "right"
        else:
            score.legs[prefix + name] = f"undecided {rows[-1][name]:.2f}"


def _ranges(
    run: Run, drive: Drive, frame_of: Mapping[int, int], travelled: Floats
) -> tuple[int, int]:
    """Return the numbers of ranges inside their 95 % interval and of all before the mouth."""
    assert drive.mouth_m is not None
    x_m = 1.8 if drive.folder == "pandaset_002" else 1.03
    inside = total = 0
    for row in run["range"].to_pylist():
        place_m = drive.mouth_m[row["reference"] == "end"]
        frame = frame_of[row["t_ns"]]
        if frame >= len(travelled) or travelled[frame] > drive.mouth_m[0]:
            continue
        total += 1
        error_m = row["range_m"] - (place_m - travelled[frame] + x_m)
        inside += abs(error_m) <= 1.96 * row["var_m2"] ** 0.5
    return inside, total


def _ranges_to_starts(run: Run, drive: Drive, frame_of: Mapping[int, int]) -> tuple[int, int]:
    """Return the same, of ranges to starts whose distance from KITTI's camera is annotated."""
    errors = [
        (row["range_m"] - float(np.interp(frame, *np.transpose(start))) - 1.03)
        / row["var_m2"] ** 0.5
        for row in run["range"].to_pylist()
        for frame in (frame_of[row["t_ns"]],)
        for start in drive.starts
        if row["reference"] == "start" and start[0][0] <= frame <= start[-1][0]
    ]
    return sum(abs(error) <= 1.96 for error in errors), len(errors)


def draw_wrong(name: str, run: Run, score: Score, folder: Path) -> str:
    """Draw what was found in each frame where something is wrong; return why pictures are missing.

    Pictures of an earlier run of the drive are removed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob(f"{name} frame *.jpg"):
        old.unlink()
    frame_of = {t_ns: i for i, t_ns in enumerate(sorted(run["frames"]["t_ns"].to_pylist()))}
    whats: dict[int, list[str]] = {}
    for t_ns, what in score.wrong:
        whats.setdefault(t_ns, []).append(what)

    def keep(t_ns: int, picture: bytes, _: bytes) -> None:
        what = ", ".join(whats[t_ns])
        (folder / f"{name} frame {frame_of[t_ns]:04} {what}.jpg").write_bytes(picture)

    return draw_pictures(run.folder, whats, keep, has_candidates=False) if whats else ""


def evidence(scores: Mapping[str, Score], drives: Mapping[str, Drive] = DRIVES) -> Iterator[str]:
    """Yield a line for each cue and leg: what it says, on how many drives and at how many places.

    Several stretches of one recording are one drive and several places; the same stretch with other
    settings counts once. A cue is right, missed or false in frames, a leg at annotated approaches.
    """
    once = _once(scores, drives)
    rows: dict[tuple[str, bool], list[tuple[str, Counter[str]]]] = {}
    for name in once:
        folder, counts = drives[name].folder, dict(scores[name].cues)
        for leg, said in scores[name].legs.items():
            counts.setdefault(leg.split()[-1], Counter())[_LEG_WORDS[said.split()[0]]] += 1
        for what, count in counts.items():
            if count.total():
                key = (what, drives[name].is_development)
                rows.setdefault(key, []).append((folder, count))
    yield f"{'evidence':24} {'drives':>6} {'places':>6}"
    for what in (*CUES, *FEATURES):
        for is_development in (True, False):
            found = rows.get((what, is_development), [])
            total = sum((count for _, count in found), Counter[str]())
            numbers = ", ".join(f"{number} {word}" for word, number in sorted(total.items()))
            name = f"{what}{'*' if is_development else ''}"
            yield (
                f"{name:24} {len({folder for folder, _ in found}):6} {len(found):6} "
                f"{numbers or '-'}"
            )
    for is_development in (True, False):
        shown = {
            name: scores[name].messages
            for name in once
            if scores[name].messages and drives[name].is_development is is_development
        }
        by_drive = [f"{name} {_shown(legs)}" for name, legs in shown.items()]
        every = {(name, leg): one for name, legs in shown.items() for leg, one in legs.items()}
        yield (
            f"{'messages*' if is_development else 'messages':24} "
            f"{len({drives[one].folder for one in shown}):6} {len(shown):6} "
            f"{_shown(every)} ({', '.join(by_drive) or '-'})"
        )


def sums(scores: Mapping[str, Score], drives: Mapping[str, Drive] = DRIVES) -> Iterator[str]:
    """Yield a line with the sums of drives of development (``*``), and one of the others.

    The same stretch with other settings counts once.
    """
    for is_development in (True, False):
        some = [
            scores[name]
            for name in _once(scores, drives)
            if drives[name].is_development is is_development
        ]
        legs = [(one.messages[leg][0], said) for one in some for leg, said in one.legs.items()]
        there = [said for is_there, said in legs if is_there]
        absent = [said for is_there, said in legs if not is_there]
        pieces = [number for one in some for number in one.pieces]
        false, unannotated, minutes = (
            sum(one.false_intersections for one in some),
            sum(one.unannotated for one in some),
            sum(one.minutes for one in some),
        )
        yield (
            f"{'sums*' if is_development else 'sums':24} legs there {there.count('right')} of "
            f"{len(there)}, absent wrong {absent.count('WRONG')} of {len(absent)}; intersections "
            f"{sum(number > 0 for number in pieces)} of {len(pieces)}, in one piece "
            f"{pieces.count(1)}; false {false} in {minutes:.1f} minutes"
            f"{f' ({false / minutes:.2f} a minute)' if minutes else ''}, "
            f"{unannotated} of them where nobody annotated"
        )


def _once(scores: Mapping[str, Score], drives: Mapping[str, Drive]) -> list[str]:
    """Names of scored drives, of the same stretch with other settings the first."""
    stretches = {(drives[name].folder, drives[name].cut): name for name in reversed([*scores])}
    return [*reversed(stretches.values())]


def _shown(legs: Mapping[Any, tuple[bool, bool]]) -> str:
    """How many legs that are there a message shows, and how many that are not."""
    is_shown = {
        truth: [one for is_there, one in legs.values() if is_there is truth]
        for truth in (True, False)
    }
    return ", ".join(
        f"{sum(some)} of {len(some)} {'true' if truth else 'absent'}"
        for truth, some in is_shown.items()
    )


_LEG_WORDS: Final = {
    "right": "right",
    "WRONG": "wrong",
    "not": "not seen",
    "undecided": "undecided",
}


def main(arguments: Sequence[str]) -> None:
    """Replay and score the named drives, or all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("drives", nargs="*", metavar="DRIVE")
    parser.add_argument("--fusion", type=Path, metavar="FILE", help="sections of [fusion]")
    given = parser.parse_args(arguments)
    out, fusion = given.out, given.fusion.read_text(encoding="utf-8") if given.fusion else ""
    out.mkdir(parents=True, exist_ok=True)
    for model, folder in MODELS.items():
        fetch_weights(model, DATA / "weights" / folder)
    print(
        f"{'drive':24} {'lights':>9} {'stop signs':>10} (right/missed/false) {'legs':52} "
        f"{'messages':>26} "
        f"{'first':>9} {'pieces':>6} {'false':>6} {'in 95 %':>8}"
    )
    scores = {}
    for name in given.drives or DRIVES:
        drive = DRIVES[name]
        if not any((DATA / "sequences" / drive.folder).glob(drive.pictures)):
            print(f"{name:24} no {drive.folder}/{drive.pictures} in sequences")
            continue
        run = replayed(name, drive, out, fusion)
        score = scores[name] = scored(run, drive)
        missing = draw_wrong(name, run, score, out / "wrong")
        lights, stops = (
            "/".join(str(score.cues[cue][kind]) for kind in ("right", "missed", "false"))
            for cue in CUES
        )
        legs = ", ".join(f"{leg} {what}" for leg, what in score.legs.items()) or "-"
        inside, total = score.ranges
        print(
            f"{name + ('*' if drive.is_development else ''):24} {lights:>9} {stops:>10} "
            f"{'':20} {legs:52} {_shown(score.messages):>26} "
            f"{score.first:>9} {sum(score.pieces):6} {score.false_intersections:6} "
            f"{f'{inside}/{total}' if total else '-':>8}{missing and f' no pictures: {missing}'}",
            flush=True,
        )
    print(*evidence(scores), *sums(scores), sep="\n")
    brier = [one for score in scores.values() for one in score.brier]
    print(f"Brier score {np.mean(brier or [np.nan]):.3f} of {len(brier)} features of approaches")


if __name__ == "__main__":
    main(sys.argv[1:])
