"""Places of drives: results at one place are not independent, so places are what is resampled.

The place is that of the truth, else the position where the car enters the intersection (or, without
one, where the drive starts), else the name of the intersection. Positions are ``geo:`` URIs (RFC
5870). Two within ``NEAR_M`` of each other are one place, and so are those that others connect.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from crosscue.datasets.geodesy import ecef_to_enu_matrix, ecef_to_geodetic, geodetic_to_ecef
from crosscue.datasets.truth.truth import Truth
from crosscue.datasets.truth.tum import read_tum
from crosscue.replay.columns import Int64s

from .columns import NONE

NEAR_M: Final = 50.0
GEO: Final = "geo:"
POSITION: Final = re.compile(r"geo:-?\d+(\.\d+)?,-?\d+(\.\d+)?")


class Placed(Protocol):
    """Rows of a drive by approach, with the place of each approach."""

    @property
    def drive(self) -> str:
        """Name of the drive."""
        ...

    @property
    def approach(self) -> Int64s:
        """Id of the true approach of each row, shape (N,)."""
        ...

    @property
    def places(self) -> Mapping[int, str]:
        """Place by id of the approach."""
        ...


def places_of(truth: Truth, folder: Path) -> dict[int, str]:
    """Return the place of each approach by its id, and of the drive by ``NONE``, where known.

    Args:
        truth: Truth of the drive.
        folder: Folder of its trajectory.

    Raises:
        LogError: The trajectory cannot be read.
    """
    ids = [NONE, *(one.id for one in truth.approaches)]
    if truth.place:
        return dict.fromkeys(ids, truth.place)
    named = {one.id: one.intersection for one in truth.approaches if one.intersection}
    if truth.origin is not None and truth.pose is not None:
        times = {one.id: one.enter_ns for one in truth.approaches} or {NONE: truth.start_ns}
        named = _positions(truth, folder / truth.pose, times)
    first = next(iter(named.values()), None)
    return named if first is None else {NONE: first, **named}


def _positions(truth: Truth, path: Path, times: Mapping[int, int]) -> dict[int, str]:
    track, origin = read_tum(path), truth.origin
    assert origin is not None
    at = [int(np.abs(track.t_ns - t_ns).argmin()) for t_ns in times.values()]
    where = origin.latitude_deg, origin.longitude_deg
    from_ecef = ecef_to_enu_matrix(*np.radians(where))
    ecef_m = geodetic_to_ecef(*where, origin.altitude_m) + track.xyz_m[at] @ from_ecef
    latitude_deg, longitude_deg, _ = ecef_to_geodetic(ecef_m)
    texts = [f"{GEO}{a:.6f},{b:.6f}" for a, b in zip(latitude_deg, longitude_deg, strict=True)]
    return dict(zip(times, texts, strict=True))


def group_places(names: Sequence[str]) -> Int64s:
    """Return the number of each name's place, shape (N,), in order of first occurrence."""
    return group_drives([(name,) for name in names])


def group_drives(places: Sequence[Sequence[str]]) -> Int64s:
    """Return the number of each drive's group, shape (N,); drives that share a place are in one."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    names = list(dict.fromkeys(name for some in places for name in some))
    index = {name: number for number, name in enumerate(names, len(places))}
    pairs = [(drive, index[name]) for drive, some in enumerate(places) for name in some]
    located = [name for name in names if POSITION.fullmatch(name)]
    pairs += [(index[located[a]], index[located[b]]) for a, b in _near_pairs(located)]
    n = len(places) + len(names)
    rows, columns = np.array(pairs, np.int64).reshape(-1, 2).T
    edges = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n))
    labels = connected_components(edges, directed=False)[1][: len(places)]
    _, first, which = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[which].astype(np.int64)


def _near_pairs(positions: Sequence[str]) -> list[tuple[int, int]]:
    from scipy.spatial import cKDTree

    if not positions:
        return []
    degrees = [name.removeprefix(GEO).split(",") for name in positions]
    latitude_deg, longitude_deg = np.array(degrees, np.float64).T
    xyz_m = geodetic_to_ecef(latitude_deg, longitude_deg, np.zeros(len(positions)))
    return sorted(cKDTree(xyz_m).query_pairs(NEAR_M))


def cluster_numbers(rows: Sequence[Placed]) -> Int64s:
    """Return the number of each row's place, over all drives; an unknown place is the approach's.

    Rows outside approaches belong to the drive's place.
    """
    names: list[str] = []
    which = [np.empty(0, np.int64)]
    for one in rows:
        ids, at = np.unique(one.approach, return_inverse=True)
        which.append(at.astype(np.int64) + len(names))
        names += [one.places.get(id_, f"{one.drive}, approach {id_}") for id_ in ids.tolist()]
    return group_places(names)[np.concatenate(which)]
