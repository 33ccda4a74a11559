"""Landmark database: features of pictures with positions and covariances, in one SQLite file.

An R*Tree over positions answers queries by 2-sigma ellipse, so that a million landmarks need disk
space but no memory. The file uses SQLite's rollback journal: if a process dies while writing, the
earlier landmarks remain, and reading needs no second file. All additions of one writer are one
transaction.

Every landmark has a CRC-32 over place and features, which is verified when its features are read.

A file is rejected unless it has crosscue's ``application_id``, this version as ``user_version``,
the length that its header specifies, and exactly the expected tables.
"""

import errno
import heapq
import math
import os
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple, Self, cast
from urllib.parse import quote

import numpy as np

from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogError, LogFormatError, OutputError, UsageError
from crosscue.replay.files.closing import Closing
from crosscue.replay.files.whole_file import cannot_write

from .features import Keypoints

# Maximum sigmas of a search: the R*Tree's boxes include this many of each landmark's own.
REACH_SIGMAS: Final = 4.0
MAX_POINTS: Final = 20_000
MAX_TEXT: Final = 1024

_COLUMNS: Final = (
    "l.id, l.name, l.x_m, l.y_m, l.var_x_m2, l.cov_xy_m2, l.var_y_m2, l.heading_rad, l.source"
)

# ``CCLM`` in the file's header.
APPLICATION_ID: Final = 0x43434C4D
VERSION: Final = 1
_MAX_BYTES: Final = 16 << 20
_BUSY_S: Final = 5.0
_HEADER: Final = b"SQLite format 3\0"
TABLES: Final = (
    "CREATE TABLE setting (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID",
    "CREATE TABLE landmark (id INTEGER PRIMARY KEY, name TEXT NOT NULL UNIQUE, "
    "x_m REAL NOT NULL, y_m REAL NOT NULL, "
    "var_x_m2 REAL NOT NULL, cov_xy_m2 REAL NOT NULL, var_y_m2 REAL NOT NULL, "
    "heading_rad REAL, source TEXT NOT NULL)",
    "CREATE TABLE picture (id INTEGER PRIMARY KEY, width_px INTEGER NOT NULL, "
    "height_px INTEGER NOT NULL, points INTEGER NOT NULL, points_px BLOB NOT NULL, "
    "descriptors BLOB NOT NULL, crc INTEGER NOT NULL)",
    "CREATE VIRTUAL TABLE place USING rtree(id, min_x, max_x, min_y, max_y)",
)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkPosition:
    """Position of the camera when a picture was taken, in the map frame.

    Attributes:
        name: Name, unique in its database.
        xy_m: Position, shape (2,).
        cov_m2: Covariance, shape (2, 2), positive definite. It includes the error of ``xy_m`` and
            the distance at which pictures still match.
        heading_rad: Heading of the car, or None where unknown.
        source: Origin of the picture: a log or a folder.
    """

    name: str
    xy_m: Floats
    cov_m2: Floats
    heading_rad: float | None = None
    source: str = ""

    def __post_init__(self) -> None:
        """Validate the place.

        Raises:
            ValueError: A name is empty or too long, a shape is wrong, a number is not finite, or
                the covariance is not positive definite.
        """
        if not 0 < len(self.name) <= MAX_TEXT or len(self.source) > MAX_TEXT:
            raise ValueError(f"name, source: expected up to {MAX_TEXT} letters, got {self.name!r}")
        if not _is_unicode(self.name + self.source):
            raise ValueError(f"name, source: expected Unicode, got {self.name!r}, {self.source!r}")
        if self.xy_m.shape != (2,) or self.cov_m2.shape != (2, 2):
            shapes = f"{self.xy_m.shape}, {self.cov_m2.shape}"
            raise ValueError(
                f"landmark {self.name}: expected xy_m (2,), cov_m2 (2, 2), got {shapes}"
            )
        numbers = (*self.xy_m, *self.cov_m2.ravel(), self.heading_rad or 0.0)
        if not np.isfinite(numbers).all():
            raise ValueError(
                f"landmark {self.name}: expected finite numbers, got {self.xy_m.tolist()}, "
                f"{self.cov_m2.tolist()}, heading {self.heading_rad}"
            )
        if not is_positive(self.cov_m2):
            raise ValueError(
                f"landmark {self.name}: covariance: expected symmetric and positive definite, "
                f"got {self.cov_m2.tolist()}"
            )


