"""From a LeRobot batch to the quantities of the method: q, current pose, target pose, target joints."""

import math
from dataclasses import dataclass

import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_mimicik.configuration_learned import LearnedIKConfig
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.kinematics.rotations import half_sphere


@dataclass(frozen=True)
class IKFrames:
    """A batch of observation histories and what should follow.

    Attributes:
        q: Measured joints, rad, shape (B, T_o, dof); the last frame is the current one.
        pose_current: T_base_tool measured, shape (B, T_o, 7), metres and xyzw with w >= 0.
        pose_target: T_base_tool asked for, shape (B, T_o, 7).
        q_target: Recorded target joints of the current frame, rad, shape (B, dof).
        valid: Whether the recording has that target, bool, shape (B,).
    """

    q: Tensor
    pose_current: Tensor
    pose_target: Tensor
    q_target: Tensor
    valid: Tensor


class FrameReader:
    """Reads the columns that a configuration names, in SI units, with FK where a pose is not recorded."""

    def __init__(self, config: LearnedIKConfig):
        self.config = config
        self.to_radians = math.pi / 180 if config.joint_units == "deg" else 1.0

    def joints(self, values: Tensor, columns: list[int] | None) -> Tensor:
        """Arm joints in rad, shape (*, dof), out of a column's values, shape (*, d)."""
        chosen = values[..., : self.config.dof] if columns is None else values[..., columns]
        return chosen.float() * self.to_radians

    def training_frames(self, batch: dict[str, Tensor], arm: SerialArm) -> IKFrames:
        """Reads a training batch with its time windows.

        Args:
            batch: LeRobot batch with the windows of `config.observation_delta_indices`.
            arm: Forward kinematics on the batch's device.

        Raises:
            KeyError: If a column is missing; the message lists those that exist.
        """
        config, n = self.config, self.config.n_obs_steps
        states = self.joints(_column(batch, OBS_STATE), config.state_joint_columns)
        if config.target == "next_state":
            q, padding = states[:, :n], batch.get(f"{OBS_STATE}_is_pad")
            targets = _repeat_first(states[:, 1:], padding)
        else:
            q, padding = states, batch.get(f"{ACTION}_is_pad")
            targets = self.joints(_column(batch, ACTION), config.action_joint_columns)
        valid = ~padding[:, -1] if padding is not None else q.new_ones(len(q), dtype=torch.bool)
        if config.target_pose_recorded:
            pose_target = self.pose(_column(batch, config.target_pose_key))[:, :n]
        else:
            pose_target = arm.forward(targets)
        if config.current_pose_key is not None:
            pose_current = self.pose(_column(batch, config.current_pose_key))[:, :n]
        else:
            pose_current = arm.forward(q)
        return IKFrames(q, pose_current, pose_target, targets[:, -1], valid)

    @staticmethod
    def pose(values: Tensor) -> Tensor:
        """Pose on the half-sphere w >= 0, shape (*, 7), out of a column's values, shape (*, >= 7)."""
        pose = values[..., :7].float()
        return torch.cat([pose[..., :3], half_sphere(pose[..., 3:])], dim=-1)


def _repeat_first(targets: Tensor, padding: Tensor | None) -> Tensor:
    """Gives the frames before an episode the first frame's target, as they have its state.

    Args:
        targets: Next states of the observed frames, shape (B, T_o, dof).
        padding: Which of the states lie outside the episode, bool, shape (B, T_o + 1).
    """
    if padding is None:
        return targets
    frames = list(targets.unbind(dim=1))
    for i in range(len(frames) - 2, -1, -1):
        frames[i] = torch.where(padding[:, i, None], frames[i + 1], frames[i])
    return torch.stack(frames, dim=1)


def _column(batch: dict[str, Tensor], key: str) -> Tensor:
    if key not in batch:
        raise KeyError(f"the batch has no {key!r}; it has {sorted(batch)}")
    return batch[key]
