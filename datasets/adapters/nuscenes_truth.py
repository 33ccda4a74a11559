"""Write the truth of a nuScenes scene: ego trajectory, boxes in front key frames, intersections.

Intersections are those of the map expansion, if it is in ``maps/expansion`` of the data root.

A box is the rectangle around the corners of a cuboid, which must all be ahead of the camera. It is
wider than the visible part, and exists for hidden cars as well (``visible`` is the middle of the
data set's four bins, over all six cameras). ``motion`` is the attribute of vehicles: moving,
stopped or parked.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from crosscue.datasets.truth.coco import Objects
from crosscue.datasets.truth.map_approaches import write_approaches
from crosscue.datasets.truth.truth import Mounting
from crosscue.datasets.truth.tum import Trajectory, write_track_truth
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogFormatError

from .nuscenes import (
    FRONT,
    Scene,
    SceneTables,
    ego_poses,
    find_scene,
    matrix_of,
    numbers,
    read_scene_tables,
)
from .nuscenes_map import read_expansion
from .nuscenes_tables import Row, RowsOf, checked, whole_table

# COCO's names by prefix of a category; other categories keep their names.
LABELS: Final = (
    ("vehicle.car", "car"),
    ("vehicle.truck", "truck"),
    ("vehicle.bus", "bus"),
    ("vehicle.emergency.police", "car"),
    ("vehicle.emergency.ambulance", "truck"),
    ("vehicle.motorcycle", "motorcycle"),
    ("vehicle.bicycle", "bicycle"),
    ("human.pedestrian", "person"),
)
VISIBLE: Final = {"1": 0.2, "2": 0.5, "3": 0.7, "4": 0.9}
NEAREST_M: Final = 0.5


class _Camera(NamedTuple):
    map_r_camera: Rotation
    place_m: Floats
    map_r_car: Rotation
    car_m: Floats
    focal_px: float
    center_px: tuple[float, float]


def write_nuscenes_truth(path: Path, folder: Path) -> Path:
    """Write the truth of a scene.

    Raises:
        LogFormatError: There are no poses, or a table is damaged.
        OutputError: It cannot be written.
    """
    tables = read_scene_tables(find_scene(path))
    poses = ego_poses(tables)
    folder.mkdir(parents=True, exist_ok=True)
    objects, lost = _objects(tables)
    what = "nuScenes (Motional; CC BY-NC-SA 4.0)"
    track = Trajectory(poses.t_ns, poses.xyz_m, poses.wxyz)
    on_map, of_map = _intersections(tables.scene, track, folder)
    return write_track_truth(
        folder,
        tables.scene.name,
        track,
        "nuScenes: the ego frame, the middle of the rear axle, in its map's axes",
        pose_point="rear_axle",
        mounting=Mounting(),
        mounting_source="nuScenes: the ego frame's origin is the middle of the rear axle",
        source=(
            f"{what}: ego poses (localised against a map by laser, in the plane); boxes of key "
            f"frames in {FRONT}"
            + (f"; {lost} damaged annotations are left out" if lost else "")
            + f"; {of_map}"
        ),
        objects=objects.save(folder, f"{what}: cuboids as seen by {FRONT}"),
        **on_map,
    )


def _intersections(
    scene: Scene, track: Trajectory, folder: Path
) -> tuple[Mapping[str, object], str]:
    """Return the fields of the truth that the map fills, and a sentence on it."""
    of_scene = whole_table(scene.tables / "scene.json", "name")[scene.token]
    logs = scene.tables / "log.json"
    log = whole_table(logs).get(str(of_scene.get("log_token"))) if logs.is_file() else None
    if log is None or not isinstance(log.get("location"), str):
        return {}, f"no intersections: {logs.name} does not tell the scene's location"
    path = scene.root / "maps" / "expansion" / f"{Path(log['location']).name}.json"
    if not path.is_file():
        where = path.relative_to(scene.root).as_posix()
        return {}, f"no intersections: {where} is missing (nuScenes' map expansion)"
    return write_approaches(track, read_expansion(path), path.name, folder)


def _objects(tables: SceneTables) -> tuple[Objects, int]:
    """Return boxes of the front camera's key frames, and the number of damaged rows."""
    folder = tables.scene.tables
    attributes, categories = (
        {token: str(row["name"]) for token, row in whole_table(folder / name, "name").items()}
        for name in ("attribute.json", "category.json")
    )
    table = RowsOf(checked(folder / "sample_annotation.json"))
    of_sample: dict[str, list[Row]] = {}
    for row in table:
        if row.get("sample_token") in tables.samples:
            of_sample.setdefault(str(row["sample_token"]), []).append(row)
    labels = _labels(folder, of_sample, categories)
    objects, bad = Objects(), 0
    tracks: dict[str, int] = {}
    for row, camera in _key_frames(tables):
        size_px = (int(row.get("width") or 1600), int(row.get("height") or 900))
        objects.add_image(str(row["filename"]), size_px, t_ns=int(row["timestamp"]) * 1000)
        for one in of_sample.get(str(row["sample_token"]), ()):
            xyz, size = numbers(one.get("translation"), 3), numbers(one.get("size"), 3)
            wxyz = numbers(one.get("rotation"), 4)
            if xyz is None or size is None or wxyz is None:
                bad += 1
                continue
            turn = Rotation.from_quat(np.roll(wxyz, -1))
            box = _box_px(np.array(xyz), np.array(size), turn, camera)
            if box is None:
                continue
            named = [attributes.get(str(t), "") for t in one.get("attribute_tokens", ())]
            motion = [name.partition(".")[2] for name in named if name.startswith("vehicle.")]
            in_car = camera.map_r_car.inv()
            ahead_m, left_m, _ = in_car.apply(np.array(xyz) - camera.car_m).tolist()
            instance = str(one.get("instance_token"))
            objects.add(
                labels.get(instance, "unknown"),
                box,
                track_id=tracks.setdefault(instance, len(tracks) + 1),
                visible=VISIBLE.get(str(one.get("visibility_token"))),
                motion=motion[0] if motion else None,
                x_m=round(ahead_m, 3),
                y_m=round(left_m, 3),
                heading_rad=round(float((in_car * turn).as_euler("zyx")[0]), 4),
            )
    return objects, bad + table.damaged


