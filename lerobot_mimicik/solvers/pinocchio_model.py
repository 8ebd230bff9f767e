"""An arm as a Pinocchio model, shared by the solvers that stand on Pinocchio."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array
from lerobot_mimicik.solvers.chain_urdf import TOOL, chain_urdf, pose_matrix

PINOCCHIO = from_extra("pinocchio")


class PinocchioModel:
    """Model and data of the bare chain, and where the arm's joints are in the model's vectors.

    Attributes:
        pin: The library.
        model, data: Its objects.
        tool: Index of the tool frame.
        index: `q_model[index]` is q in the arm's order; the joints of a bare chain have one number each.
    """

    def __init__(self, description: ArmDescription) -> None:
        """Build it.

        Raises:
            SolverUnavailable: If Pinocchio is not installed.
            UrdfError: The description does not fit its URDF.
        """
        self.pin: Any = PINOCCHIO.load()
        self.model = self.pin.buildModelFromXML(chain_urdf(description))
        self.data = self.model.createData()
        self.tool = self.model.getFrameId(TOOL, self.pin.FrameType.BODY)
        joints = [self.model.joints[self.model.getJointId(name)] for name in description.joint_names]
        self.index: NDArray[np.intp] = np.array([joint.idx_q for joint in joints])

    def to_model(self, q: Array) -> Array:
        """(dof,) in the arm's order -> in the model's."""
        q_model = np.empty_like(q)
        q_model[self.index] = q
        return q_model

    def target(self, pose: Array) -> Any:
        """A pose (7,) as the library's SE3."""
        matrix = pose_matrix(pose)
        return self.pin.SE3(matrix[:3, :3], matrix[:3, 3])

    def error(self, q_model: Array, target: Any) -> Array:
        """The twist (6,) that leads from the tool at `q_model` to `target` in unit time, in the tool frame."""
        self.pin.framesForwardKinematics(self.model, self.data, q_model)
        return self.pin.log6(self.data.oMf[self.tool].actInv(target)).vector

    def error_jacobian(self, q_model: Array, error: Array) -> Array:
        """Derivative (6, dof) of `error` by `q_model`, columns in the model's order."""
        jacobian = self.pin.computeFrameJacobian(self.model, self.data, q_model, self.tool)
        away = self.pin.exp6(self.pin.Motion(error)).inverse()
        return -self.pin.Jlog6(away) @ jacobian
