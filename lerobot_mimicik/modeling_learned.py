"""What every learned policy here shares: all but its network and its objective.

A policy answers the current joints and a target end-effector pose with a joint command.

training    o, delta q -> objective loss (LeRobot's step), then FK(q + delta q_hat) against the target
            pose (a step of its own, in `update()`), then the weights' moving average follows
inference   o -> delta q_hat (averaged weights) -> q + delta q_hat, within the training steps and limits

A new one is a configuration and a policy class whose `build` makes the network and the objective.
"""

from abc import abstractmethod
from pathlib import Path
from typing import Any, Self

import torch
from huggingface_hub import CommitInfo, ModelCard
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_mimicik.batches.frames import FrameReader
from lerobot_mimicik.batches.loading import FrameTable, read_batched
from lerobot_mimicik.batches.plausible import check_table
from lerobot_mimicik.batches.statistics import RunningRange, iterate_frames
from lerobot_mimicik.conditioning import CONDITIONINGS
from lerobot_mimicik.configuration_learned import MAX_WEIGHTS, LearnedIKConfig
from lerobot_mimicik.ema import ExponentialAverage
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.fk_loss import fk_consistency_loss
from lerobot_mimicik.noise import sample_normal, sample_uniform
from lerobot_mimicik.normalisation import MinMax
from lerobot_mimicik.objective import Objective
from lerobot_mimicik.optimiser import SharedOptimiser
from lerobot_mimicik.publishing.hub import card_after_training, push_policy, weights_digest
from lerobot_mimicik.publishing.training_facts import TrainingFacts
from lerobot_mimicik.weights import load_tensors, read_tensors