def _is_unicode(text: str) -> bool:
    """Whether a text can be stored; surrogates, as in file names that are not UTF-8, cannot."""
    return not any("\ud800" <= c <= "\udfff" for c in text)


def is_positive(cov_m2: Floats) -> bool:
    """Whether a finite 2x2 matrix is symmetric and positive definite, by more than rounding."""
    (xx, xy), (yx, yy) = cov_m2
    return bool(
        math.isclose(xy, yx, rel_tol=1e-9, abs_tol=1e-300)
        and xx > 0.0
        and yy > 0.0
        and xx * yy - xy * xy > 1e-12 * xx * yy
    )


class Nearby(NamedTuple):
    """A landmark inside a search ellipse.

    Attributes:
        key: Key for ``LandmarkDatabase.features``.
        place: Place of the landmark.
        sigmas: Distance from the ellipse's centre in standard deviations.
    """

    key: int
    place: LandmarkPosition
    sigmas: float


class LandmarkDatabase(Closing):
    """A landmark database open for reading. Use it as a context manager.

    Attributes:
        path: The file.
        kind: Name of the matcher of its features.
    """

    def __init__(self, path: Path) -> None:
        """Open and check the file.

        Raises:
            LogError: The file is missing or cannot be read.
            LogFormatError: The file is of another kind or version, truncated, or damaged.
        """
        self.path: Final = path
        check_length(path)
        self._sql: Final = connect_reading(path)
        try:
            with errors_in_one_line(path):
                check_ours(self._sql, path)
                self.kind: Final = matcher_name(self._sql, path)
        except BaseException:
            self._sql.close()
            raise

    def __len__(self) -> int:
        with errors_in_one_line(self.path):
            return int(self._sql.execute("SELECT count(*) FROM landmark").fetchone()[0])

    def near(
        self, xy_m: Floats, cov_m2: Floats, sigmas: float = 2.0, max_count: int = 50
    ) -> tuple[Nearby, ...]:
        """Find the landmarks inside the ellipse around a position, nearest (in sigmas) first.

        The distance is that of Mahalanobis, with the sum of the ellipse's covariance and the
        landmark's.

        Args:
            xy_m: Shape (2,): estimated position of the camera.
            cov_m2: Shape (2, 2): its covariance, which can be singular.
            sigmas: Size of the ellipse, at most ``REACH_SIGMAS``.
            max_count: Maximum number of landmarks to return.

        Raises:
            ValueError: ``sigmas`` is out of range, or a number is not finite.
            LogFormatError: The file is damaged.
        """
        if not 0.0 < sigmas <= REACH_SIGMAS:
            raise ValueError(f"sigmas: expected 0 to {REACH_SIGMAS}, got {sigmas}")
        if not (np.isfinite(xy_m).all() and np.isfinite(cov_m2).all()):
            raise ValueError(f"near: expected finite numbers, got {xy_m}, {cov_m2}")
        # An R*Tree stores 32-bit floats, rounded outwards, so the query is rounded outwards, too.
        reach = sigmas * np.sqrt(np.maximum(np.diagonal(cov_m2), 0.0))
        margin = 1e-6 * np.abs(xy_m) + 1e-6
        low, high = (xy_m - reach - margin).tolist(), (xy_m + reach + margin).tolist()
        with errors_in_one_line(self.path):
            rows = self._sql.execute(
                f"SELECT {_COLUMNS} FROM place AS p JOIN landmark AS l ON l.id = p.id "  # noqa: S608
                "WHERE p.max_x >= ? AND p.min_x <= ? AND p.max_y >= ? AND p.min_y <= ?",
                (low[0], high[0], low[1], high[1]),
            )
            found = (self._nearby(row, xy_m, cov_m2) for row in rows)
            inside = (one for one in found if one.sigmas <= sigmas)
            return tuple(heapq.nsmallest(max_count, inside, key=lambda one: (one.sigmas, one.key)))

    def within(self, xy_m: Floats, radius_m: float) -> Iterator[Nearby]:
        """Yield the landmarks within ``radius_m`` of a position, in the order of their addition."""
        low, high = (xy_m - radius_m).tolist(), (xy_m + radius_m).tolist()
        with errors_in_one_line(self.path):
            rows = self._sql.execute(
                f"SELECT {_COLUMNS} FROM landmark AS l WHERE "  # noqa: S608
                "x_m BETWEEN ? AND ? AND y_m BETWEEN ? AND ? ORDER BY id",
                (low[0], high[0], low[1], high[1]),
            )
            for row in rows:
                one = self._nearby(row, xy_m, np.zeros((2, 2)))
                if math.dist(one.place.xy_m, xy_m) <= radius_m:
                    yield one

    def __iter__(self) -> Iterator[Nearby]:
        """Yield all landmarks in the order of their addition; ``sigmas`` is 0."""
        with errors_in_one_line(self.path):
            for row in self._sql.execute(f"SELECT {_COLUMNS} FROM landmark AS l ORDER BY id"):  # noqa: S608
                yield Nearby(cast("int", row[0]), _place(row, self.path), 0.0)

    def features(self, key: int) -> Keypoints:
        """Read the features of one landmark and verify its checksum.

        Raises:
            LogFormatError: The features are missing or damaged.
        """
        with errors_in_one_line(self.path):
            row = self._sql.execute(
                f"SELECT {_COLUMNS}, width_px, height_px, points, points_px, descriptors, crc "  # noqa: S608
                "FROM landmark AS l JOIN picture AS f ON f.id = l.id WHERE l.id = ?",
                (key,),
            ).fetchone()
        if row is None:
            raise damaged(self.path, f"landmark {key} has no picture")
        place = _place(row[:9], self.path)
        width, height, points, points_px, descriptors, crc = row[9:]
        if crc != _crc(place, width, height, points_px, descriptors):
            raise damaged(self.path, f"landmark {place.name}: its checksum does not match")
        try:
            at = np.frombuffer(points_px, "<f4").reshape(points, 2)
            per = len(descriptors) // points if points else 0
            table = np.frombuffer(descriptors, np.uint8).reshape(points, per)
            return Keypoints(width, height, at.astype(np.float32), table)
        except (TypeError, ValueError) as error:
            raise damaged(self.path, f"landmark {place.name}: {error}") from None

    def close(self) -> None:
        """Release the file."""
        self._sql.close()

    def _nearby(self, row: tuple[object, ...], xy_m: Floats, cov_m2: Floats) -> Nearby:
        place = _place(row, self.path)
        (a, b), (_, d) = place.cov_m2 + cov_m2
        dx, dy = place.xy_m - xy_m
        squared = (d * dx * dx - 2.0 * b * dx * dy + a * dy * dy) / (a * d - b * b)
        return Nearby(cast("int", row[0]), place, math.sqrt(max(float(squared), 0.0)))


