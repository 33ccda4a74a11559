"""Read a KITTI raw drive or one sequence of the tracking set as a log, with truth from the INS.

A raw drive has folders ``image_00`` to ``image_03`` and ``oxts``, each with ``data/`` (one file per
row) and ``timestamps.txt`` (UTC date-times to the nanosecond). The tracking set has one line of
``oxts/SEQ.txt`` and one picture ``image_0x/SEQ/NNNNNN.png`` for every frame, but no times. They are
computed from the frame number, with the rate at which the box's speeds match the distances between
its positions (9.65 Hz; 10 Hz for a stationary vehicle). The rate is reported.

Topics: one per camera folder; from the OXTS box ``oxts/imu``, ``oxts/gnss`` and ``oxts/ins_speed``.
Intrinsics are those of ``calib/SEQ.txt`` or of ``calib_cam_to_cam.txt`` in the folder of the raw
drive's day. Labels of the tracking set (``label_02/SEQ.txt``) become objects of the truth; a raw
drive's tracklets are not read.

All values of the box are outputs of one filter: ``ins_speed`` is not a wheel speed, and ``gnss`` is
not a raw fix.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.datasets.truth.truth import Origin
from crosscue.datasets.truth.tum import Trajectory, write_track_truth
from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Int64s, Table, Topic
from crosscue.replay.errors import LogFormatError
from crosscue.replay.ledger import NOT_ASKED_TIME, NOT_ASKED_TOPIC, Ledger
from crosscue.replay.limits import DEFAULT_LIMITS, Limits
from crosscue.replay.readers.held_rows import CameraDrive
from crosscue.replay.readers.images.files import PictureFiles, list_pictures
from crosscue.replay.readers.time_file import read_time_file
from crosscue.replay.readers.timed_files import TimedFiles, list_files, pair_with_times
from crosscue.replay.seal.touched import Touched, open_noted

from .kitti_files import COLUMNS, IMU, INS_SPEED, LINE_BYTES, Packets, parse_oxts, read_kitti_labels
from .kitti_odometry import BOX, SETUP, projection
from .published import camera_of, note_whole

# Default period of frames, if positions and speeds do not determine it.
TRACKING_PERIOD_NS: Final = 100_000_000
PERIOD_STEP_S: Final = 1e-4
# Max relative difference between the period and the published 10 Hz; more means damage.
MAX_PERIOD_ERROR: Final = 0.2
ROWS_PER_BLOCK: Final = 100
FRAMES_FOR_PERIOD: Final = 10_000
NO_TIMES: Final[Int64s] = np.zeros(0, np.int64)
# Topic, reason, count and detail of a stream that cannot be read.
Unreadable: TypeAlias = tuple[str, str, int | None, str]

# Position, time and bytes of a packet; a string in place of bytes is the reason for their loss.
Line: TypeAlias = tuple[str, int, bytes | str]

TOPICS: Final[dict[str, tuple[str, Callable[[Packets], Table]]]] = {
    "oxts/imu": ("sensor_msgs/msg/Imu", lambda packets: packets.table(IMU)),
    "oxts/gnss": ("sensor_msgs/msg/NavSatFix", lambda packets: packets.gnss()),
    "oxts/ins_speed": ("crosscue/Table", lambda packets: packets.table(INS_SPEED)),
}


@dataclass(frozen=True, slots=True, eq=False)
class Oxts:
    """Stored packets of the box: one file each, or one line each of a single file.

    Attributes:
        files: One file per packet, and times; for a single file, times of its lines.
        single: The single file, or None.
        period_ns: Time between two of its lines.
        touched: Record of the bytes read, for a seal.
    """

    files: TimedFiles
    single: Path | None = None
    period_ns: int = TRACKING_PERIOD_NS
    touched: Touched = field(default_factory=Touched, kw_only=True)

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics of the GNSS and inertial box."""
        return tuple(
            Topic(name, type_name, "columns", declared=self.files.declared)
            for name, (type_name, _) in TOPICS.items()
        )

    def read(self, ledger: Ledger, selection: Selection) -> Iterator[Block]:
        """Yield the rows of all signals, and account for them."""
        return _read_oxts(self, ledger, selection)

    def report_missing(self, ledger: Ledger) -> None:
        """Report packets without a time and times without a packet; see ``KnowsItsEnd``."""
        for name in TOPICS:
            ledger.drop(name, "a packet without its time", int(np.sum(self.files.t_ns < 0)))
            ledger.drop(name, "a time without its packet", len(self.files.missing_ns))

    def lines(self) -> Iterator[Line]:
        """Yield every packet in stored order."""
        if self.single is not None:
            yield from self._lines_of(self.single)
            return
        for path, t_ns in zip(self.files.paths, self.files.t_ns.tolist(), strict=True):
            try:
                with open_noted(path, self.touched) as file:
                    raw: bytes | str = file.read(LINE_BYTES)
            except OSError as error:
                raw = error.strerror or str(error)
            yield path.name, t_ns, raw

    def _lines_of(self, single: Path) -> Iterator[Line]:
        with open_noted(single, self.touched) as file:
            number = 0
            while raw := file.readline(LINE_BYTES):
                rest = raw
                while rest and not rest.endswith(b"\n"):
                    rest = file.readline(LINE_BYTES)
                yield f"{single.name} line {number + 1}", number * self.period_ns, raw
                number += 1


