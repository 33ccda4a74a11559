"""The made-up drive of ``support.scoring`` with pictures in a log, detections and poses."""

from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import pyarrow as pa

from crosscue.detectors import rle
from crosscue.eval.runs.account import account, line
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import ClockRow
from crosscue.eval.runs.tables.columns import OF_RUN, arrow_schema
from crosscue.eval.runs.tables.labelled import with_labels
from crosscue.replay.clocks.clock import Clock
from crosscue.replay.columns import Block, Images, Messages, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.time.segments import ONE_SEGMENT, UNSHIFTED
from crosscue.replay.write.convert import LogWriter

from .manifests import detected, log_account
from .scoring import (
    BELIEF,
    CUES,
    at,
    belief_table,
    cue_table,
    frame_table,
    log_row,
    range_table,
    run_folder,
)

FRAMES: Final = 50
SIZE: Final = (160, 90)
LABEL: Final = "<img src=x onerror=alert(1)>"
TOPIC: Final = "/camera/[red]<script>alert(1)</script>"


def write_pictures(path: Path, frames: int = FRAMES) -> int:
    """Write a log with one JPEG per frame, and return the size of all JPEGs in bytes."""
    noise = np.random.default_rng(1).integers(0, 255, (frames, SIZE[1], SIZE[0], 3), np.uint8)
    jpegs = [cv2.imencode(".jpg", picture)[1].ravel() for picture in noise]
    edges = np.cumsum([0, *map(len, jpegs)])
    images = Images(Messages(np.concatenate(jpegs), edges[:-1], edges[1:]), ("jpeg",) * frames)
    times = np.array([at(frame) for frame in range(frames)], np.int64)
    with LogWriter(path, Ledger(str(path))) as writer:
        writer.add_topic(Topic(TOPIC, "crosscue/Images", "columns"))
        writer.write(Block(TOPIC, times, images))
    return int(edges[-1])


def detections(frames: int = FRAMES) -> pa.Table:
    """A car in side view that drives to the right, and an object whose label contains markup."""
    rows: list[dict[str, Any]] = []
    for frame in range(frames):
        x = 20.0 + frame
        mask = rle.encode_mask(np.ones((12, 40), np.bool_), (int(x), 40), SIZE)
        for label, score, box, runs in (
            ("car", 0.97, (x, 40.0, x + 40.0, 52.0), mask),
            (LABEL, 0.5, (5.0, 5.0, 15.0, 15.0), None),
        ):
            rows.append(
                {"frame": frame, "t_ns": at(frame), "camera": TOPIC, "detector": "finder"}
                | dict(zip(("x0", "y0", "x1", "y1"), box, strict=True))
                | {"label": label, "score": score, "mask": runs, "height_px": 12.0}
                | {"picture_width_px": SIZE[0], "picture_height_px": SIZE[1]}
            )
    return pa.Table.from_pylist(rows, schema=arrow_schema(OF_RUN["detections"]))


def road(frames: int = FRAMES) -> pa.Table:
    """Road table in which the lower half of every picture is road."""
    mask = rle.encode_mask(np.ones((5, 16), np.bool_), (0, 4), (16, 9))
    fractions = {"fraction_left": 1.0, "fraction_straight": 1.0, "fraction_right": 0.1}
    rows = [
        {"frame": frame, "t_ns": at(frame), "camera": TOPIC, "mask": mask}
        | fractions
        | {"mask_width_px": 16, "mask_height_px": 9}
        for frame in range(frames)
    ]
    return pa.Table.from_pylist(rows, schema=arrow_schema(OF_RUN["road"]))


def frames_seen(frames: int = FRAMES) -> pa.Table:
    """Frames table of the detect stage."""
    times = frame_table(frames)["t_ns"].to_pylist()
    rows = [
        {"frame": i, "t_ns": t, "camera": TOPIC, "width_px": SIZE[0], "height_px": SIZE[1]}
        for i, t in enumerate(times)
    ]
    return pa.Table.from_pylist(rows, schema=arrow_schema(OF_RUN["frames"]))


def poses(frames: int = FRAMES) -> pa.Table:
    """Poses of a drive straight to the east at 10 m/s."""
    schema = arrow_schema(OF_RUN["pose"])
    rows = [
        {name: None if name == "landmark" else 1.0 for name in schema.names}
        | {"t_ns": at(frame), "x_m": float(frame), "y_m": 0.0, "heading_rad": 0.0, "cov_xy_m2": 0.0}
        for frame in range(frames)
    ]
    return pa.Table.from_pylist(rows, schema=schema)


def scene_run(folder: Path, *, without: frozenset[str] = frozenset()) -> RunFolder:
    """Write a finished run ``folder/run`` of ``folder/drive.mcap``."""
    folder.mkdir(parents=True, exist_ok=True)
    write_pictures(folder / "drive.mcap")
    cues = {**CUES, "cross_traffic_right": {frame: int(frame > 20) for frame in range(1, FRAMES)}}
    tables = {
        "frames": frames_seen(),
        "detections": detections(),
        "road": road(),
        "pose": poses(),
        "cues": cue_table(cues),
        "belief": belief_table(BELIEF),
        "range": range_table(8, 45, 0.5),
    }
    clock = ClockRow(used=Clock.LOG, why="", rows=FRAMES, rate_hz=None)
    detect = detected(TOPIC, {"finder": "objects", "network": "road"}, clocks=({TOPIC: clock},))
    return run_folder(
        folder / "run",
        {
            name: with_labels(table, ONE_SEGMENT, UNSHIFTED)
            for name, table in tables.items()
            if name not in without
        },
        detect=detect,
        account=account(
            [log_account("drive.mcap", TOPIC, used=FRAMES - 1, dropped={"<b>cut</b>": 1})],
            {TOPIC: line(FRAMES, FRAMES - 1, {}, {"<b>not decoded</b>": 1})},
        ),
        logs=(log_row(folder / "drive.mcap", RunFolder(folder / "run"), "00", TOPIC),),
        notices=("[here](http://example.org) ![x](http://example.org/x.png) </td><script>",),
    )