class LandmarkWriter:
    """Adds landmarks to a new or existing database, all or none. Use it as a context manager.

    The block commits when it ends without an error; otherwise, the file remains unchanged.
    """

    def __init__(self, path: Path, kind: str) -> None:
        """Open or create the file.

        Args:
            path: The file.
            kind: Name of the matcher that made the features.

        Raises:
            LogFormatError: The existing file is of another kind or version, or truncated.
            UsageError: The file holds another matcher's features.
            OutputError: The file cannot be written, or another process is writing it.
        """
        self._path: Final = path
        self._is_new: Final = not path.exists() or path.stat().st_size == 0
        self._is_ours_to_remove: Final = not path.exists()
        if not self._is_new:
            check_length(path)
        try:
            self._sql: Final = connect(path, "rwc")
        except LogError as error:
            raise OutputError(str(error)) from None
        try:
            with errors_in_one_line(path, writing=True):
                self._begin(kind)
        except BaseException:
            self._abandon()
            raise

    def add(self, place: LandmarkPosition, features: Keypoints) -> None:
        """Add one landmark.

        Raises:
            UsageError: A landmark of this name already exists.
            OutputError: The disk is full.
        """
        if len(features) > MAX_POINTS:
            raise ValueError(f"features: expected up to {MAX_POINTS} points, got {len(features)}")
        (xx, xy), (_, yy) = place.cov_m2.tolist()
        x, y = place.xy_m.tolist()
        points_px = features.points_px.astype("<f4").tobytes()
        descriptors = features.descriptors.tobytes()
        width, height = features.width_px, features.height_px
        crc = _crc(place, width, height, points_px, descriptors)
        reach_x, reach_y = REACH_SIGMAS * math.sqrt(xx), REACH_SIGMAS * math.sqrt(yy)
        with errors_in_one_line(self._path, writing=True):
            try:
                key = self._sql.execute(
                    "INSERT INTO landmark VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?)",
                    (place.name, x, y, xx, xy, yy, place.heading_rad, place.source),
                ).lastrowid
            except sqlite3.IntegrityError:
                raise UsageError(
                    f"{self._path}: a landmark {place.name!r} already exists; "
                    "use another --source, or another database"
                ) from None
            self._sql.execute(
                "INSERT INTO picture VALUES (?, ?, ?, ?, ?, ?, ?)",
                (key, width, height, len(features), points_px, descriptors, crc),
            )
            box = (key, x - reach_x, x + reach_x, y - reach_y, y + reach_y)
            self._sql.execute("INSERT INTO place VALUES (?, ?, ?, ?, ?)", box)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            self._abandon()
            return
        try:
            with errors_in_one_line(self._path, writing=True):
                self._sql.execute("COMMIT")
        except BaseException:
            self._abandon()
            raise
        self._sql.close()

    def _begin(self, kind: str) -> None:
        # EXTRA: the deletion of the journal, which is the commit, survives a power failure, too.
        self._sql.execute("PRAGMA synchronous = EXTRA")
        self._sql.execute("BEGIN IMMEDIATE")
        if self._is_new:
            for sql in TABLES:
                self._sql.execute(sql)
            self._sql.execute("INSERT INTO setting VALUES ('matcher', ?)", (kind,))
            self._sql.execute(f"PRAGMA application_id = {APPLICATION_ID}")
            self._sql.execute(f"PRAGMA user_version = {VERSION}")
        check_ours(self._sql, self._path)
        there = matcher_name(self._sql, self._path)
        if there != kind:
            raise UsageError(
                f"{self._path}: holds features of matcher {there!r}, not {kind!r}; "
                f"set landmarks.matcher = {there!r} in the vehicle file, or choose another database"
            )

    def _abandon(self) -> None:
        """Roll back; a newly created file is deleted."""
        # If even this fails, a journal remains, and the next process to open the file rolls back.
        with suppress(sqlite3.Error):
            self._sql.execute("ROLLBACK")
        self._sql.close()
        if self._is_ours_to_remove:
            self._path.unlink(missing_ok=True)
            journal_of(self._path).unlink(missing_ok=True)


