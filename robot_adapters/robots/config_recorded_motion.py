"""Configuration of the teleoperator that plays a recording."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig


@TeleoperatorConfig.register_subclass("recorded_motion")
@dataclass
class RecordedMotionConfig(TeleoperatorConfig):
    """Plays an episode of a LeRobot dataset as if an operator made it, at its own speed; then its last frame."""

    # Folder of the dataset.
    dataset_root: str = ""
    episode: int = 0
    # Column to play: action, or a pose column such as observation.ee_target for robots in end-effector space.
    column: str = "action"
    # Opening of the gripper [m] where the recording has none; null: leave it out.
    gripper: float | None = None
