"""Configuration of the teleoperator that reads the keys of its terminal."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.teleoperators.config import TeleoperatorConfig

from lerobot_mimicik.configuration_reasons import reasons_for_users


@TeleoperatorConfig.register_subclass("terminal_keyboard")
@dataclass
class TerminalKeyboardConfig(TeleoperatorConfig):
    """Leads an end effector by the keys of a terminal, also over SSH and under Wayland, where LeRobot's keyboard_ee is deaf.

    Arrows: ahead, back, left, right. w and s: up and down. o and c: open and close the gripper.
    """

    # Frames that a key press lasts: 2 mm each, or the robot's --robot.delta_step. Held keys repeat.
    frames_per_press: int = 3

    def __post_init__(self) -> None:
        with reasons_for_users():
            if self.frames_per_press < 1:
                raise ValueError(f"frames_per_press={self.frames_per_press}: expected at least 1")
