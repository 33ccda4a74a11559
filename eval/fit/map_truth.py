"""Ground truth of intersections from a map, for a drive with positions."""

from pathlib import Path

from crosscue.datasets.truth.lanelet2 import read_map
from crosscue.datasets.truth.map_approaches import write_approaches
from crosscue.datasets.truth.truth import WrittenTruth
from crosscue.eval.logs.log import DriveGiven, opened
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.files.whole_file import file_sha256
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

from .gnss_truth import gnss_truth, save_with_track


def truth_from_map(
    log: DriveGiven,
    road_map: Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
) -> WrittenTruth:
    """Write the intersections of a map that a drive with GNSS positions comes to.

    Each approach has its legs, its control where the map states one, and its distances. The map is
    an OpenStreetMap extract, or a Lanelet2 map with latitude and longitude. An approach without a
    stated control has the control "none" and the condition control_not_stated: maps rarely contain
    stop signs. The track is that of truth from-gnss.

    Examples:
        crosscue truth from-map drive.mcap map.osm --vehicle car.toml -o truth/

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        road_map: OpenStreetMap extract or Lanelet2 map, .osm, around the drive.
        output: Folder for the truth file, its track and its ranges.
        vehicle: Vehicle file with the antenna's mounting.

    Raises:
        EmptyResultError: The log has no position with a heading, or the map no intersection there.
        AnnotationError: The map cannot be read.
        OutputError: The files cannot be written.
    """
    settings = vehicle_given(vehicle)
    path = Path(road_map)
    extract = read_map(path)
    with opened(log) as drive:
        truth, track = gnss_truth(drive.logs, settings, drive.selection)
    assert truth.origin is not None
    origin = truth.origin.latitude_deg, truth.origin.longitude_deg, truth.origin.altitude_m
    folder, roads = Path(output), extract.around(origin)
    more, source = write_approaches(track, roads, path.name, folder, settings.gnss.x_m)
    if not more:
        raise EmptyResultError(f"{path}: {source}")
    more |= {"source": f"{truth.source}; {source}", "map_sha256": file_sha256(path)}
    return WrittenTruth(save_with_track(truth.model_copy(update=more), track, folder))
