"""Any solver as guidance asks it: for one arm, at most one step's worth of the way, and with its answer looked at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.guidance.approach import towards
from lerobot_mimicik.kinematics.point_chain import PointChain
from lerobot_mimicik.solvers.base import IKSolver
from robot_adapters.arrays import float_array

Array = NDArray[np.float64]


class SolverProposals:
    """What a solver would do next; whatever it raises goes through."""

    def __init__(self, solver: IKSolver, chain: PointChain, largest_step: Array) -> None:
        """
        Args:
            solver: Who is asked.
            chain: Of the arm that it solves for.
            largest_step: Pose step (6,) [m, rad] that it is asked for at most; less where it says so itself.
        """
        self._solver, self._chain, self._largest = solver, chain, largest_step
        self._read_step_range()

    def restart(self, q: Array) -> None:
        """The solver begins anew at `q` (dof,) [rad]: its history is of another motion, or lost."""
        self._solver.reset(q[None].copy() if self._solver.batched else q.copy())
        # A server that came back may have another solver of that name.
        self._read_step_range()

    def towards(self, start: Array, target: Array) -> Array:
        """Joints (dof,) [rad] on the way from `start` to the pose `target` (7,).

        Raises:
            TypeError, ValueError: It answered with anything but finite joints.
        """
        waypoint, _ = towards(self._chain.pose(start), target, self._lower, self._upper)
        if self._solver.batched:
            answer = float_array(self._solver.solve(start[None].copy(), waypoint[None].copy()))
            answer = answer[0] if len(answer) == 1 else answer
        else:
            answer = float_array(self._solver.solve(start.copy(), waypoint.copy()))
        if answer.shape != start.shape:
            raise ValueError(f"answered with shape {answer.shape}, expected {len(start)} joints")
        if not np.isfinite(answer).all():
            raise ValueError(f"answered {answer.tolist()}")
        return answer

    def _read_step_range(self) -> None:
        """Smallest and largest pose step (6,) [m, rad] that the solver is asked for at once."""
        if self._solver.step_range is None:
            self._lower, self._upper = -self._largest, self._largest
            return
        lower, upper = self._solver.step_range
        # An axis that training left out must not keep targets from being approached at all.
        least = 0.1 * self._largest
        self._lower = -np.clip(-lower, least, self._largest)
        self._upper = np.clip(upper, least, self._largest)
