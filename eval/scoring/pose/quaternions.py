"""Unit quaternions in columns, w first (Hamilton): R(a b) = R(a) R(b)."""

from __future__ import annotations

import numpy as np

from crosscue.replay.columns import Floats


def product(a: Floats, b: Floats) -> Floats:
    """Rotate by ``b``, then by ``a``; shapes (..., 4)."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def inverse(quat: Floats) -> Floats:
    """The rotation back; shape (..., 4)."""
    back: Floats = quat * np.array([1.0, -1.0, -1.0, -1.0])
    return back


def rotate(quat: Floats, xyz: Floats) -> Floats:
    """Vectors turned; shapes (..., 4) and (..., 3)."""
    w, axis = quat[..., :1], quat[..., 1:]
    across = 2.0 * np.cross(axis, xyz)
    return xyz + w * across + np.cross(axis, across)


def angle_rad(quat: Floats) -> Floats:
    """Angle of each rotation, in [0, pi]; shape (...)."""
    sine = np.linalg.norm(quat[..., 1:], axis=-1)
    half: Floats = np.arctan2(sine, np.abs(quat[..., 0]))
    return 2.0 * half


def between(a: Floats, b: Floats, share: Floats) -> Floats:
    """Turn evenly from ``a`` to ``b`` (slerp), the shorter way.

    Args:
        a: Shape (N, 4).
        b: Shape (N, 4).
        share: Shape (N,), from 0 at ``a`` to 1 at ``b``.
    """
    turn = product(inverse(a), b)
    turn = np.where(turn[..., :1] < 0.0, -turn, turn)
    half = np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), turn[..., 0])
    # sin(share half) / sin(half), which is share for no turn at all.
    ratio = share * np.sinc(share * half / np.pi) / np.sinc(half / np.pi)
    part = np.concatenate([np.cos(share * half)[:, None], ratio[:, None] * turn[..., 1:]], axis=-1)
    return product(a, part)


def about_z(angle: float) -> Floats:
    """Rotation about the vertical; shape (4,)."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