def _labels(
    folder: Path, of_sample: Mapping[str, list[Row]], categories: Mapping[str, str]
) -> dict[str, str]:
    wanted = {str(row.get("instance_token")) for rows in of_sample.values() for row in rows}
    found = {}
    for row in RowsOf(checked(folder / "instance.json")):
        if row.get("token") in wanted:
            name = categories.get(str(row.get("category_token")), "unknown")
            ours = next((label for begins, label in LABELS if name.startswith(begins)), name)
            found[str(row["token"])] = ours
    return found


def _key_frames(tables: SceneTables) -> Iterator[tuple[Row, _Camera]]:
    rows = [row for row in tables.pictures.get(FRONT, ()) if row.get("is_key_frame")]
    calibration = tables.calibration(FRONT)
    if calibration is None:
        return
    focal, x, y = matrix_of(calibration, tables.scene)
    xyz, wxyz = numbers(calibration.get("translation"), 3), numbers(calibration.get("rotation"), 4)
    if xyz is None or wxyz is None:
        raise LogFormatError(
            f"{tables.scene.tables / 'calibrated_sensor.json'}: {calibration.get('token')}: "
            "expected translation and rotation"
        )
    car_r_camera = Rotation.from_quat(np.roll(wxyz, -1))
    poses = ego_poses(tables)
    at = {t_ns: i for i, t_ns in enumerate(poses.t_ns.tolist())}
    for row in rows:
        i = at.get(int(row["timestamp"]) * 1000)
        if i is None:
            i = int(np.abs(poses.t_ns - int(row["timestamp"]) * 1000).argmin())
        map_r_car = Rotation.from_quat(np.roll(poses.wxyz[i], -1))
        place = poses.xyz_m[i] + map_r_car.apply(xyz)
        turn = map_r_car * car_r_camera
        yield row, _Camera(turn, place, map_r_car, poses.xyz_m[i], focal, (x, y))


def _box_px(
    xyz_m: Floats, size_m: Floats, turn: Rotation, camera: _Camera
) -> tuple[float, float, float, float] | None:
    """Return the box around the corners in the picture; None if a corner is not ahead."""
    width, length, height = size_m
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    corners = xyz_m + turn.apply(0.5 * signs * np.array([length, width, height]))
    seen = camera.map_r_camera.inv().apply(corners - camera.place_m)
    if (seen[:, 2] < NEAREST_M).any():
        return None
    uv = camera.focal_px * seen[:, :2] / seen[:, 2:] + np.array(camera.center_px)
    (x0, y0), (x1, y1) = uv.min(axis=0).tolist(), uv.max(axis=0).tolist()
    return x0, y0, x1, y1
