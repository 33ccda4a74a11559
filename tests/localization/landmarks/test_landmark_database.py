"""Tests of the landmark database: round trip, queries by ellipse, and damaged files."""

import resource
import signal
import sqlite3
import subprocess
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from crosscue.localization.landmarks.database import (
    LandmarkDatabase,
    LandmarkPosition,
    LandmarkWriter,
)
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogError, LogFormatError, OutputError
from support.commands import python
from support.landmark_files import database_of, place_at, some_features


def _in_child(
    path: Path, count: int, *more: str, max_bytes: int | None = None
) -> subprocess.CompletedProcess[str]:
    def limit() -> None:
        if max_bytes is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))

    return python(WRITE_MANY, path, count, *more, preexec_fn=limit)


GRID = np.stack(np.meshgrid(np.arange(10.0), np.arange(10.0)), axis=-1).reshape(-1, 2) * 50.0


def test_places_and_features_survive_a_round_trip(tmp_path: Path) -> None:
    cov = np.array([[4.0, 1.0], [1.0, 9.0]])
    place = LandmarkPosition("north\nwest ☃", np.array([4.1e5, 5.3e6]), cov, -1.25, "survey")
    given_features = some_features(3)
    with LandmarkWriter(tmp_path / "lm.sqlite", "orb") as writer:
        writer.add(place, given_features)
        writer.add(LandmarkPosition("no heading", np.zeros(2), cov), some_features(4, 0))

    with LandmarkDatabase(tmp_path / "lm.sqlite") as database:
        first, second = list(database)
        found = database.features(first.key)
        assert len(database) == 2
        assert database.kind == "orb"
        assert len(database.features(second.key)) == 0

    assert (first.place.name, first.place.source) == ("north\nwest ☃", "survey")
    assert first.place.heading_rad == -1.25
    assert second.place.heading_rad is None
    np.testing.assert_array_equal(first.place.xy_m, place.xy_m)
    np.testing.assert_array_equal(first.place.cov_m2, cov)
    np.testing.assert_array_equal(found.points_px, given_features.points_px)
    np.testing.assert_array_equal(found.descriptors, given_features.descriptors)


@pytest.fixture(scope="module")
def grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return database_of(tmp_path_factory.mktemp("grid") / "grid.sqlite", GRID + 5e6)


@given(
    x=st.floats(-50.0, 550.0),
    y=st.floats(-50.0, 550.0),
    sd=st.tuples(st.floats(0.0, 200.0), st.floats(0.0, 200.0)),
    correlation=st.floats(-1.0, 1.0),
    sigmas=st.floats(0.1, 4.0),
)
def test_ellipse_query_matches_an_exhaustive_search(
    grid: Path, x: float, y: float, sd: tuple[float, float], correlation: float, sigmas: float
) -> None:
    off = correlation * sd[0] * sd[1]
    cov = np.array([[sd[0] ** 2, off], [off, sd[1] ** 2]])
    centre = np.array([x, y]) + 5e6
    apart = GRID + 5e6 - centre
    distance = np.sqrt(np.einsum("ni,ij,nj->n", apart, np.linalg.inv(cov + 4.0 * np.eye(2)), apart))
    sure = np.abs(distance - sigmas) > 1e-6

    with LandmarkDatabase(grid) as database:
        found = database.near(centre, cov, sigmas, max_count=1000)

    names = {int(one.place.name) for one in found}
    assert names >= set(np.flatnonzero(sure & (distance < sigmas)).tolist())
    assert not names & set(np.flatnonzero(sure & (distance > sigmas)).tolist())
    assert [one.sigmas for one in found] == sorted(one.sigmas for one in found)


