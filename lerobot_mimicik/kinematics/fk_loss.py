"""The FK consistency loss: how far the pose that a joint command reaches is from the one asked for."""

from __future__ import annotations

from torch import Tensor

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.rotations import quaternion_to_matrix


def fk_consistency_loss(
    arm: SerialArm,
    q_cmd: Tensor,
    pose_target: Tensor,
    rotation_weight: float = 1.0,
    position_scale: float = 0.01,
) -> Tensor:
    """L_FK of the MimicIK paper for each sample: |p - p*|^2 / position_scale^2 + rotation_weight d_R(R, R*).

    The paper leaves open the unit of position, here `position_scale` metres, and the rotation distance, here

        d_R = |R - R*|_F^2 / 2 = 4 sin^2(theta / 2),

    with theta the angle [rad] between the two orientations. It equals theta^2 within 1 % up to 0.35 rad, far
    beyond a good solver's error, so `rotation_weight` is per rad^2. It is a polynomial in the entries of R:
    its gradient is finite and continuous everywhere, zero at theta = 0 (unlike that of theta itself) and at
    theta = pi (where that of theta^2 jumps). It needs no quaternion of R, and small differences are not lost
    in 1 - cos theta.

    Args:
        arm: The arm; it must be on the device of the other arguments.
        q_cmd: Joint commands [rad], shape (*, dof). Gradients flow here.
        pose_target: Poses `T_base_tool` that were asked for, shape (*, 7), unit quaternions, either
            half-sphere.
        rotation_weight: Weight of the rotation term [1/rad^2].
        position_scale: The unit of position [m].

    Returns:
        Loss per sample, shape (*,), without unit.

    Raises:
        ValueError: Shapes or devices that do not fit, or a position scale that is not positive.
    """
    if not position_scale > 0:
        raise ValueError(f"position_scale must be above 0 m, found {position_scale}")
    if pose_target.shape[-1:] != (7,):
        raise ValueError(
            f"expected target poses of shape (*, 7), x y z qx qy qz qw; found {tuple(pose_target.shape)}"
        )
    target = pose_target.to(arm.dtype)
    reached = arm.matrix(q_cmd)
    position_error = (reached[..., :3, 3] - target[..., :3]) / position_scale
    rotation_error = reached[..., :3, :3] - quaternion_to_matrix(target[..., 3:])
    position_term = (position_error * position_error).sum(-1)
    rotation_term = 0.5 * (rotation_error * rotation_error).sum((-2, -1))
    return position_term + rotation_weight * rotation_term