class LearnedIKPolicy(PreTrainedPolicy):
    """Learned inverse kinematics as a LeRobot policy.

    Args:
        config: See `.configuration_learned.LearnedIKConfig`.
        dataset_stats: LeRobot's column statistics; unused, since the policy needs those of derived
            quantities.
        dataset_meta: The training dataset's metadata. With it the policy fits its normalisation on the
            training episodes; without it (a checkpoint) the statistics come with the weights.
    """

    # LeRobot asks every subclass for these two.
    config_class: type[LearnedIKConfig] = LearnedIKConfig
    name = "learned"

    training_step: Tensor
    noise_seed: Tensor

    # Where the policy was loaded from: what lies beside the weights there goes along to the Hub.
    _source: str | None = None
    # Of the data that it is trained on.
    _facts: TrainingFacts | None = None

    def __init__(
        self,
        config: LearnedIKConfig,
        dataset_stats: dict[str, dict[str, Tensor]] | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ):
        if not isinstance(config, self.config_class):
            raise TypeError(
                f"no {type(self).__name__} checkpoint: expected a policy of type {self.name!r}, "
                f"got {config.type!r}"
            )
        super().__init__(config)
        if dataset_meta is not None:
            config.use_dataset(dataset_meta.root, dataset_meta.features)
        config.validate_features()
        self.config: LearnedIKConfig = config
        self._arm = SerialArm(config.arm_description(), dtype=torch.float32)
        self._reader = FrameReader(config)
        self.conditioning = CONDITIONINGS[config.conditioning](config.dof)
        self.delta = MinMax(config.dof)
        self._check_weights()
        self.network, self.objective = self.build()
        self.average = ExponentialAverage(self.network, config.ema_decay)
        self.register_buffer("training_step", torch.zeros((), dtype=torch.int64))
        self.register_buffer("noise_seed", torch.tensor(torch.initial_seed() % 2**62))
        self._optimiser = SharedOptimiser(self.network.parameters())
        self._fk_inputs: tuple[Tensor, ...] | None = None
        self._fk_report: dict[str, float] = {}
        if dataset_meta is not None:
            self._prepare_training(dataset_meta)
        self.reset()

    # --- Set-up ---

    @abstractmethod
    def build(self) -> tuple[nn.Module, Objective]:
        """The untrained network, and the objective that trains it; `self.conditioning.dim` numbers a frame go in."""

    def _check_weights(self) -> None:
        """Refuses a network that would not fit into memory, before any is taken."""
        with torch.device("meta"):
            network, _ = self.build()
        weights = sum(parameter.numel() for parameter in network.parameters())
        if weights > MAX_WEIGHTS:
            raise ValueError(
                f"the configuration asks for a network of {weights:,} weights: expected at most {MAX_WEIGHTS:,}"
            )

    @property
    def arm(self) -> SerialArm:
        """Forward kinematics on the policy's device (the chain is no nn.Module: `.to()` passes it by)."""
        if self._arm.lower.device != self.delta.lower.device:
            self._arm = self._arm.to(device=self.delta.lower.device)
        return self._arm

    def _prepare_training(self, meta: LeRobotDatasetMetadata) -> None:
        dataset = read_batched(meta) if self.config.batched_reads else None
        if dataset is not None:
            table = dataset.frame_table
        else:
            from lerobot.datasets import LeRobotDataset

            table = FrameTable(LeRobotDataset(meta.repo_id, root=meta.root))
        check_table(table, self.config, str(meta.root))
        self._facts = TrainingFacts.of_dataset(meta)
        self.prepare(table, meta)

    def prepare(self, table: FrameTable, meta: LeRobotDatasetMetadata) -> None:
        """Takes from the training episodes what training needs beside its batches."""
        if self.config.pretrained_path is None:  # else the checkpoint's statistics belong to its weights
            self.fit_normalisation(table)

    def fit_normalisation(self, table: FrameTable) -> None:
        """Sets every normaliser from recorded frames.

        Raises:
            ValueError: If a quantity is not finite, or no frame has a target to learn from.
        """
        ranges: dict[str, RunningRange] = {}
        for frames in iterate_frames(table, self.config, self._arm):
            q, valid = frames.q[:, -1], frames.valid
            quantities = self.conditioning.quantities(
                q[valid], frames.pose_current[valid, -1], frames.pose_target[valid, -1]
            )
            quantities["delta"] = (frames.q_target - q)[valid]
            for name, values in quantities.items():
                ranges.setdefault(name, RunningRange(values.shape[-1])).update(values)
        for name, found in ranges.items():
            normaliser = self.delta if name == "delta" else getattr(self.conditioning, name)
            try:
                normaliser.fit(found.lower, found.upper)
            except ValueError as error:
                raise ValueError(f"statistics of {name}: {error}") from error

    @classmethod
    def _load_as_safetensor(
        cls, model: "LearnedIKPolicy", model_file: str, map_location: str, strict: bool
    ) -> "LearnedIKPolicy":
        """LeRobot's hook that loads the weights: strictly, whatever it asks for."""
        load_tensors(model, read_tensors(model_file), model_file)
        return model

    def get_optim_params(self) -> Any:
        """The network's parameters; the averaged copy is not trained."""
        return self.network.parameters()

    # --- Training ---

    def forward(self, batch: dict[str, Tensor], reduction: str = "mean") -> tuple[Tensor, dict[str, float]]:
        """Objective loss of a batch (plus the FK loss where `fk_update=joint`).

        In training mode the trained weights are evaluated, otherwise their moving average; noise is a
        function of sample and training step, so that the evaluation loss is comparable between steps.

        Args:
            batch: A LeRobot batch with the configured time windows.
            reduction: `mean`, or `none` for one loss a sample.

        Returns:
            The loss, a scalar or shape (B,), and numbers for the log.

        Raises:
            KeyError: If a column is missing.
            ValueError: If `reduction` is unknown.
        """
        if reduction not in ("mean", "none"):
            raise ValueError(f"reduction={reduction!r}: expected 'mean' or 'none'")
        frames = self._reader.training_frames(batch, self.arm)
        obs = self.conditioning(frames.q, frames.pose_current, frames.pose_target)
        action = self.delta.normalise(frames.q_target - frames.q[:, -1])
        noise, time = self._noise(batch, action)
        network = self.network if self.training else self.average.network
        loss = self.objective.loss(network, obs, action, noise, time)
        log = {f"{self.objective.name}_loss": mean_of_valid(loss, frames.valid).item()}
        if self.training and self.config.fk_weight > 0:
            fk_inputs = (obs, frames.q[:, -1], frames.pose_target[:, -1], noise, frames.valid)
            if self.config.fk_update == "joint":
                fk_loss = self._fk_loss(*fk_inputs)
                loss = loss + self.config.fk_weight * fk_loss
                log["fk_loss"] = mean_of_valid(fk_loss, frames.valid).item()
            else:
                self._fk_inputs = fk_inputs
                self._optimiser.watch()
                log |= self._fk_report
        if reduction == "none":
            return loss * frames.valid, log
        return mean_of_valid(loss, frames.valid), log

    def update(self) -> None:
        """What follows LeRobot's optimiser step: the FK pass, then the moving average."""
        if self._fk_inputs is not None:
            inputs, self._fk_inputs = self._fk_inputs, None

            def weighted_loss() -> Tensor:
                return self.config.fk_weight * mean_of_valid(self._fk_loss(*inputs), inputs[-1])

            loss, norm = self._optimiser.step(weighted_loss, self.config.grad_clip_norm)
            self._fk_report = {"fk_loss": loss.item() / self.config.fk_weight, "fk_grad_norm": norm.item()}
        self.average.update(self.network, int(self.training_step))
        self.training_step += 1

    def _fk_loss(self, obs: Tensor, q: Tensor, pose_target: Tensor, noise: Tensor, valid: Tensor) -> Tensor:
        """FK consistency of the predicted command, shape (B,)."""
        q_cmd = q + self.delta.unnormalise(self.objective.predict(self.network, obs, noise))
        # Millimetres are lost in half precision: FK stays in float32 under autocast.
        with torch.autocast(q.device.type, enabled=False):
            return fk_consistency_loss(
                self.arm,
                q_cmd.float(),
                pose_target,
                rotation_weight=self.config.fk_rotation_weight,
                position_scale=self.config.fk_position_scale,
            )

    def _noise(self, batch: dict[str, Tensor], action: Tensor) -> tuple[Tensor, Tensor]:
        """Normal noise, shape (B, draws * dof), and times, shape (B,), that belong to the samples."""
        width = self.objective.draws * action.shape[-1]
        index = batch.get("index")
        if index is None:  # a batch that does not come from a LeRobot dataset
            return action.new_empty(len(action), width).normal_(), torch.rand_like(action[:, 0])
        index = index.flatten()
        step = self.training_step if self.training else -1
        seed = int(self.noise_seed)
        return (
            sample_normal(index, width, seed=seed, step=step),
            sample_uniform(index, 1, seed=seed + 1, step=step)[:, 0],
        )

    # --- Inference ---

    def reset(self) -> None:
        """Forgets the observation history; call it when an episode starts."""
        self._history: Tensor | None = None
        self._queries = 0

    @torch.no_grad()
    def predict_joints(
        self, q: Tensor, pose_target: Tensor, pose_current: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Joint commands for target poses, from the averaged weights.

        Without a time axis the policy remembers the frames since `reset`, in which the batch size
        must not change; with one the history is given and nothing is remembered.

        Args:
            q: Measured joints, rad, shape (B, dof) or (B, T_o, dof).
            pose_target: T_base_tool asked for, xyz in metres and xyzw, shape (B, 7) or (B, T_o, 7).
            pose_current: T_base_tool measured, same shape; FK of `q` if None.
            noise: What a generative objective draws, shape (B, draws * dof); seeded noise if None.

        Returns:
            Commands, rad, shape (B, dof).

        Raises:
            ValueError: If a shape does not fit or a number is not finite.
        """
        self._check_inputs(q, pose_target, pose_current)
        target = self._reader.pose(pose_target)
        current = self.arm.forward(q) if pose_current is None else self._reader.pose(pose_current)
        obs = self.conditioning(q, current, target)
        if obs.ndim == 2:
            obs = self._remember(obs)
            q = q.unsqueeze(1)
        drawn = self._drawn(len(q), q.device)
        delta = self.objective.predict(self.average.network, obs, drawn if noise is None else noise)
        if self.config.clip_delta:
            delta = delta.clamp(-1, 1)
        return self._within_limits(q[:, -1], self.delta.unnormalise(delta))

    def _drawn(self, queries: int, device: torch.device) -> Tensor:
        """Noise for the next queries, shape (B, draws * dof)."""
        index = torch.arange(queries, device=device)
        width = self.objective.draws * self.config.dof
        self._queries += 1
        return sample_normal(index, width, seed=int(self.noise_seed), step=self._queries - 1)

    def _within_limits(self, q_last: Tensor, step: Tensor) -> Tensor:
        """Commands, shape (B, dof); joints measured outside their limits are never pushed further out."""
        command = q_last + step
        lower, upper = self.arm.lower.to(q_last), self.arm.upper.to(q_last)
        return command.clamp(torch.minimum(lower, q_last), torch.maximum(upper, q_last))

    def _remember(self, obs: Tensor) -> Tensor:
        """Appends a frame, shape (B, n), to the history; the first frame stands for those before it."""
        if self._history is None:
            self._history = obs.unsqueeze(1).expand(-1, self.config.n_obs_steps, -1)
        elif len(self._history) != len(obs):
            raise ValueError(
                f"batch of {len(obs)} after one of {len(self._history)}: call reset() in between"
            )
        else:
            self._history = torch.cat([self._history[:, 1:], obs.unsqueeze(1)], dim=1)
        return self._history

    def _check_inputs(self, q: Tensor, pose_target: Tensor, pose_current: Tensor | None) -> None:
        n, dof = self.config.n_obs_steps, self.config.dof
        lead = tuple(q.shape[:-1])
        if q.shape[-1:] != (dof,) or len(lead) not in (1, 2) or (len(lead) == 2 and lead[1] != n):
            raise ValueError(f"q: expected shape (B, {dof}) or (B, {n}, {dof}), got {tuple(q.shape)}")
        for name, values, width in (
            ("q", q, dof),
            ("pose_target", pose_target, 7),
            ("pose_current", pose_current, 7),
        ):
            if values is None:
                continue
            if tuple(values.shape) != (*lead, width):
                raise ValueError(f"{name}: expected shape {(*lead, width)}, got {tuple(values.shape)}")
            if not torch.isfinite(values).all():
                raise ValueError(f"{name} is not finite: {values.tolist()}")

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """A chunk of one action, shape (B, 1, d): see `select_action`."""
        return self.select_action(batch, **kwargs).unsqueeze(1)

    # --- The Hub ---

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **options: Any) -> Self:
        """Loads a checkpoint from a folder or a Hub repository, with LeRobot's options.

        Raises:
            FileNotFoundError: If there is no checkpoint.
            TypeError: If it is one of another policy.
        """
        policy = super().from_pretrained(pretrained_name_or_path, **options)
        policy._source = str(pretrained_name_or_path)
        return policy

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        """LeRobot's hook that writes a checkpoint: what is known of the training data goes along."""
        super()._save_pretrained(save_directory, state_dict=state_dict)
        if self._facts is not None:
            self._facts.save(save_directory)

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: Any = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> ModelCard:
        """The card that LeRobot uploads at the end of training."""
        return card_after_training(self, dataset_repo_id, license, tags, cfg, dataset_meta)

    def push_to_hub(self, repo_id: str, **options: Any) -> CommitInfo:
        """Uploads the policy, its processors, its card and its evaluation: see `.hub.push_policy`.

        What lies beside the weights is taken from where the policy was loaded, unless `source` says otherwise.
        """
        return push_policy(self, repo_id, **({"source": self._source} | options))

    def digest(self) -> str:
        """What tells these weights from others; see `weights_digest`."""
        return weights_digest(self.state_dict())

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Absolute joint commands in the dataset's units and layout.

        The gripper is not inverse kinematics: numbers after the pose in the target column are passed
        through, and without them the measured ones.

        Args:
            batch: `observation.state` and the target pose column (and the current pose's where the policy
                was trained with it), shape (B, d) or (B, T_o, d).

        Returns:
            Shape (B, d).

        Raises:
            KeyError: If the state or the target pose is missing.
            ValueError: If numbers have the wrong shape, are not finite, or a gripper command has no source.
        """
        for key in (OBS_STATE, self.config.target_pose_key):
            if key not in batch:
                raise KeyError(f"the observation has no {key!r}; it has {sorted(batch)}")
        state, target = batch[OBS_STATE], batch[self.config.target_pose_key]
        current = batch.get(self.config.current_pose_key) if self.config.current_pose_key else None
        q = self._reader.joints(state, self.config.state_joint_columns)
        command = self.predict_joints(
            q, target[..., :7], None if current is None else current[..., :7], noise=kwargs.get("noise")
        )
        if state.ndim == 3:
            state, target = state[:, -1], target[:, -1]
        return self._command_layout(command / self._reader.to_radians, state, target[:, 7:])

    def _command_layout(self, joints: Tensor, state: Tensor, extra: Tensor) -> Tensor:
        """Puts joints, shape (B, dof), and what is passed through into a command, shape (B, d)."""
        action = (self.config.output_features or {}).get(ACTION)
        width = self.config.dof if action is None else action.shape[-1]
        columns = self.config.action_joint_columns or list(range(self.config.dof))
        others = [i for i in range(width) if i not in columns]
        command = joints.new_empty(len(joints), width)
        command[:, columns] = joints
        if others:
            state_columns = self.config.state_joint_columns or list(range(self.config.dof))
            measured = [i for i in range(state.shape[-1]) if i not in state_columns]
            passed = extra if extra.shape[-1] else state[:, measured]
            if passed.shape[-1] != len(others):
                raise ValueError(
                    f"the command has {len(others)} numbers besides the joints, but {passed.shape[-1]} are given "
                    f"(after the pose in {self.config.target_pose_key!r}, else in {OBS_STATE!r})"
                )
            command[:, others] = passed.to(command)
        return command


def mean_of_valid(values: Tensor, valid: Tensor) -> Tensor:
    """Mean over the valid samples, a scalar."""
    return (values * valid).sum() / valid.sum().clamp(min=1)
