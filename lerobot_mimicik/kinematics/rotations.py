"""Rotations and poses as batched torch functions: quaternions, matrices, rotation vectors, pose differences.

Conventions, here and in the whole package:

- quaternions are `x y z w`, of unit length; q and -q are the same rotation, `half_sphere` picks w >= 0;
- a pose is `x y z qx qy qz qw`: position [m], then quaternion; `T_a_b` is the pose of frame b in frame a;
- a rotation vector is the axis times the angle in rad;
- every function takes any leading batch axes, written `*`, and broadcasts them;
- every function is differentiable with finite gradients everywhere, the identity and the half turn included
  (where the true gradient does not exist, at the kink of an angle at 0, it is 0).
"""

from __future__ import annotations

import torch
from torch import Tensor


def quaternion_multiply(q_a: Tensor, q_b: Tensor) -> Tensor:
    """Hamilton product: the rotation `q_b` followed by `q_a`. Shapes (*, 4), (*, 4) -> (*, 4)."""
    ax, ay, az, aw = q_a.unbind(-1)
    bx, by, bz, bw = q_b.unbind(-1)
    return torch.stack(
        (
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ),
        dim=-1,
    )


def quaternion_conjugate(q: Tensor) -> Tensor:
    """The inverse rotation of a unit quaternion. Shape (*, 4)."""
    return torch.cat((-q[..., :3], q[..., 3:]), dim=-1)


def half_sphere(q: Tensor) -> Tensor:
    """The same rotation with w >= 0. Shape (*, 4)."""
    return torch.where(q[..., 3:] < 0, -q, q)


def quaternion_to_matrix(q: Tensor) -> Tensor:
    """Rotation matrices of unit quaternions. Shape (*, 4) -> (*, 3, 3)."""
    x, y, z, w = q.unbind(-1)
    entries = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Unit quaternions with w >= 0 of rotation matrices. Shape (*, 3, 3) -> (*, 4).

    The symmetric matrix 4 q q^T has entries that are linear in those of the rotation matrix, and each of its
    rows is a multiple of q. The row with the largest diagonal entry (at least 1, since the four squares sum
    to 4) is normalised: no square root of something near zero, hence no large gradient (Shepperd, 1978).
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.flatten(-2).unbind(-1)
    xx, yy, zz, ww = 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22, 1 + m00 + m11 + m22
    xy, xz, yz = m01 + m10, m02 + m20, m12 + m21
    xw, yw, zw = m21 - m12, m02 - m20, m10 - m01
    outer = torch.stack((xx, xy, xz, xw, xy, yy, yz, yw, xz, yz, zz, zw, xw, yw, zw, ww), -1).unflatten(
        -1, (4, 4)
    )
    largest = torch.stack((xx, yy, zz, ww), dim=-1).argmax(dim=-1)
    row = outer.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    return half_sphere(row / row.norm(dim=-1, keepdim=True))


def quaternion_to_rotation_vector(q: Tensor) -> Tensor:
    """Logarithm: the rotation vector of a unit quaternion, of length [0, pi] rad. Shape (*, 4) -> (*, 3)."""
    q = half_sphere(q)
    vector, w = q[..., :3], q[..., 3:]
    squared = (vector * vector).sum(-1, keepdim=True)
    small = squared < 1e-6
    sine = torch.sqrt(torch.where(small, 1.0, squared))
    safe_w = torch.where(small, w, 1.0)
    # 2 atan(s / w) / s = 2 / w (1 - s^2 / (3 w^2) + ...); the next term is below 1e-12.
    series = 2.0 / safe_w * (1.0 - squared / (3.0 * safe_w * safe_w))
    return vector * torch.where(small, series, 2.0 * torch.atan2(sine, w) / sine)


