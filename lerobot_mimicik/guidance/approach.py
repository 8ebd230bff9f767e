"""A pose on the way to a target that is further away than one step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def towards(pose: Array, target: Array, lower: Array, upper: Array) -> tuple[Array, float]:
    """A pose on the way from one pose to another, no further than a step between `lower` and `upper`.

    Position goes along the straight line, rotation along the shortest turn, both by the same share.

    Args:
        pose, target: (7,).
        lower, upper: Bounds of the step, translation [m] and rotation vector of R_target R_pose^T [rad], (6,),
            negative and positive.

    Returns:
        The pose (7,) and the share of the way, 1.0 for the target itself.
    """
    turn = turned(pose[3:], target[3:])
    step = np.concatenate([target[:3] - pose[:3], turn])
    share = float(1.0 / max(1.0, (step / np.where(step < 0, lower, upper)).max()))
    if share >= 1.0:
        return target.copy(), 1.0
    rotation = Rotation.from_rotvec(share * turn) * Rotation.from_quat(pose[3:])
    return np.concatenate([pose[:3] + share * step[:3], rotation.as_quat(canonical=True)]), share


def turned(start: Array, end: Array) -> Array:
    """Rotation vector (3,) [rad] of R_end R_start^T, the short way, of unit quaternions (4,)."""
    sine = start[3] * end[:3] - end[3] * start[:3] - np.cross(end[:3], start[:3])
    cosine = float(end @ start)
    sine, cosine = (-sine, -cosine) if cosine < 0 else (sine, cosine)
    size = float(np.linalg.norm(sine))
    return 2.0 * sine if size < 1e-9 else sine * (2.0 * np.arctan2(size, cosine) / size)


def turned_by(rotation: Array, turn: Array) -> Array:
    """A unit quaternion (4,), w >= 0, turned by a rotation vector (3,) [rad] in the base frame."""
    angle = float(np.linalg.norm(turn))
    vector = turn * (0.5 if angle < 1e-9 else np.sin(0.5 * angle) / angle)
    w = np.cos(0.5 * angle)
    found = np.array([*(w * rotation[:3] + rotation[3] * vector + np.cross(vector, rotation[:3])), 0.0])
    found[3] = w * rotation[3] - vector @ rotation[:3]
    return found if found[3] >= 0 else -found
