"""A new solver in one file: damped least squares, known to every command and table by its name once imported.

Run it with `uv run python examples/new_solver.py`. To keep it, move the class to `lerobot_mimicik/solvers/` and add the
module to the imports in `__init__.py` there; `mimicik eval --solvers=my_least_squares` then measures it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.point_chain import point_chain
from lerobot_mimicik.solvers import IKSolver, make_solver, register_solver
from lerobot_mimicik.solvers.base import Array

_ITERATIONS = 20
_TOLERANCE = 1e-6  # m and rad, together


@register_solver("my_least_squares")
class LeastSquares(IKSolver):
    """Newton steps of J^T (J J^T + damping^2)^-1, without limits; a damping of 0 is the plain pseudo-inverse."""

    name = "my_least_squares"
    configuration = (
        "Damped least squares from the measured joints, up to 20 steps; no limits, no bound on the step"
    )

    def __init__(self, arm: SerialArm, damping: float = 0.01) -> None:
        """Solve for `arm`; `damping` in m, where a radian counts as a metre."""
        self.chain, self.damping = point_chain(arm.description), damping

    def reset(self, q: Array) -> None:
        """Nothing to forget."""

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The command (dof,) [rad] for measured joints (dof,) [rad] and `T_base_tool` (7,), quaternion xyzw."""
        q = np.array(q_curr, dtype=float)
        wanted = Rotation.from_quat(target_pose[3:]).as_matrix()
        for _ in range(_ITERATIONS):
            rotation, position, jacobian = self.chain.rotation_position_jacobian(q)
            turn = Rotation.from_matrix(wanted @ rotation.T).as_rotvec()
            error = np.concatenate([target_pose[:3] - position, turn])
            if np.linalg.norm(error) < _TOLERANCE:
                break
            damped = jacobian @ jacobian.T + self.damping**2 * np.eye(6)
            q += jacobian.T @ np.linalg.lstsq(damped, error, rcond=None)[0]
        return q


def main() -> float:
    """Solve for one target; the error that is left [m]."""
    arm = describe_arm("airbot_play")
    solver = make_solver("my_least_squares", SerialArm(arm))
    q = np.array(arm.home)
    target = point_chain(arm).pose(q + 0.02)
    left = float(np.linalg.norm(point_chain(arm).pose(solver.solve(q, target))[:3] - target[:3]))
    print(f"{left * 1e3:.4f} mm off")
    return left


if __name__ == "__main__":
    main()