@pytest.mark.parametrize(
    ("cov", "message"),
    [
        ([[1.0, 2.0], [2.0, 1.0]], "positive definite"),
        ([[0.0, 0.0], [0.0, 1.0]], "positive definite"),
        ([[-1.0, 0.0], [0.0, -1.0]], "positive definite"),
        ([[1.0, 0.5], [0.0, 1.0]], "symmetric"),
        ([[1.0, 0.0], [0.0, np.inf]], "finite"),
        ([[np.nan, 0.0], [0.0, 1.0]], "finite"),
    ],
)
def test_invalid_covariance_is_refused(cov: list[list[float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LandmarkPosition("bad", np.zeros(2), np.array(cov))


@pytest.mark.parametrize(
    ("change", "message"),
    [("x_m = 9e999", "finite"), ("var_x_m2 = -1.0", "landmark 0: covariance.*positive definite")],
)
def test_landmark_in_the_file_that_no_update_can_use_is_damage(
    grid: Path, tmp_path: Path, change: str, message: str
) -> None:
    copy = tmp_path / "damaged.db"
    copy.write_bytes(grid.read_bytes())
    with closing(sqlite3.connect(copy)) as sql, sql:
        sql.execute(f"UPDATE landmark SET {change} WHERE id = 1")

    with LandmarkDatabase(copy) as database, pytest.raises(LogFormatError, match=message):
        list(database)


@pytest.mark.parametrize("fraction", [0.5, 0.02, 0.99])
def test_truncated_file_is_refused_and_unchanged(
    grid: Path, tmp_path: Path, fraction: float
) -> None:
    whole = grid.read_bytes()
    cut = tmp_path / "cut.sqlite"
    cut.write_bytes(whole[: int(fraction * len(whole))])

    with pytest.raises(LogFormatError, match=r"cut\.sqlite: cut short: .* build it again"):
        LandmarkDatabase(cut)
    with pytest.raises(LogFormatError, match="cut short"):
        LandmarkWriter(cut, "orb")
    assert cut.read_bytes() == whole[: int(fraction * len(whole))]


def test_changed_coordinates_are_found(tmp_path: Path) -> None:
    path = database_of(tmp_path / "lm.sqlite", GRID[:3])
    with closing(sqlite3.connect(path)) as sql, sql:
        sql.execute("UPDATE landmark SET x_m = x_m + 1 WHERE id = 2")

    with LandmarkDatabase(path) as database, pytest.raises(LogFormatError, match="checksum"):
        database.features(2)


@given(st.integers(0, 10_000), st.integers(1, 255))
@example(where=3379, flip=128)
def test_damaged_byte_is_refused_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, where: int, flip: int
) -> None:
    path = tmp_path_factory.mktemp("hurt") / "lm.sqlite"
    whole = bytearray(database_of(path, GRID[:4]).read_bytes())
    whole[where % len(whole)] ^= flip
    path.write_bytes(whole)

    try:
        with LandmarkDatabase(path) as database:
            for one in database:
                read = database.features(one.key)
                if one.place.name.isdigit() and int(one.place.name) < 4:
                    right = some_features(int(one.place.name))
                    np.testing.assert_array_equal(read.descriptors, right.descriptors)
    except LogError as refused:
        message = str(refused)
        assert message.startswith(str(path))


def test_second_concurrent_writer_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("crosscue.localization.landmarks.database._BUSY_S", 0.05)
    path = database_of(tmp_path / "lm.sqlite", GRID[:1])

    with LandmarkWriter(path, "orb") as first:
        with pytest.raises(OutputError, match="another process is writing it"):
            LandmarkWriter(path, "orb")
        first.add(place_at(1.0, 1.0, "more"), some_features(9))
    with LandmarkDatabase(path) as database:
        assert len(database) == 2


WRITE_MANY = """
import os, sys
from contextlib import closing
from pathlib import Path
from crosscue.localization.landmarks.database import LandmarkWriter
from support.landmark_files import place_at, some_features
with LandmarkWriter(Path(sys.argv[1]), "orb") as writer:
    writer._sql.execute("PRAGMA cache_size = 4")
    for i in range(int(sys.argv[2])):
        writer.add(place_at(float(i), 0.0, f"new {i}"), some_features(i, 200))
    os.kill(os.getpid(), 9)
"""


def test_killed_writer_leaves_previous_landmarks(tmp_path: Path) -> None:
    """A tiny cache writes pages to disk before the kill; the next read rolls them back."""
    path = database_of(tmp_path / "lm.sqlite", GRID[:3])
    before = path.stat().st_size

    assert _in_child(path, 200).returncode == -9
    assert path.stat().st_size > before
    assert (tmp_path / "lm.sqlite-journal").exists()

    with LandmarkDatabase(path) as database:
        assert [one.place.name for one in database] == ["0", "1", "2"]
        assert [len(database.features(one.key)) for one in database] == [20, 20, 20]
    assert [p.name for p in tmp_path.iterdir()] == ["lm.sqlite"]


def test_page_limit_is_reported_as_a_full_disk(tmp_path: Path) -> None:
    path = database_of(tmp_path / "lm.sqlite", GRID[:3])
    full = pytest.raises(OutputError, match=r"lm\.sqlite: the disk is full")

    with full, LandmarkWriter(path, "orb") as writer:
        writer._sql.execute("PRAGMA max_page_count = 1")
        for i in range(200):
            writer.add(place_at(1.0, 1.0, f"new {i}"), some_features(9, 200))
    with LandmarkDatabase(path) as database:
        assert len(database) == 3


def test_query_distance_includes_the_landmark_covariance(tmp_path: Path) -> None:
    positions: Floats = np.array([[30.0, 0.0]])
    sharp = database_of(tmp_path / "sharp.sqlite", positions, sd_m=1.0)
    vague = database_of(tmp_path / "vague.sqlite", positions, sd_m=20.0)
    cov = 100.0 * np.eye(2)

    with LandmarkDatabase(sharp) as database:
        assert database.near(np.zeros(2), cov) == ()
    with LandmarkDatabase(vague) as database:
        (one,) = database.near(np.zeros(2), cov)
    assert one.sigmas == pytest.approx(30.0 / np.sqrt(500.0))


def test_full_disk_is_reported_and_leaves_previous_landmarks(tmp_path: Path) -> None:
    """A size limit of the kernel has the effect of a full disk."""
    path = database_of(tmp_path / "lm.sqlite", GRID[:3])

    done = _in_child(path, 200, max_bytes=200_000)

    assert done.returncode == 1
    assert "OutputError" in done.stderr
    with LandmarkDatabase(path) as database:
        assert [len(database.features(one.key)) for one in database] == [20, 20, 20]
    fresh = tmp_path / "fresh.sqlite"
    assert "OutputError" in _in_child(fresh, 200, max_bytes=200_000).stderr
    assert [p.name for p in tmp_path.iterdir()] == ["lm.sqlite"]
