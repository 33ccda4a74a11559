"""Operations on columns of unit quaternions, w first (Hamilton): R(a b) = R(a) R(b).

They use scipy's ``Rotation``, which is imported at the first use, because that takes 0.25 s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Floats: TypeAlias = NDArray[np.float64]


def rotation_of(quat: Floats) -> Rotation:
    """Return the rotation of unit quaternions, shape (4,) or (N, 4)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(quat, -1, axis=-1))


def quat_of(rotation: Rotation) -> Floats:
    """Return the quaternion of a rotation, with w not negative."""
    quat: Floats = np.roll(rotation.as_quat(canonical=True), 1, axis=-1)
    return quat


def product(a: Floats, b: Floats) -> Floats:
    """Return the rotation by ``b`` and then by ``a``; shapes (4,) or (N, 4)."""
    return quat_of(rotation_of(a) * rotation_of(b))


def inverse(quat: Floats) -> Floats:
    """Return the inverse rotation; shape (4,) or (N, 4)."""
    return quat_of(rotation_of(quat).inv())


def rotate(quat: Floats, xyz: Floats) -> Floats:
    """Rotate vectors; shapes (4,) or (N, 4), and (N, 3)."""
    turned: Floats = rotation_of(quat).apply(xyz)
    return turned


def angle_rad(quat: Floats) -> Floats:
    """Return the angle of each rotation, in [0, pi]; shape () or (N,)."""
    angle: Floats = rotation_of(quat).magnitude()
    return angle


def between(a: Floats, b: Floats, fraction: Floats) -> Floats:
    """Interpolate between ``a`` and ``b`` along the shorter arc (slerp).

    Args:
        a: Shape (N, 4).
        b: Shape (N, 4).
        fraction: Shape (N,), from 0 at ``a`` to 1 at ``b``.
    """
    from scipy.spatial.transform import Rotation

    start = rotation_of(a)
    turn = (start.inv() * rotation_of(b)).as_rotvec()
    return quat_of(start * Rotation.from_rotvec(fraction[:, None] * turn))


def about_z(angle: float) -> Floats:
    """Return the rotation about the vertical by an angle; shape (4,)."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
