"""One query at a time in numpy: what surrounds a policy's step, whichever engine computes it. No torch is imported."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.inference.engine import Engine
from lerobot_mimicik.inference.engines import AUTO, make_engine
from lerobot_mimicik.inference.facts import StepFacts
from lerobot_mimicik.inference.noise import query_normal
from lerobot_mimicik.kinematics.point_chain import point_chain

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

Array = NDArray[np.float64]


class SingleQuery:
    """A policy's `predict_joints` for one history of frames; frozen weights at construction time."""

    def __init__(self, facts: StepFacts, engine: Engine, name: str = "") -> None:
        """`name` of the engine, for tables."""
        self.facts, self.engine, self.name = facts, engine, name
        self._chain = point_chain(facts.description)
        self._zeros = np.zeros((1, facts.width), dtype=np.float32)
        self._queries = 0

    @classmethod
    def of(cls, policy: LearnedIKPolicy, engine: str = AUTO) -> SingleQuery:
        """For a policy; raises as `make_engine`."""
        name, step = make_engine(policy, engine)
        return cls(StepFacts.of(policy), step, name)

    def __call__(self, q: Array, target: Array) -> Array:
        """The joint command [rad], (dof,).

        Args:
            q: Joints of the last frames, oldest first [rad], (T_o, dof).
            target: Target poses of the same frames, (T_o, 7).
        """
        sign = np.where(target[:, 6:] < 0, -1.0, 1.0)
        # Every torch call gives the interpreter away: the numbers go in at once.
        frames = np.concatenate(
            [q, np.array([self._chain.pose(each) for each in q]), target[:, :3], sign * target[:, 3:]],
            axis=-1,
        )
        command = q[-1] + self.engine(frames, self._noise())
        # As in `predict_joints`: joints measured a little outside their limits are never pushed further out.
        return np.clip(command, np.minimum(self.facts.lower, q[-1]), np.maximum(self.facts.upper, q[-1]))

    def _noise(self) -> NDArray[np.float32]:
        if not self.facts.random:
            return self._zeros
        noise = query_normal(self.facts.width, seed=self.facts.seed, query=self._queries)
        self._queries += 1
        return noise
