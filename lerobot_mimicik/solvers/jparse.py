"""J-PARSE: a pseudo-inverse that treats directions near a singularity apart (Stanford's ARM lab).

Singular values below `gamma` times the largest are kept from vanishing, and motion along their directions
is faded out and fed back by a gain of its own. Used as its authors' 3-D example uses it: five velocity steps per
frame, gamma 0.1, singular direction gains 1. A step here makes up the whole error (gain 1 per step); the joints
are cut to the box of the control step, as the example cuts them to a velocity limit. The Jacobian is that of the
package's own `Robot`, which stands on Pinocchio.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers.availability import from_extra
from lerobot_mimicik.solvers.base import Array, register_solver
from lerobot_mimicik.solvers.chain_urdf import BASE, TOOL, chain_urdf
from lerobot_mimicik.solvers.iterative import IterativeSolver
from lerobot_mimicik.solvers.pinocchio_model import PINOCCHIO, PinocchioModel

JPARSE = from_extra("jparse_robotics")


@register_solver("jparse", needs=(PINOCCHIO, JPARSE))
class JParseSolver(IterativeSolver):
    """Velocity steps by the J-PARSE inverse; see the module."""

    configuration = (
        "The J-PARSE inverse, gamma 0.1, singular direction gains 1, up to 5 steps from the measured joints that "
        "each make up the whole error, cut to joint limits and at most 0.1 rad from the measured joints. After "
        "https://github.com/armlabstanford/jparse/blob/main/examples/pyroki_jparse_utils.py"
    )

    def __init__(
        self,
        arm: SerialArm,
        gamma: float = 0.1,
        position_gain: float = 1.0,
        angular_gain: float = 1.0,
        gain: float = 1.0,
        iterations: int = 5,
        **iteration: Any,
    ) -> None:
        """
        Args:
            arm: The arm to solve for.
            gamma: Singular values below so much of the largest count as singular, in (0, 1).
            position_gain, angular_gain: In singular directions.
            gain: Fraction of the error that a step makes up.
            iterations: Most steps per query.
            iteration: See `IterativeSolver`.
        """
        super().__init__(arm, iterations=iterations, **iteration)
        self.gain = gain
        self.gains = {
            "singular_direction_gain_position": position_gain,
            "singular_direction_gain_angular": angular_gain,
        }
        self._robot = JPARSE.load().Robot.from_urdf(chain_urdf(arm.description), BASE, TOOL, gamma=gamma)
        self._library = PinocchioModel(arm.description)

    def _start(self, q: Array, target_pose: Array, lower: Array, upper: Array) -> None:
        self._q, self._target, self._goal = q, target_pose, Rotation.from_quat(target_pose[3:])
        self._bounds = lower, upper

    def _error(self) -> float:
        position, rotation = self._robot.forward_kinematics(self._library.to_model(self._q))
        turn = (self._goal * Rotation.from_matrix(rotation).inv()).as_rotvec()
        self._twist = np.concatenate([self._target[:3] - position, turn])
        return float(np.linalg.norm(self._twist))

    def _improve(self) -> None:
        inverse = self._robot.jparse(self._library.to_model(self._q), **self.gains)
        step = self.gain * (inverse @ self._twist)[self._library.index]
        self._q = np.clip(self._q + step, *self._bounds)

    def _joints(self) -> Array:
        return self._q
