"""One query at a time, without Python between the network's operations.

A policy's `predict_joints` makes several hundred small torch calls. Alone that costs three times what the arithmetic
does; beside a driver's control thread each call may wait for the interpreter, and a step takes a frame's time.
Here the same computation is traced once and then runs as one call.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lerobot_mimicik.kinematics.point_chain import point_chain
from lerobot_mimicik.noise import sample_normal

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

Array = NDArray[np.float64]


class _JointStep(nn.Module):
    """Joints and poses to a joint step [rad], (dof,): what is traced."""

    def __init__(self, policy: LearnedIKPolicy):
        super().__init__()
        self.network, self.conditioning, self.delta = (
            policy.average.network,
            policy.conditioning,
            policy.delta,
        )
        self.objective, self.clip = policy.objective, policy.config.clip_delta

    def forward(self, frames: Tensor, noise: Tensor) -> Tensor:
        """`frames`: q, current and target pose side by side, (T_o, dof + 14)."""
        q, current, target = frames.float().unsqueeze(0).split([frames.shape[-1] - 14, 7, 7], dim=-1)
        delta = self.objective.predict(self.network, self.conditioning(q, current, target), noise)
        return self.delta.unnormalise(delta.clamp(-1, 1) if self.clip else delta)[0].double()


class TracedPolicy:
    """A policy's `predict_joints` for one history of frames, as one traced call. Its weights are those of now."""

    def __init__(self, policy: LearnedIKPolicy):
        self._chain = point_chain(policy.config.arm_description())
        self._lower, self._upper = (
            bound.double().cpu().numpy() for bound in (policy.arm.lower, policy.arm.upper)
        )
        self._device = policy.delta.lower.device
        self._seed, self._queries = int(policy.noise_seed), 0
        self._width = policy.objective.draws * policy.config.dof
        self._random = policy.objective.random
        self._zeros = torch.zeros(1, self._width, device=self._device)
        frames = torch.zeros(policy.config.n_obs_steps, policy.config.dof + 14, dtype=torch.float64)
        frames[:, [-8, -1]] = 1.0
        with torch.no_grad(), warnings.catch_warnings():
            # torch announces that tracing will give way to export; the Python floor of this project has it.
            warnings.simplefilter("ignore", DeprecationWarning)
            warnings.simplefilter("ignore", torch.jit.TracerWarning)  # shapes are the same in every query
            example = (frames.to(self._device), self._zeros)
            traced = torch.jit.trace(_JointStep(policy).eval(), example, check_trace=False)
            self._step = torch.jit.freeze(traced)

    def __call__(self, q: Array, target: Array) -> Array:
        """The joint command [rad], (dof,).

        Args:
            q: joints of the last frames, oldest first [rad], (T_o, dof).
            target: target poses of the same frames, (T_o, 7).
        """
        sign = np.where(target[:, 6:] < 0, -1.0, 1.0)
        # Every torch call gives the interpreter away: the numbers go in at once.
        frames = np.concatenate(
            [q, np.array([self._chain.pose(each) for each in q]), target[:, :3], sign * target[:, 3:]],
            axis=-1,
        )
        with torch.inference_mode():
            step = self._step(torch.from_numpy(frames).to(self._device), self._noise()).cpu().numpy()
        command = q[-1] + step
        # As in `predict_joints`: joints measured a little outside their limits are never pushed further out.
        return np.clip(command, np.minimum(self._lower, q[-1]), np.maximum(self._upper, q[-1]))

    def _noise(self) -> Tensor:
        if not self._random:
            return self._zeros
        index = torch.zeros(1, dtype=torch.int64)
        noise = sample_normal(index, self._width, seed=self._seed, step=self._queries)
        self._queries += 1
        return noise.to(self._device)