def _place(row: tuple[object, ...], path: Path) -> LandmarkPosition:
    try:
        _, name, x, y, xx, xy, yy, heading, source = row
        cov = np.array([[xx, xy], [xy, yy]], np.float64)
        turn = None if heading is None else float(str(heading))
        return LandmarkPosition(str(name), np.array([x, y], np.float64), cov, turn, str(source))
    except (TypeError, ValueError) as error:
        raise damaged(path, str(error)) from None


def _crc(
    place: LandmarkPosition, width: int, height: int, points_px: bytes, descriptors: bytes
) -> int:
    heading = math.nan if place.heading_rad is None else place.heading_rad
    (xx, xy), (_, yy) = place.cov_m2
    crc = zlib.crc32(place.name.encode("utf-8", "surrogatepass"))
    crc = zlib.crc32(struct.pack("<6dqq", *place.xy_m, xx, xy, yy, heading, width, height), crc)
    return zlib.crc32(descriptors, zlib.crc32(points_px, crc))


def connect_reading(path: Path) -> sqlite3.Connection:
    """Open for reading; the journal of an interrupted writer is rolled back first.

    Raises:
        LogError: The file cannot be opened.
    """
    sql = connect(path, "rw" if journal_of(path).exists() else "ro")
    sql.execute("PRAGMA query_only = ON")
    return sql


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """Open in one of SQLite's modes ``ro``, ``rw``, ``rwc``.

    Raises:
        LogError: The file cannot be opened.
    """
    # Percent-encoded, because '%41', '?' and '#' in a file name would open another file.
    uri = f"file:{quote(str(path.absolute()), errors='surrogateescape')}?mode={mode}"
    try:
        sql = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=_BUSY_S)
        sql.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_BYTES)
        sql.execute("PRAGMA trusted_schema = OFF")
    except sqlite3.Error as error:
        raise LogError(f"{path}: {error}; check the path and its mode") from None
    return sql