def rotation_vector_to_quaternion(rotation_vector: Tensor) -> Tensor:
    """Exponential: the unit quaternion (w >= 0) of a rotation vector [rad]. Shape (*, 3) -> (*, 4)."""
    squared = (rotation_vector * rotation_vector).sum(-1, keepdim=True)
    small = squared < 1e-6
    angle = torch.sqrt(torch.where(small, 1.0, squared))
    scale = torch.where(small, 0.5 - squared / 48.0, torch.sin(0.5 * angle) / angle)
    w = torch.where(small, 1.0 - squared / 8.0, torch.cos(0.5 * angle))
    return half_sphere(torch.cat((rotation_vector * scale, w), dim=-1))


def rotation_angle(q_a: Tensor, q_b: Tensor) -> Tensor:
    """Angle between two orientations, in [0, pi] rad. Shapes (*, 4), (*, 4) -> (*,).

    Computed as 2 atan2(|v|, |w|) of the relative quaternion, which is accurate at small angles, where the arc
    cosine of a float32 scalar product resolves no better than 5e-4 rad.
    """
    relative = quaternion_multiply(quaternion_conjugate(q_a), q_b)
    return 2.0 * torch.atan2(_safe_norm(relative[..., :3]), relative[..., 3].abs())


def rpy_to_matrix(rpy: Tensor) -> Tensor:
    """Rotation matrices of URDF's roll, pitch, yaw [rad]. Shape (*, 3) -> (*, 3, 3).

    The turns are about fixed axes: Rz(yaw) Ry(pitch) Rx(roll).
    """
    (sr, sp, sy), (cr, cp, cy) = torch.sin(rpy).unbind(-1), torch.cos(rpy).unbind(-1)
    entries = (
        cy * cp,
        cy * sp * sr - sy * cr,
        cy * sp * cr + sy * sr,
        sy * cp,
        sy * sp * sr + cy * cr,
        sy * sp * cr - cy * sr,
        -sp,
        cp * sr,
        cp * cr,
    )
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def matrix_to_pose(matrix: Tensor) -> Tensor:
    """Poses (w >= 0) of homogeneous transforms. Shape (*, 4, 4) -> (*, 7)."""
    return torch.cat((matrix[..., :3, 3], matrix_to_quaternion(matrix[..., :3, :3])), dim=-1)


def relative_pose(pose_current: Tensor, pose_target: Tensor) -> Tensor:
    """The step from one pose to another, in the base frame. Shapes (*, 7), (*, 7) -> (*, 6).

    The first three numbers are p_target - p_current [m], the last three the rotation vector [rad] of
    R_target R_current^T. `apply_relative_pose` undoes it.
    """
    translation = pose_target[..., :3] - pose_current[..., :3]
    rotation = quaternion_multiply(pose_target[..., 3:], quaternion_conjugate(pose_current[..., 3:]))
    rotation_vector = quaternion_to_rotation_vector(rotation)
    return torch.cat(torch.broadcast_tensors(translation, rotation_vector), dim=-1)


def apply_relative_pose(pose: Tensor, step: Tensor) -> Tensor:
    """The pose (w >= 0) one `step` of `relative_pose` away. Shapes (*, 7), (*, 6) -> (*, 7)."""
    position = pose[..., :3] + step[..., :3]
    q = quaternion_multiply(rotation_vector_to_quaternion(step[..., 3:]), pose[..., 3:])
    q = half_sphere(q / q.norm(dim=-1, keepdim=True))
    return torch.cat((position, q), dim=-1)


def pose_error(pose_a: Tensor, pose_b: Tensor) -> tuple[Tensor, Tensor]:
    """Distance [m] and angle [rad] between poses. Shapes (*, 7), (*, 7) -> (*,), (*,)."""
    return _safe_norm(pose_a[..., :3] - pose_b[..., :3]), rotation_angle(pose_a[..., 3:], pose_b[..., 3:])


def _safe_norm(vector: Tensor) -> Tensor:
    """Length over the last axis, with the gradient 0 instead of NaN at the zero vector."""
    squared = (vector * vector).sum(-1)
    zero = squared == 0
    return torch.where(zero, 0.0, torch.sqrt(torch.where(zero, 1.0, squared)))