class KittiDrive(CameraDrive):
    """One drive as a ``Log``."""

    format: Final = "kitti-raw"

    @property
    def oxts(self) -> Oxts | None:
        """Packets of the GNSS and inertial box."""
        return next((one for one in self._numbers if isinstance(one, Oxts)), None)

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Read like ``CameraDrive.read``, and report that packets have no checksum."""
        yield from super().read(ledger, selection)
        ledger.integrity = "; ".join(
            part
            for part in (
                ledger.integrity if ledger.integrity != "not checked" else "",
                "OXTS text has no checksum" if self.oxts is not None else "",
            )
            if part
        )

    def intrinsics(self, camera: str) -> tuple[float, float, float] | None:
        """Return focal length and optical center of a rectified camera; None if not published.

        Raises:
            LogFormatError: The file is damaged.
        """
        single = self.oxts.single if self.oxts is not None else None
        if single is not None:
            file = self.path / "calib" / single.name
        else:
            file = self.path.resolve().parent / "calib_cam_to_cam.txt"
        return projection(file, str(int(camera.rpartition("_")[2])))


def open_kitti(path: Path, limits: Limits) -> KittiDrive:
    """Open a drive's folder; see ``crosscue.replay.formats.FORMATS``.

    Raises:
        LogFormatError: No stream has times, or there are several sequences in one folder.
    """
    if (path / "oxts" / "data").is_dir() or (path / "oxts" / "timestamps.txt").is_file():
        return _open_raw(path, limits)
    return _open_tracking(path, limits)


def write_kitti_truth(path: Path, folder: Path) -> Path:
    """Write the INS trajectory of a drive, relative to its first position.

    Raises:
        LogFormatError: There are fewer than two packets with times.
        OutputError: It cannot be written.
    """
    oxts = open_kitti(path, DEFAULT_LIMITS).oxts
    packets = _in_time_order(_packets(list(oxts.lines()))) if oxts is not None else None
    if packets is None or len(packets) < 2:
        raise LogFormatError(f"{path}/oxts: fewer than two packets; the drive contains no truth")
    latitude, longitude, altitude = (float(packets[name][0]) for name in ("lat", "lon", "alt"))
    xyz_m = geodetic_to_enu(
        packets["lat"], packets["lon"], packets["alt"], (latitude, longitude, altitude)
    )
    note = "KITTI OXTS: the GNSS/INS box in a local frame, x east, y north, z up"
    objects, lost = _objects(path, oxts, folder)
    return write_track_truth(
        folder,
        path.resolve().name,
        Trajectory(packets.t_ns, xyz_m, packets.attitude_wxyz()),
        note,
        pose_point="imu",
        mounting=BOX,
        mounting_source=SETUP,
        origin=Origin(latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude),
        source=(
            "KITTI: OXTS RT3003 GNSS/INS; the box's own position; "
            f"it claims {float(np.median(packets['pos_accuracy'])):.2g} m"
            + (f"; {lost} damaged labels are left out" if lost else "")
        ),
        objects=objects,
    )


def _objects(path: Path, oxts: Oxts | None, folder: Path) -> tuple[str | None, int]:
    """Write the labels of a tracking sequence next to the truth; return file and damaged count."""
    single = None if oxts is None else oxts.single
    if oxts is None or single is None or not (path / "label_02" / single.name).is_file():
        return None, 0
    pictures = path / "image_02" / single.stem
    found = read_kitti_labels(path / "label_02" / single.name, pictures, oxts.period_ns)
    return found.objects.save(folder, "KITTI tracking (CC BY-NC-SA 3.0): label_02"), found.lost


def _open_raw(path: Path, limits: Limits) -> KittiDrive:
    cameras: list[PictureFiles] = []
    unreadable: list[Unreadable] = []
    touched = Touched()
    for folder in sorted(path.glob("image_[0-9][0-9]")):
        files = _timed(folder, list_pictures, folder.name, unreadable, limits, touched)
        if files is not None:
            cameras.append(camera_of(folder.name, files, touched))
    lost: list[Unreadable] = []
    packets = _timed(
        path / "oxts", lambda place: list_files(place, (".txt",)), "oxts", lost, limits, touched
    )
    unreadable += [(name, *loss[1:]) for loss in lost for name in TOPICS]
    if not cameras and packets is None:
        why = unreadable[0][3] if unreadable else "no image_0x and no oxts with files in data/"
        raise LogFormatError(f"{path}: no stream of a KITTI raw drive can be read: {why}")
    notices = ["velodyne_points: laser scans are not read"]
    return KittiDrive(
        path,
        cameras,
        () if packets is None else (Oxts(packets, touched=touched),),
        limits,
        touched,
        unreadable=unreadable,
        notices=notices if (path / "velodyne_points").is_dir() else (),
    )


def _timed(
    folder: Path,
    listed: Callable[[Path], Sequence[Path]],
    topic: str,
    unreadable: list[Unreadable],
    limits: Limits,
    touched: Touched,
) -> TimedFiles | None:
    """Return the files of a stream with times, or None with a reason added to ``unreadable``."""
    time_file = folder / "timestamps.txt"
    paths = listed(folder / "data") if (folder / "data").is_dir() else []
    if not time_file.is_file():
        if paths:
            why = f"{folder.name}/timestamps.txt is missing; restore it"
            unreadable.append((topic, "rows without times", len(paths), why))
        return None
    try:
        note_whole(touched, time_file)
        times = read_time_file(time_file, limits)
        if paths:
            return pair_with_times(paths, times)
    except LogFormatError as error:
        unreadable.append((topic, "times cannot be read", len(paths) or None, str(error)))
        return None
    why = f"{folder.name}/data holds no file"
    unreadable.append((topic, "a time without its file", len(times.t_ns), why))
    return None


def _open_tracking(path: Path, limits: Limits) -> KittiDrive:
    singles = sorted((path / "oxts").glob("*.txt"))
    if len(singles) != 1:
        raise LogFormatError(
            f"{path}/oxts: {len(singles)} sequences; expected a folder with one of them, "
            "or a raw drive with oxts/timestamps.txt"
        )
    name = singles[0].stem
    cameras, touched = [], Touched()
    oxts = Oxts(TimedFiles((), NO_TIMES, NO_TIMES, None, ()), singles[0], touched=touched)
    period_s = _driven_period_s(oxts)
    if period_s is not None:
        oxts = replace(oxts, period_ns=round(period_s / PERIOD_STEP_S) * round(PERIOD_STEP_S * 1e9))
    for folder in sorted(path.glob(f"image_[0-9][0-9]/{name}")):
        paths = list_pictures(folder)
        if paths:
            t_ns = np.array(
                [_frame_ns(path.stem, oxts.period_ns) for path in paths], dtype=np.int64
            )
            files = TimedFiles(tuple(paths), t_ns, NO_TIMES, None, ())
            cameras.append(camera_of(folder.parent.name, files, touched))
    why = "as published" if period_s is None else "with which speeds match distances"
    notice = (
        f"{name}: the tracking set has no times; they are computed from frame numbers, "
        f"{oxts.period_ns * 1e-6:g} ms each ({why}), starting at 0"
    )
    return KittiDrive(path, cameras, (oxts,), limits, touched, notices=[notice])


def _driven_period_s(oxts: Oxts) -> float | None:
    """Return the time between frames for which the box's speeds match its distances."""
    packets = _packets(list(islice(oxts.lines(), FRAMES_FOR_PERIOD)))
    if len(packets) < 2:
        return None
    origin = (float(packets["lat"][0]), float(packets["lon"][0]), float(packets["alt"][0]))
    enu_m = geodetic_to_enu(packets["lat"], packets["lon"], packets["alt"], origin)
    way_m = float(np.hypot(*np.diff(enu_m[:, :2], axis=0).T).sum())
    speed_mps = np.hypot(packets["ve"], packets["vn"])
    speeds_mps = float((speed_mps[1:] + speed_mps[:-1]).sum()) / 2.0
    if speeds_mps <= len(packets):
        return None
    period_s, published_s = way_m / speeds_mps, TRACKING_PERIOD_NS * 1e-9
    return period_s if abs(period_s / published_s - 1.0) < MAX_PERIOD_ERROR else None