def check_length(path: Path) -> None:
    """Compare the file's length with the one in its header.

    Raises:
        LogError: The file cannot be read.
        LogFormatError: The file is not an SQLite file, or truncated.
    """
    try:
        length = path.stat().st_size
        if not path.is_file():
            raise LogError(f"{path}: not a regular file; expected a landmark database")
        with path.open("rb") as file:
            header = file.read(100)
    except OSError as error:
        raise LogError(
            f"{path}: {error.strerror}; make a landmark database with: crosscue landmarks add"
        ) from None
    if len(header) < 100 or not header.startswith(_HEADER):
        raise LogFormatError(f"{path}: not SQLite; expected a landmark database")
    (page,) = struct.unpack_from(">H", header, 16)
    changes, pages = struct.unpack_from(">II", header, 24)
    page = 65_536 if page == 1 else page
    (valid_for,) = struct.unpack_from(">I", header, 92)
    # Before a journal is rolled back, the header cannot be trusted.
    is_settled = changes == valid_for and not journal_of(path).exists()
    if is_settled and length < pages * page:
        raise LogFormatError(
            f"{path}: cut short: {length:,} of {pages * page:,} bytes; copy it again, or build it "
            "again with: crosscue landmarks add"
        )


def journal_of(path: Path) -> Path:
    """Path of SQLite's rollback journal."""
    return path.with_name(path.name + "-journal")


def check_ours(sql: sqlite3.Connection, path: Path) -> None:
    """Check that the file is a landmark database of this version.

    Raises:
        LogFormatError: It is not.
    """
    application = sql.execute("PRAGMA application_id").fetchone()[0]
    if application != APPLICATION_ID:
        raise LogFormatError(f"{path}: another SQLite file; expected a landmark database")
    version = sql.execute("PRAGMA user_version").fetchone()[0]
    if version != VERSION:
        raise LogFormatError(
            f"{path}: landmark database of version {version}, this crosscue reads {VERSION}; "
            "build it again with: crosscue landmarks add"
        )
    found = sql.execute(
        "SELECT sql FROM sqlite_schema WHERE sql IS NOT NULL AND name NOT GLOB 'place_*'"
    ).fetchall()
    if sorted(str(row[0]) for row in found) != sorted(TABLES):
        raise damaged(path, "its tables are not those of version 1")


def matcher_name(sql: sqlite3.Connection, path: Path) -> str:
    """Read the name of the matcher of its features."""
    row = sql.execute("SELECT value FROM setting WHERE key = 'matcher'").fetchone()
    if row is None:
        raise damaged(path, "the name of its matcher is missing")
    return str(row[0])


def damaged(path: Path, why: str) -> LogFormatError:
    """Return the error for an inconsistent file."""
    return LogFormatError(
        f"{path}: damaged: {why}; copy it again, or build it again with: crosscue landmarks add"
    )


@contextmanager
def errors_in_one_line(path: Path, *, writing: bool = False) -> Iterator[None]:
    """Convert SQLite's errors to crosscue's."""
    try:
        yield
    except UnicodeDecodeError as error:
        raise damaged(path, str(error)) from None
    except sqlite3.Error as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            raise damaged(path, str(error)) from None
        if code == sqlite3.SQLITE_BUSY:
            raise OutputError(
                f"{path}: another process is writing it; wait until it is done"
            ) from None
        if code == sqlite3.SQLITE_FULL:
            full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            raise cannot_write(path, full) from None
        if writing:
            raise OutputError(f"{path}: {error}; choose a writable folder") from None
        raise LogFormatError(f"{path}: {error}; check the file and its folder") from None
