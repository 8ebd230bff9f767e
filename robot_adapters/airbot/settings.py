"""Settings of the AIRBOT Play driver; the defaults are those of the vendor's joint-following mode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from robot_adapters.airbot.boards import Tool
from robot_adapters.airbot.gripper import (
    GRIPPER_KD,
    GRIPPER_KP,
    MAX_OPENING,
    motor_angle_from_opening,
    opening_from_motor_angle,
)
from robot_adapters.can.settings import GripperMotor, LoopSettings


@dataclass(frozen=True)
class AirbotSettings(LoopSettings):
    """How the driver runs the arm: `LoopSettings`, and what only this arm has.

    gripper_kp, gripper_kd: MIT gains of the gripper's motor [Nm/rad, Nm s/rad]. gripper_speed: of the
    gripper's opening [m/s]. gravity_factors: motor torque per joint torque; None reads them from the base
    board. tool: None asks the end board. motor_ranges: (pos_max [rad], vel_max [rad/s], torque_max [Nm]) by
    id of a DM motor that is not the arm's usual type.
    """

    kp: tuple[float, ...] = (100.0, 100.0, 100.0, 20.0, 20.0, 20.0)
    kd: tuple[float, ...] = (3.0, 3.0, 3.0, 1.0, 1.0, 1.0)
    final_damping: tuple[float, ...] = (10.0, 10.0, 10.0, 2.0, 2.0, 2.0)
    lag: tuple[float, ...] = (0.108, 0.108, 0.108, 0.125, 0.125, 0.125)
    gripper_kp: float = GRIPPER_KP
    gripper_kd: float = GRIPPER_KD
    gripper_speed: float = 0.2
    gravity_factors: tuple[float, ...] | None = None
    tool: Tool | None = None
    motor_ranges: Mapping[int, tuple[float, float, float]] = field(default_factory=dict)

    def gripper(self) -> GripperMotor:
        """The G2 gripper with these gains and this speed."""
        return GripperMotor(
            MAX_OPENING,
            motor_angle_from_opening,
            opening_from_motor_angle,
            self.gripper_kp,
            self.gripper_kd,
            self.gripper_speed,
        )