def _frame_ns(stem: str, period_ns: int) -> int:
    """Return the time of a numbered frame, or -1 for a name that is not a number."""
    is_number = stem.isascii() and stem.isdecimal() and len(stem) <= 9
    return int(stem) * period_ns if is_number else -1


def _read_oxts(oxts: Oxts, ledger: Ledger, selection: Selection) -> Iterator[Block]:
    for name in TOPICS:
        ledger.declare(name, oxts.files.declared)
    for sentence in oxts.files.notices:
        ledger.notice(sentence)
    lines = oxts.lines()
    while some := list(islice(lines, ROWS_PER_BLOCK)):
        packets = _packets(some)
        wanted = selection.inside(packets.t_ns) & (packets.t_ns >= 0)
        for name in TOPICS:
            _account(name, some, packets, wanted, ledger, selection)
        for name, (_, to_table) in TOPICS.items():
            if wanted.any() and selection.wants(name):
                yield Block(name, packets.t_ns, to_table(packets)).take(wanted)
    missing = oxts.files.missing_ns[selection.inside(oxts.files.missing_ns)]
    for name in TOPICS:
        ledger.drop(name, "a time without its packet", len(missing))
        if not selection.is_timed:
            ledger.settle(name)


def _account(
    name: str,
    some: Sequence[Line],
    packets: Packets,
    wanted: NDArray[np.bool_],
    ledger: Ledger,
    selection: Selection,
) -> None:
    n = len(packets)
    ledger.find(name, n)
    if not selection.wants(name):
        ledger.skip(name, NOT_ASKED_TOPIC, n)
    else:
        timeless = int(np.count_nonzero(packets.t_ns < 0))
        ledger.spoil(name, "a packet without its time", timeless)
        ledger.skip(name, NOT_ASKED_TIME, n - timeless - int(np.count_nonzero(wanted)))
    for place, t_ns, raw in some:
        why = raw if isinstance(raw, str) else parse_oxts(raw)
        if isinstance(why, str):
            ledger.drop(name, "not an OXTS packet", 1, f"{place}: {why}", t_ns)


def _packets(some: Sequence[Line]) -> Packets:
    good = [
        (t_ns, row)
        for _, t_ns, raw in some
        if not isinstance(raw, str) and not isinstance(row := parse_oxts(raw), str)
    ]
    rows = np.array([row for _, row in good], dtype=np.float64).reshape(-1, len(COLUMNS))
    return Packets(np.array([t_ns for t_ns, _ in good], dtype=np.int64), rows)


def _in_time_order(packets: Packets) -> Packets:
    _, first = np.unique(packets.t_ns, return_index=True)
    return packets.take(first[packets.t_ns[first] >= 0])
