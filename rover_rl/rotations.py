"""Rotations: quaternions (x, y, z, w), matrices and Euler angles, batched in torch.

The result of a row is bit-identical in every batch. :func:`torch.atan2` rounds differently in the vectorized body and
in the tail of a contiguous tensor, so :func:`angle_of` passes strided columns, which take a single code path.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor


def angle_of(vectors: Tensor) -> Tensor:
    """Returns the angle between the x axis and each of ``vectors [..., 2]``: ``[...]``, rad, in [-pi, pi]."""
    vectors = vectors.contiguous()
    return torch.atan2(vectors[..., 1], vectors[..., 0])


def wrap_angle(angle: Tensor) -> Tensor:
    """Wraps ``angle`` (rad) to (-pi, pi], as ``atan2(sin(angle), cos(angle))`` does."""
    return math.pi - torch.remainder(math.pi - angle, 2 * math.pi)


def quaternion_to_euler(quaternion: Tensor) -> Tensor:
    """Returns roll, pitch and yaw (rad, ``[..., 3]``) of unit quaternions ``[..., 4]``.

    The convention is that of ``transforms3d.euler.quat2euler`` (static x, y, z axes).
    """
    products = (quaternion[..., :, None] * quaternion[..., None, :]).flatten(-2)
    forms = _euler_forms(quaternion.device, quaternion.dtype)
    sines_cosines = (products[..., None, :] * forms).sum(-1)
    roll, yaw = angle_of(sines_cosines[..., :4].unflatten(-1, (2, 2))).unbind(-1)
    pitch = torch.asin(sines_cosines[..., 4].clamp(-1, 1))
    return torch.stack((roll, pitch, yaw), -1)


def level_to_euler(quaternion: Tensor) -> Tensor:
    """Returns what :func:`quaternion_to_euler` does, to the last bit, of quaternions whose x and y are 0."""
    z, w = quaternion[..., 2:].unbind(-1)
    yaw = angle_of(torch.stack((w * w - z * z, 2 * (z * w)), -1))
    return torch.nn.functional.pad(yaw[..., None], (2, 0))


def rotation_forms() -> Tensor:
    """Coefficients of a rotation matrix's entries in the products of the quaternion's components: ``[3, 3, 16]``."""
    x, y, z, w = torch.eye(4)
    xx, yy, zz, ww = (torch.outer(a, a) for a in (x, y, z, w))
    xy, xz, yz, xw, yw, zw = (2 * torch.outer(*pair) for pair in ((x, y), (x, z), (y, z), (x, w), (y, w), (z, w)))
    rows = (
        (ww + xx - yy - zz, xy - zw, xz + yw),
        (xy + zw, ww - xx + yy - zz, yz - xw),
        (xz - yw, yz + xw, ww - xx - yy + zz),
    )
    return torch.stack([torch.stack(row) for row in rows]).reshape(3, 3, 16)


@lru_cache(maxsize=16)
def _euler_forms(device: torch.device, dtype: torch.dtype) -> Tensor:
    """Coefficients of cosine and sine of roll and yaw, and sine of pitch, in a quaternion's products: ``[5, 16]``."""
    forms = rotation_forms()
    # 0 - x is 0 where x is 0; -x would be -0.
    rows = (forms[2, 2], forms[2, 1], forms[0, 0], forms[1, 0], 0 - forms[2, 0])
    return torch.stack(rows).to(device, dtype)


def euler_to_matrix(angles: Tensor) -> Tensor:
    """Converts roll, pitch and yaw ``[N, 3]`` ('sxyz', rad) to rotation matrices ``[N, 3, 3]``.

    The columns point forward, left and up.
    """
    (cr, cp, cy), (sr, sp, sy) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    forward, left = (cy * cp, sy * cp, -sp), (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr)
    up = (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr)
    return torch.stack([torch.stack(column, -1) for column in (forward, left, up)], -1)


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Returns unit quaternions ``[..., 4]`` (w >= 0) of rotation matrices ``[..., 3, 3]``."""
    m = matrix
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    squares = torch.stack([1 + 2 * m[..., k, k] - trace for k in range(3)] + [1 + trace], -1)
    # Each candidate is the quaternion times one of its components. Dividing by the largest component is stable.
    xy, xz, yz = (m[..., i, j] + m[..., j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    xw, yw, zw = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xx, yy, zz, ww = squares.unbind(-1)
    candidates = torch.stack(
        [torch.stack(row, -1) for row in ((xx, xy, xz, xw), (xy, yy, yz, yw), (xz, yz, zz, zw), (xw, yw, zw, ww))], -2
    )
    best = squares.argmax(-1)[..., None, None].expand(*squares.shape[:-1], 1, 4)
    quaternion = candidates.gather(-2, best).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def rotate(quaternion: Tensor, vectors: Tensor) -> Tensor:
    """Rotates ``vectors [..., 3]`` by unit quaternions ``[..., 4]``: ``[..., 3]``."""
    w = quaternion[..., 3:]
    axis, vectors = torch.broadcast_tensors(quaternion[..., :3], vectors)
    across = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * across + torch.linalg.cross(axis, across)


def quaternion_product(a: Tensor, b: Tensor) -> Tensor:
    """Returns the quaternion of rotation ``b`` followed by rotation ``a``, both ``[..., 4]``."""
    ax, ay, az, aw = a.unbind(-1)
    bx, by, bz, bw = b.unbind(-1)
    x = aw * bx + ax * bw + ay * bz - az * by
    y = aw * by - ax * bz + ay * bw + az * bx
    z = aw * bz + ax * by - ay * bx + az * bw
    return torch.stack((x, y, z, aw * bw - ax * bx - ay * by - az * bz), -1)
