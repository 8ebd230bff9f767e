"""One arm as synthetic teleoperation needs it: kinematics, limits, home posture and collisions in numpy."""

import math

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.kinematics.collision import ArmCollision
from lerobot_mimicik.kinematics.plausibility import joint_limits

Array = NDArray[np.float64]

LIMIT_MARGIN_RAD = 0.02


class ArmArrays:
    """Forward kinematics, Jacobian, limits, home posture and collision check on float64 arrays.

    Attributes:
        description: The arm.
        lower, upper: Joint limits less LIMIT_MARGIN_RAD [rad], (dof,); one turn for joints without limits.
        limits: Joint limits as they are [rad, m], (dof,) each; infinite for joints without.
        prismatic: Which joints slide, (dof,).
        home: A comfortable configuration [rad], (dof,).
        base_to_tip: Where the joints, counted from the base, stand in the joint vector.

    Raises:
        ValueError: The description has no home.
    """

    def __init__(self, description: ArmDescription):
        self.description = description
        if not description.home:
            raise ValueError(
                "synthetic motion starts from a comfortable configuration: give the arm a `home` of "
                f"{len(description.joint_names)} joint angles in rad ({', '.join(description.joint_names)})"
            )
        self._chain = array_chain(description)
        joints = description.joints()
        self.base_to_tip = [description.joint_names.index(j.name) for j in description.chain() if j.movable]
        self.limits = joint_limits(description)
        self.prismatic = np.array([joint.type == "prismatic" for joint in joints])
        # A joint that turns without end is moved within one turn.
        lower, upper = (np.nan_to_num(side, neginf=-math.pi, posinf=math.pi) for side in self.limits)
        margin = np.minimum(LIMIT_MARGIN_RAD, 0.25 * (upper - lower))
        self.lower, self.upper = lower + margin, upper - margin
        self.home = np.clip(np.asarray(description.home, dtype=np.float64), self.lower, self.upper)
        self._collision = ArmCollision(description, self.home)

    def matrix(self, q: Array) -> Array:
        """T_base_tool of joints (n, dof) as matrices (n, 4, 4)."""
        return _homogeneous(*self._chain.forward(q))

    def pose(self, q: Array) -> Array:
        """T_base_tool of joints (n, dof) as x y z qx qy qz qw with qw >= 0, (n, 7)."""
        return self._chain.pose(q)

    def tool_and_jacobian(self, q: Array) -> tuple[Array, Array]:
        """T_base_tool (n, 4, 4) and geometric Jacobian (n, 6, dof) of joints (n, dof).

        Jacobian in the base frame at the tool point, linear rows first.
        """
        rotation, position, jacobian = self._chain.forward_and_jacobian(q)
        return _homogeneous(rotation, position), jacobian

    def jacobian(self, q: Array) -> Array:
        """Geometric Jacobian alone, (n, 6, dof); see `tool_and_jacobian`."""
        return self._chain.forward_and_jacobian(q)[2]

    def free(self, q: Array) -> NDArray[np.bool_]:
        """Whether configurations (n, dof) touch neither the arm itself nor the floor, (n,)."""
        return self._collision.clearance(q) > 0.0


def cross(a: Array, b: Array) -> Array:
    """Cross product over the last axis; several times as fast as numpy's on small arrays."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def _homogeneous(rotation: Array, position: Array) -> Array:
    out = np.zeros((len(position), 4, 4))
    out[:, :3, :3] = rotation
    out[:, :3, 3] = position
    out[:, 3, 3] = 1.0
    return out
