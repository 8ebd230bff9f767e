"""LeRobot's `RobotKinematics` without placo: the same methods, answered by the guided solver."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.arms import SHIPPED_ARMS, ArmDescription, describe_arm
from lerobot_mimicik.kinematics.point_chain import point_chain
from lerobot_mimicik.kinematics.urdf import read_urdf
from robot_adapters.adapter import AdapterSettings, IKResult, MimicIKAdapter

Array = NDArray[np.float64]

_STEPS = 8
"""Guided steps in one call, of at most 0.095 rad each: what RobotKinematics after LeRobot 0.6 does for convergence."""
_SETTLED = 1e-5  # rad of a step that changes nothing
_SAME = 1e-6  # rad between the joints of a call and the last answer: the caller goes on from there


class MimicIKKinematics:
    """Forward and inverse kinematics of one arm, in degrees and 4x4 matrices.

    Attributes:
        joint_names: The joints, in the order of all joint positions; what is not between base and target frame (a
            gripper) passes through.
        target_frame_name: The frame that poses are of.
        result: What became of the last pose, in words and numbers; None before.
    """

    def __init__(
        self,
        urdf_path: str | Path,
        target_frame_name: str = "gripper_frame_link",
        joint_names: Sequence[str] | None = None,
    ) -> None:
        """As LeRobot's, but a shipped arm's name will do for the URDF, and then its own tool frame for the target.

        Raises:
            UrdfError: No such arm, file, frame or joint; the message lists those that exist.
        """
        self.description = _describe(str(urdf_path), target_frame_name)
        self.target_frame_name = self.description.tip_link
        chain = self.description.joint_names
        self.joint_names = list(chain if joint_names is None else joint_names)
        missing = [name for name in chain if name not in self.joint_names]
        if missing:
            raise ValueError(
                f"joint_names {self.joint_names} lack {missing}, which move {self.target_frame_name}: expected {chain}"
            )
        self._chain = point_chain(self.description)
        self._at = [self.joint_names.index(name) for name in chain]
        self.result: IKResult | None = None
        # The usual one is made at once: what it takes to warm up shall not keep an arm that already moves waiting.
        self._adapters: dict[bool, MimicIKAdapter] = {True: self.make_adapter()}
        self._last: dict[bool, Array] = {}

    def make_adapter(self, orientation_weight: float = 0.01) -> MimicIKAdapter:
        """An adapter for the arm, to be kept; without orientation where its weight is zero."""
        settings = AdapterSettings(orientation="auto" if orientation_weight else "position")
        adapter = MimicIKAdapter(None, self.description, settings)
        adapter.warm_up()
        return adapter

    def forward_kinematics(self, joint_pos_deg: ArrayLike) -> Array:
        """`T_base_target` (4, 4) of joint positions [degrees] in the order of `joint_names`; more are left alone."""
        pose = self._chain.pose(np.deg2rad(self._joints(joint_pos_deg)[self._at]))
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
        matrix[:3, 3] = pose[:3]
        return matrix

    def inverse_kinematics(
        self,
        current_joint_pos: ArrayLike,
        desired_ee_pose: ArrayLike,
        position_weight: float = 1.0,
        orientation_weight: float = 0.01,
    ) -> Array:
        """Joint positions [degrees] that bring the target frame to a pose, within 0.76 rad of the current ones.

        Args:
            current_joint_pos: Where to begin [degrees], in the order of `joint_names`; more come back unchanged.
            desired_ee_pose: `T_base_target` (4, 4).
            position_weight: As LeRobot's; position is met exactly where it can be.
            orientation_weight: 0 leaves the orientation free; otherwise it is met as far as the arm can.

        Raises:
            ValueError: Wrong shapes, or joints that are far outside their limits (radians are not, nor found out).
        """
        if not position_weight > 0:
            raise ValueError(f"position_weight={position_weight}: expected more than 0")
        given = self._joints(current_joint_pos)
        matrix = np.asarray(desired_ee_pose, dtype=float)
        if matrix.shape != (4, 4):
            raise ValueError(f"desired_ee_pose: expected a 4x4 matrix, got shape {matrix.shape}")
        target = np.concatenate([matrix[:3, 3], Rotation.from_matrix(matrix[:3, :3]).as_quat()])
        counts = orientation_weight != 0.0
        if counts not in self._adapters:
            self._adapters[counts] = self.make_adapter(orientation_weight)
        adapter = self._adapters[counts]
        q = np.deg2rad(given[self._at])
        last = self._last.get(counts)
        if last is None or np.abs(q - last).max() > _SAME:
            adapter.reset()
        for _ in range(_STEPS):
            result = adapter.solve(q, target)
            q = result.q
            if result.step < _SETTLED:
                break
        self.result, self._last[counts] = result, q
        answer = given.copy()
        answer[self._at] = np.rad2deg(q)
        return answer

    def _joints(self, positions: ArrayLike) -> Array:
        joints = np.array(positions, dtype=float)
        if joints.ndim != 1 or len(joints) < len(self.joint_names):
            raise ValueError(
                f"expected the positions of {self.joint_names} in degrees, got shape {joints.shape}"
            )
        return joints


def _describe(arm: str, target: str) -> ArmDescription:
    description = describe_arm(arm) if arm in SHIPPED_ARMS else None
    if description is None:
        return describe_arm(arm, tip_link=target)
    known = read_urdf(description.urdf).links
    if target in known and target != description.tip_link:
        return describe_arm(description.urdf, description.base_link, target)
    return description
