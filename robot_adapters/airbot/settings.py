"""Settings of the AIRBOT Play driver; the defaults are those of the vendor's joint-following mode."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from robot_adapters.airbot.boards import Tool
from robot_adapters.airbot.gripper import GRIPPER_KD, GRIPPER_KP
from robot_adapters.can.gravity import STANDARD_GRAVITY
from robot_adapters.safety import SafetyLimits


@dataclass(frozen=True)
class AirbotSettings:
    """How the driver runs the arm.

    kp, kd: MIT gains per joint [Nm/rad, Nm s/rad]. rate: control frequency [Hz]. velocity_feedforward: share
    of the interpolated velocity that is commanded along with the position. gravity: in the base frame
    [m/s^2]. gravity_factors: motor torque per joint torque; None reads them from the base board. tool: None
    asks the end board. gripper_speed: of the gripper's opening [m/s]. limits: of the safety gate. listen: how
    long the driver listens for another master before it sends anything [s]; the slowest that can keep motors
    with a timeout of half a second going sends at 2 Hz. motor_timeout: silence of the driver after which the
    motors let go by themselves [s]; None leaves their registers as they are, and a killed process its last
    frame in force. motor_ranges: (pos_max [rad], vel_max [rad/s], torque_max [Nm]) by id of a DM motor that
    is not the arm's usual type. shutdown: seconds each phase of the soft shutdown takes. final_damping: of
    the joints when all else is off [Nm s/rad].
    """

    kp: tuple[float, ...] = (100.0, 100.0, 100.0, 20.0, 20.0, 20.0)
    kd: tuple[float, ...] = (3.0, 3.0, 3.0, 1.0, 1.0, 1.0)
    gripper_kp: float = GRIPPER_KP
    gripper_kd: float = GRIPPER_KD
    gripper_speed: float = 0.2
    rate: float = 250.0
    velocity_feedforward: float = 1.0
    gravity: tuple[float, float, float] = (0.0, 0.0, -STANDARD_GRAVITY)
    gravity_factors: tuple[float, ...] | None = None
    tool: Tool | None = None
    limits: SafetyLimits = field(default_factory=SafetyLimits)
    listen: float = 0.6
    motor_timeout: float | None = 0.5
    motor_ranges: Mapping[int, tuple[float, float, float]] = field(default_factory=dict)
    shutdown: float = 0.4
    final_damping: tuple[float, ...] = (10.0, 10.0, 10.0, 2.0, 2.0, 2.0)

    def __post_init__(self) -> None:
        if not 50.0 <= self.rate <= 1000.0:
            raise ValueError(f"the control rate must lie in 50..1000 Hz, got {self.rate}")
        if self.motor_timeout is not None and not 0.1 <= self.motor_timeout <= 2.0:
            raise ValueError(f"the motor timeout must lie in 0.1..2 s or be None, got {self.motor_timeout}")
        if not 0.0 <= self.velocity_feedforward <= 1.0:
            raise ValueError(f"velocity_feedforward must lie in 0..1, got {self.velocity_feedforward}")
