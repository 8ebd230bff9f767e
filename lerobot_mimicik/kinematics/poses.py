"""End-effector poses on their way between policies and arms: vector formats, references, tool and base frames.

A pose is `T_a_b` as x y z [m] qx qy qz qw, numpy float64, shape (*, 7), on the half-sphere qw >= 0.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.names import did_you_mean

Array = NDArray[np.float64]
IDENTITY: Array = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


class PoseFormat(enum.StrEnum):
    """How a policy writes a pose; position first, always.

    The six numbers of the 6-D rotation are the first two columns of R (Zhou et al. 2019), or, as UMI writes
    them, its first two rows.
    """

    QUATERNION = "quaternion"
    ROTATION_VECTOR = "rotation_vector"
    ROTATION_6D = "rotation_6d"
    ROTATION_6D_ROWS = "rotation_6d_rows"

    @classmethod
    def _missing_(cls, value: object) -> None:
        _refuse_choice(cls, value, "pose format")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers."""
        return ("x", "y", "z", *_ROTATION_NAMES[self])

    @property
    def width(self) -> int:
        """Numbers in a pose."""
        return len(self.names)


_ROTATION_NAMES = {
    PoseFormat.QUATERNION: ("qx", "qy", "qz", "qw"),
    PoseFormat.ROTATION_VECTOR: ("wx", "wy", "wz"),
    PoseFormat.ROTATION_6D: tuple(f"r{i}" for i in range(6)),
    PoseFormat.ROTATION_6D_ROWS: tuple(f"r{i}" for i in range(6)),
}


class PoseReference(enum.StrEnum):
    """What a policy's target poses are relative to: nothing, or the pose when it was asked.

    TOOL: T_base_target = T_base_current T_current_target, as UMI does. BASE: translation and rotation in the
    base frame, p + dp and dR R.
    """

    ABSOLUTE = "absolute"
    TOOL = "tool"
    BASE = "base"

    @classmethod
    def _missing_(cls, value: object) -> None:
        _refuse_choice(cls, value, "pose reference")


def _refuse_choice(choices: type[enum.StrEnum], value: object, what: str) -> None:
    raise ValueError(
        f"{value!r} is no {what}: expected one of {', '.join(choices)}.{did_you_mean(str(value), choices)}"
    )


def encode_pose(pose: ArrayLike, form: PoseFormat) -> Array:
    """Poses (*, 7) in a policy's format (*, form.width)."""
    pose = np.asarray(pose, dtype=float)
    if form is PoseFormat.QUATERNION:
        return pose.copy()
    rotation = Rotation.from_quat(pose[..., 3:].reshape(-1, 4))
    if form is PoseFormat.ROTATION_VECTOR:
        numbers = rotation.as_rotvec()
    else:
        matrix = rotation.as_matrix()
        two = matrix[:, :2, :] if form is PoseFormat.ROTATION_6D_ROWS else matrix[:, :, :2].transpose(0, 2, 1)
        numbers = two.reshape(-1, 6)
    return np.concatenate([pose[..., :3], numbers.reshape(*pose.shape[:-1], -1)], axis=-1)


def decode_pose(numbers: ArrayLike, form: PoseFormat) -> Array:
    """Poses (*, 7) from a policy's format (*, form.width).

    Quaternions are normalised and 6-D rotations orthonormalised, since networks return neither exactly.

    Raises:
        ValueError: A wrong width, or a rotation that is none: a quaternion shorter than 0.1, or a 6-D
            rotation whose two vectors are shorter than that or parallel.
    """
    numbers = np.asarray(numbers, dtype=float)
    if numbers.shape[-1:] != (form.width,):
        raise ValueError(
            f"expected poses of {form.width} numbers ({' '.join(form.names)}), got shape {numbers.shape}"
        )
    rest = numbers[..., 3:].reshape(-1, form.width - 3)
    if form is not PoseFormat.ROTATION_VECTOR:
        # Only directions count, and squares of huge numbers overflow.
        rest = rest / np.maximum(1.0, np.abs(rest).max(axis=-1, keepdims=True))
    if form is PoseFormat.ROTATION_VECTOR:
        rotation = Rotation.from_rotvec(rest)
    elif form is PoseFormat.QUATERNION:
        _refuse_short(np.linalg.norm(rest, axis=-1), "quaternion", rest)
        rotation = Rotation.from_quat(rest)
    else:
        rotation = Rotation.from_matrix(_orthonormal(rest, rows=form is PoseFormat.ROTATION_6D_ROWS))
    quaternion = rotation.as_quat(canonical=True).reshape(*numbers.shape[:-1], 4)
    return np.concatenate([numbers[..., :3], quaternion], axis=-1)


