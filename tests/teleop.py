"""Small teleoperation datasets for tests: smooth random joint motion of an arm, written as LeRobot v3."""

from pathlib import Path

import numpy as np
import torch

from lerobot_mimicik.data.writer import Episode, write_dataset
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm


def joint_motion(arm: SerialArm, frames: int, rng: np.random.Generator) -> np.ndarray:
    """A sum of slow sines around a home configuration: rad, shape (frames, dof), under 0.08 rad a frame."""
    t = np.arange(frames)[:, None] / 20
    home = np.asarray(arm.description.home)
    motion = np.zeros((frames, arm.dof))
    for _ in range(3):
        frequency, phase = rng.uniform(0.05, 0.4, arm.dof), rng.uniform(0, 2 * np.pi, arm.dof)
        motion += rng.uniform(0.05, 0.2, arm.dof) * np.sin(2 * np.pi * frequency * t + phase)
    return home + motion


def teleop_episodes(
    episodes: int, frames: int = 40, seed: int = 0, robot: str = "airbot_play"
) -> list[Episode]:
    """Episodes whose state follows the command at the next frame."""
    description = describe_arm(robot)
    arm = SerialArm(description, dtype=torch.float64)
    rng = np.random.default_rng(seed)
    found = []
    for i in range(episodes):
        q = joint_motion(arm, frames + 1, rng)
        poses = arm.forward(torch.from_numpy(q)).numpy()
        found.append(Episode(q[:-1], q[1:], poses[:-1], poses[1:], "move around", f"session-{i // 4}"))
    return found


def write_teleop(
    root: Path, episodes: int = 6, frames: int = 40, seed: int = 0, robot: str = "airbot_play"
) -> Path:
    """Writes a dataset and returns its root."""
    write_dataset(
        root, f"local/{root.name}", teleop_episodes(episodes, frames, seed, robot), describe_arm(robot)
    )
    return root
