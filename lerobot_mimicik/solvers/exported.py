"""A policy in a file of `mimicik export` as a solver: ONNX Runtime and numpy, neither torch nor LeRobot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lerobot_mimicik.inference.onnx_file import StepFile
from lerobot_mimicik.inference.single import SingleQuery
from lerobot_mimicik.solvers.base import Array, IKSolver


class ExportedSolver(IKSolver):
    """Answers single queries as `MimicIKSolver` does, and keeps the few frames of history that the policy looks at.

    Attributes:
        description: The arm that the policy was trained for.
    """

    def __init__(self, path: str | Path) -> None:
        """Raises as `StepFile.load`."""
        self._path = Path(path)
        file = StepFile.load(path)
        self.name, self.description = file.policy_type, file.facts.description
        self._range, self._steps = file.step_range, file.facts.steps
        self._query: SingleQuery | None = SingleQuery(file.facts, file.engine, "onnx")
        self._q: Array | None = None
        self._target: Array | None = None

    @property
    def step_range(self) -> tuple[Array, Array] | None:
        """The steps that the policy saw in training; None where it was not conditioned on them."""
        return self._range

    def __getstate__(self) -> dict[str, Any]:
        """Without the session, which does not pickle; the file is read again when asked."""
        return self.__dict__ | {"_query": None}

    def reset(self, q: Array) -> None:
        """Forget the history; the next `solve` starts a new one."""
        self._q = self._target = None

    def solve(self, q_curr: Array, target_pose: Array) -> Array:
        """The policy's command (dof,)."""
        if self._query is None:
            file = StepFile.load(self._path)
            self._query = SingleQuery(file.facts, file.engine, "onnx")
        if self._q is None or self._target is None:
            self._q = np.repeat(q_curr[None], self._steps, axis=0)
            self._target = np.repeat(target_pose[None], self._steps, axis=0)
        else:
            self._q = np.concatenate([self._q[1:], q_curr[None]])
            self._target = np.concatenate([self._target[1:], target_pose[None]])
        return self._query(self._q, self._target)
