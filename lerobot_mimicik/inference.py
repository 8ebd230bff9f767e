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
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.noise import sample_normal

if TYPE_CHECKING:
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

Array = NDArray[np.float64]


class _JointStep(nn.Module):
    """Joints and poses to a joint step [rad], (1, dof): what is traced."""

    def __init__(self, policy: LearnedIKPolicy):
        super().__init__()
        self.network, self.conditioning, self.delta = (
            policy.average.network,
            policy.conditioning,
            policy.delta,
        )
        self.objective, self.clip = policy.objective, policy.config.clip_delta

    def forward(self, q: Tensor, current: Tensor, target: Tensor, noise: Tensor) -> Tensor:
        delta = self.objective.predict(self.network, self.conditioning(q, current, target), noise)
        return self.delta.unnormalise(delta.clamp(-1, 1) if self.clip else delta)


class TracedPolicy:
    """A policy's `predict_joints` for one history of frames, as one traced call. Its weights are those of now."""

    def __init__(self, policy: LearnedIKPolicy):
        self._chain = array_chain(policy.config.arm_description())
        self._lower, self._upper = (
            bound.double().cpu().numpy() for bound in (policy.arm.lower, policy.arm.upper)
        )
        self._device = policy.delta.lower.device
        self._seed, self._width = int(policy.noise_seed), policy.objective.draws * policy.config.dof
        self._queries, frames = 0, policy.config.n_obs_steps
        example = (
            torch.zeros(1, frames, policy.config.dof),
            torch.tensor([[[0.0] * 6 + [1.0]]]).repeat(1, frames, 1),
            torch.tensor([[[0.0] * 6 + [1.0]]]).repeat(1, frames, 1),
            torch.zeros(1, self._width),
        )
        with torch.no_grad(), warnings.catch_warnings():
            # torch announces that tracing will give way to export; the Python floor of this project has it.
            warnings.simplefilter("ignore", DeprecationWarning)
            warnings.simplefilter("ignore", torch.jit.TracerWarning)  # shapes are the same in every query
            traced = torch.jit.trace(
                _JointStep(policy).eval(), [each.to(self._device) for each in example], check_trace=False
            )
            self._step = torch.jit.freeze(traced)

    def __call__(self, q: Array, target: Array) -> Array:
        """The joint command [rad], (dof,).

        Args:
            q: joints of the last frames, oldest first [rad], (T_o, dof).
            target: target poses of the same frames, (T_o, 7).
        """
        rotation, position = self._chain.forward(q)
        current = np.concatenate([position, Rotation.from_matrix(rotation).as_quat(canonical=True)], axis=-1)
        target = np.where(target[:, 6:] < 0, np.concatenate([target[:, :3], -target[:, 3:]], axis=-1), target)
        index = torch.zeros(1, dtype=torch.int64)
        noise = sample_normal(index, self._width, seed=self._seed, step=self._queries)
        self._queries += 1
        inputs = [torch.from_numpy(each).float().unsqueeze(0) for each in (q, current, target)]
        with torch.inference_mode():
            step = self._step(*(each.to(self._device) for each in (*inputs, noise)))
        command = q[-1] + step[0].double().cpu().numpy()
        # As in `predict_joints`: joints measured a little outside their limits are never pushed further out.
        return np.clip(command, np.minimum(self._lower, q[-1]), np.maximum(self._upper, q[-1]))