def compose(pose_a_b: ArrayLike, pose_b_c: ArrayLike) -> Array:
    """`T_a_c` = `T_a_b` `T_b_c`, shapes (*, 7), broadcast."""
    first, second = np.broadcast_arrays(np.asarray(pose_a_b, dtype=float), np.asarray(pose_b_c, dtype=float))
    rotation = Rotation.from_quat(first[..., 3:].reshape(-1, 4))
    position = first[..., :3] + rotation.apply(second[..., :3].reshape(-1, 3)).reshape(first[..., :3].shape)
    quaternion = (rotation * Rotation.from_quat(second[..., 3:].reshape(-1, 4))).as_quat(canonical=True)
    return np.concatenate([position, quaternion.reshape(*first.shape[:-1], 4)], axis=-1)


def inverse(pose_a_b: ArrayLike) -> Array:
    """`T_b_a`, shape (*, 7)."""
    pose = np.asarray(pose_a_b, dtype=float)
    rotation = Rotation.from_quat(pose[..., 3:].reshape(-1, 4)).inv()
    position = -rotation.apply(pose[..., :3].reshape(-1, 3)).reshape(pose[..., :3].shape)
    return np.concatenate([position, rotation.as_quat(canonical=True).reshape(*pose.shape[:-1], 4)], axis=-1)


def pose_distance(pose_a: Array, pose_b: Array) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses of shape (7,)."""
    chord = min(float(np.linalg.norm(pose_a[3:] + sign * pose_b[3:])) for sign in (-1, 1))
    return float(np.linalg.norm(pose_a[:3] - pose_b[:3])), 4.0 * float(np.arcsin(min(chord / 2, 1.0)))


@dataclass(frozen=True)
class PolicyFrames:
    """How a policy's poses relate to the arm's `T_base_tool`.

    Attributes:
        form: Vector format.
        reference: What target poses are relative to.
        tool: Pose of the policy's tool in the arm's tool frame, T_tool_policytool (7,).
        base: Pose of the policy's base in the arm's base frame, T_base_policybase (7,).
    """

    form: PoseFormat = PoseFormat.QUATERNION
    reference: PoseReference = PoseReference.ABSOLUTE
    tool: Sequence[float] = tuple(IDENTITY)
    base: Sequence[float] = tuple(IDENTITY)

    def __post_init__(self) -> None:
        # Command lines and JSON bring strings and lists.
        object.__setattr__(self, "form", PoseFormat(self.form))
        object.__setattr__(self, "reference", PoseReference(self.reference))
        for name in ("tool", "base"):
            pose = decode_pose(getattr(self, name), PoseFormat.QUATERNION)
            object.__setattr__(self, name, tuple(pose.tolist()))

    def to_policy(self, pose_base_tool: ArrayLike) -> Array:
        """The arm's pose (*, 7) as the policy sees it, absolute, (*, form.width)."""
        return encode_pose(compose(inverse(self.base), compose(pose_base_tool, self.tool)), self.form)

    def from_policy(self, numbers: ArrayLike, pose_base_tool: ArrayLike) -> Array:
        """A policy's target poses (*, form.width) as the arm's `T_base_tool` (*, 7).

        Args:
            numbers: What the policy answered.
            pose_base_tool: The arm's pose when it was asked, (7,).

        Raises:
            ValueError: As `decode_pose`.
        """
        given = decode_pose(numbers, self.form)
        current = compose(inverse(self.base), compose(pose_base_tool, self.tool))
        if self.reference is PoseReference.TOOL:
            given = compose(current, given)
        elif self.reference is PoseReference.BASE:
            turned = compose(np.concatenate([np.zeros((*given.shape[:-1], 3)), given[..., 3:]], -1), current)
            given = np.concatenate([given[..., :3] + current[:3], turned[..., 3:]], axis=-1)
        return compose(compose(self.base, given), inverse(self.tool))


def _orthonormal(numbers: Array, rows: bool) -> Array:
    """Rotation matrices (N, 3, 3) from two vectors each (N, 6), by Gram-Schmidt."""
    first, second = numbers[:, :3], numbers[:, 3:]
    _refuse_short(np.linalg.norm(first, axis=-1), "first vector of a 6-D rotation", numbers)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    second = second - (first * second).sum(-1, keepdims=True) * first
    _refuse_short(
        np.linalg.norm(second, axis=-1), "second vector of a 6-D rotation, across the first,", numbers
    )
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack([first, second, np.cross(first, second)], axis=-2 if rows else -1)


def _refuse_short(lengths: Array, what: str, numbers: Array) -> None:
    short = ~(lengths > 0.1)
    if short.any():
        worst = int(np.argmax(short))
        raise ValueError(
            f"the {what} has length {lengths[worst]:.3g}: {numbers[worst].tolist()} is no rotation"
        )
