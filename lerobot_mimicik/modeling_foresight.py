"""The foresight policy: a filter that a network tunes anew for every frame, trained in its own closed loop.

    last H targets, last commands ──Features──> least squares step, observation ──network──> filter coefficients
                                                        │                                          │
                                                        └────────── coefficients of history ──────(x)──> joint step

The network does not answer with a step but with the weights of a linear filter over what it sees, joint by joint: a
still hand needs another one than a fast hand, a trembling hand another one than a steady one, and with the right weights
a steady hand is met exactly. Untrained, the policy goes half the damped least squares step.
"""

from __future__ import annotations

from itertools import pairwise
from typing import cast

import numpy as np
import torch
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_mimicik.batches.loading import FrameTable
from lerobot_mimicik.batches.rollouts import Hand, drive, pieces
from lerobot_mimicik.configuration_foresight import ForesightConfig
from lerobot_mimicik.foresight.features import PAST_STEPS, Features
from lerobot_mimicik.foresight.network import STEP_RAD, lags
from lerobot_mimicik.modeling_learned import LearnedIKPolicy, mean_of_valid
from lerobot_mimicik.objective import OBJECTIVES, Objective


class FilterNetwork(nn.Module):
    """Observation, noisy answer and two times in, the filtered answer out; see `foresight.network` for the same in numpy.

    Args:
        width: Numbers of an observation.
        dof: Number of joints.
        n_lags: Rows of the observation that are filtered, from its beginning.
        hidden_dim, n_layers: Of the hidden layers.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, width: int, dof: int, n_lags: int, hidden_dim: int, n_layers: int):
        super().__init__()
        self.dof, self.n_lags = dof, n_lags
        widths = [width + dof + 2, *[hidden_dim] * n_layers]
        hidden = [layer for sizes in pairwise(widths) for layer in (nn.Linear(*sizes), nn.GELU())]
        last = nn.Linear(hidden_dim, dof * (n_lags + 1))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(*hidden, last)
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("scale", torch.ones(width))

    def encode(self, obs: Tensor) -> Tensor:
        """Least squares steps and observations side by side, (B, dof + width), of one row each, (B, 1, dof + width)."""
        return obs.flatten(1)

    def forward(self, x: Tensor, s: float | Tensor, t: float | Tensor, tokens: Tensor) -> Tensor:
        """f(x, s, t | o) in units of `STEP_RAD`; x (B, dof), s and t numbers or (B,), tokens of `encode`."""
        base, observation = tokens.split([self.dof, tokens.shape[-1] - self.dof], dim=-1)
        times = [
            torch.as_tensor(time, dtype=x.dtype, device=x.device).expand(len(x))[:, None] for time in (s, t)
        ]
        told = torch.cat([(observation - self.mean) / self.scale, x, *times], dim=-1)
        chosen = self.layers(told).unflatten(-1, (self.n_lags + 1, self.dof))
        seen = observation[:, : self.n_lags * self.dof].unflatten(-1, (self.n_lags, self.dof))
        return (0.5 * base + (chosen[:, :-1] * seen).sum(dim=1)) / STEP_RAD + chosen[:, -1]


class ForesightPolicy(LearnedIKPolicy):
    """Sees through the trembling of a hand; see `LearnedIKPolicy` for what it shares.

    Args:
        config: See `ForesightConfig`.
        dataset_stats, dataset_meta: As for `LearnedIKPolicy`.
    """

    config_class = ForesightConfig
    name = "mimicik_foresight"
    config: ForesightConfig
    network: FilterNetwork
    features: Features

    _motions: list[np.ndarray] | None = None
    _samples: tuple[Tensor, ...] = ()
    _round = -1

    def build(self) -> tuple[nn.Module, Objective]:
        """The filter network under the configured objective."""
        config = self.config
        self.features = Features(config.arm_description(), config.n_obs_steps)
        network = FilterNetwork(
            self.features.width, config.dof, lags(config.n_obs_steps), config.hidden_dim, config.n_layers
        )
        return network, OBJECTIVES[config.objective](config)

    def prepare(self, table: FrameTable, meta: LeRobotDatasetMetadata) -> None:
        """Takes the clean motion of the training episodes, and the scale of what is seen along it."""
        config, reader = self.config, self._reader
        key, columns = (
            (ACTION, config.action_joint_columns)
            if config.target == "action"
            else (OBS_STATE, config.state_joint_columns)
        )
        joints = reader.joints(table.columns[key], columns).numpy().astype(float)
        self._motions = pieces(joints, table.columns["episode_index"].numpy())
        if not self._motions:
            raise ValueError(f"{meta.root} has no episode that is long enough to learn from")
        self._fps = float(meta.fps)
        if config.pretrained_path is None:
            self.delta.fit(*(torch.full((config.dof,), sign * STEP_RAD) for sign in (-1.0, 1.0)))
            _, observation, *_ = self._driven(0)
            for network in (self.network, cast("FilterNetwork", self.average.network)):
                network.mean.copy_(observation.mean(dim=0))
                network.scale.copy_(observation.std(dim=0).clamp(min=1e-4))

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Objective loss of the batch's share of the present round.

        In training mode each sample's index names a frame of the round's rollouts, which the policy drove along the clean
        motion; otherwise the recorded frames themselves are answered, without tremor, by the moving average.
        Arguments, result and errors are those of `LearnedIKPolicy.forward`.
        """
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction={reduction!r}: expected 'mean' or 'none'")
        base, observation, q, step = self._rolled_out(batch) if self.training else self._recorded(batch)
        valid = torch.ones(len(q), dtype=torch.bool, device=q.device)
        obs, action = torch.cat([base, observation], dim=-1).unsqueeze(1), self.delta.normalise(step)
        noise, time = self._noise(batch, action)
        network = self.network if self.training else self.average.network
        loss = self.objective.loss(network, obs, action, noise, time)
        log = {f"{self.objective.name}_loss": loss.mean().item()}
        if self.training and self.config.fk_weight > 0:
            fk_inputs = (obs, q, self.arm.forward(q + step), noise, valid)
            if self.config.fk_update == "joint":
                fk_loss = self._fk_loss(*fk_inputs)
                loss = loss + self.config.fk_weight * fk_loss
                log["fk_loss"] = fk_loss.mean().item()
            else:
                self._fk_inputs = fk_inputs
                self._optimiser.watch()
                log |= self._fk_report
        return (loss, log) if reduction == "none" else (mean_of_valid(loss, valid), log)

    # --- Closed-loop rounds ---

    def _rolled_out(self, batch: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """Frames of the present round, one for each sample of the batch."""
        if self._motions is None:
            raise RuntimeError("a foresight policy is trained on a dataset: it was built without one")
        present = int(self.training_step) // self.config.rollout_every
        if present != self._round:
            self._samples, self._round = self._driven(present), present
        index = batch["index"].flatten() % len(self._samples[0])
        return tuple(column[index] for column in self._samples)

    def _driven(self, number: int) -> tuple[Tensor, ...]:
        """The rollouts of a round by the averaged weights of now; a function of these, the seed and the number."""
        config, motions = self.config, self._motions
        assert motions is not None
        rng = np.random.default_rng((int(self.noise_seed), number))
        chosen, frames = [], 0
        for i in rng.permutation(len(motions)):
            if frames >= config.rollout_frames:
                break
            chosen.append(motions[i])
            frames += len(motions[i])
        hand = Hand(self._fps, config.tremor_mm, config.steady, config.pace, config.liveliness)
        samples = drive(
            self.features, config.arm_description(), chosen, self._steps, hand, config.change_weight, rng
        )
        return tuple(
            self._tensor(column) for column in (samples.base, samples.observation, samples.q, samples.step)
        )

    @torch.no_grad()
    def _steps(self, base: np.ndarray, observation: np.ndarray) -> np.ndarray:
        """Joint steps (B, dof) [rad] by the averaged weights."""
        obs = self._tensor(np.concatenate([base, observation], axis=1)).unsqueeze(1)
        noise = torch.zeros(len(obs), self.objective.draws * self.config.dof, device=obs.device)
        answer = self.objective.predict(self.average.network, obs, noise)
        return self.delta.unnormalise(answer.clamp(-1, 1)).double().cpu().numpy()

    def _recorded(self, batch: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """The batch's own frames: what is seen, and the recorded steps."""
        frames = self._reader.training_frames(batch, self.arm)
        base, observation = self._seen(frames.q, frames.pose_target)
        return base, observation, frames.q[:, -1], frames.q_target - frames.q[:, -1]

    def _seen(self, q: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Answers of `Features` for histories q (B, H, dof) and targets (B, H, 7)."""
        joints = q.double().cpu().numpy()
        steps = np.diff(joints, axis=1)[:, -PAST_STEPS:]
        base, observation = self.features(joints[:, -1], target.double().cpu().numpy(), steps)
        return self._tensor(base), self._tensor(observation)

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float32, device=self.delta.lower.device)

    # --- Inference ---

    @torch.no_grad()
    def predict_joints(
        self, q: Tensor, pose_target: Tensor, pose_current: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """As `LearnedIKPolicy.predict_joints`; the measured pose is not looked at."""
        self._check_inputs(q, pose_target, pose_current)
        target = self._reader.pose(pose_target)
        if q.ndim == 2:
            frames = self._remember(torch.cat([q, target], dim=-1))
            q, target = frames.split([self.config.dof, 7], dim=-1)
        obs = torch.cat(self._seen(q, target), dim=-1).unsqueeze(1)
        if noise is None:
            noise = self._drawn(len(q), q.device)
        delta = self.objective.predict(self.average.network, obs, noise).clamp(-1, 1)
        return self._within_limits(q[:, -1], self.delta.unnormalise(delta))
