"""Cues of a drive whose clock is set are those of its two halves replayed alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import pytest

from crosscue.datasets.scenes.drive import SceneSettings, write_scene
from crosscue.datasets.scenes.rendering.camera import Camera
from crosscue.detectors.registry import Choice
from crosscue.eval.pipeline.estimate import Outcome
from crosscue.eval.pipeline.replay import Detecting, replay_drive
from crosscue.eval.runs.folder import create
from crosscue.replay.columns import Block, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.log import EVERYTHING, Log, Selection
from crosscue.replay.opening import open_log
from crosscue.replay.vehicle.vehicle import Vehicle, load

SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Reset:
    """A log whose clock is set by ``by_ns`` at a time, cut to a span of its true time."""

    log: Log
    at_ns: int
    by_ns: int = 0
    first_ns: int = 0
    last_ns: int = 1 << 62
    format: str = "mcap"

    @property
    def path(self) -> Path:
        """Of the log itself."""
        return self.log.path

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Of the log itself, without counts."""
        return tuple(replace(topic, declared=None) for topic in self.log.topics)

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """As of a recorder whose clock was set."""
        for block in self.log.read(Ledger(""), selection):
            part = block.take((block.log_ns >= self.first_ns) & (block.log_ns < self.last_ns))
            if not len(part):
                continue
            ledger.find(part.topic, len(part))
            by_ns = np.where(part.log_ns >= self.at_ns, self.by_ns, 0)
            publish_ns = None if part.publish_ns is None else part.publish_ns + by_ns
            yield replace(part, log_ns=part.log_ns + by_ns, publish_ns=publish_ns)

    def close(self) -> None:
        """Close the log."""
        self.log.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive")
    write_scene(folder, SceneSettings("A", camera=Camera(width_px=320, height_px=180)))
    return folder


def _replay(drive: Path, run: Path, vehicle: Vehicle, log: Reset) -> Outcome:
    detecting = Detecting((Choice("signs", "signs", {}),), cache=drive / "cache.sqlite")
    folder = create(run, overwrite=True)
    return replay_drive([log], vehicle, folder, EVERYTHING, detecting=detecting)


def _cues(outcome: Outcome, segment: int = 0) -> list[tuple[str, int]]:
    table = outcome.run.table("cues")
    names = ("segment", "cue", "count")
    rows = zip(*(table[name].to_pylist() for name in names), strict=True)
    return [(cue, count) for number, cue, count in rows if number == segment]


@pytest.mark.parametrize("by_s", [-3600, -7, 1200])
def test_cues_and_distance_are_those_of_the_halves(drive: Path, tmp_path: Path, by_s: int) -> None:
    vehicle = load(drive / "vehicle.toml")
    with open_log(drive / "drive.mcap") as log:
        blocks = list(log.read(Ledger("")))
        begin_ns = min(int(block.log_ns.min()) for block in blocks)
        cut_ns = begin_ns + 4 * SECOND + 12_345_678
        by_ns = by_s * SECOND
        first = _replay(drive, tmp_path / "a", vehicle, Reset(log, cut_ns, last_ns=cut_ns))
        second = _replay(drive, tmp_path / "b", vehicle, Reset(log, cut_ns, first_ns=cut_ns))
        whole = _replay(drive, tmp_path / "whole", vehicle, Reset(log, cut_ns, by_ns))

    assert len(whole.segments) == 2
    assert whole.exit_status == 3
    assert whole.travelled_m == pytest.approx(first.travelled_m + second.travelled_m, abs=1e-9)
    assert _cues(whole, 0) == _cues(first)
    assert _cues(whole, 1) == _cues(second)
    for name in ("frames", "detections", "road", "cues", "range", "belief", "pose", "skipped"):
        assert {"segment", "log_t_ns"} <= set(whole.run.schema(name).names)
    frames = whole.run.table("frames")
    assert np.all(np.diff(frames["t_ns"].to_numpy()) > 0)
    assert set(frames["segment"].to_pylist()) == {0, 1}
