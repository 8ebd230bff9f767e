"""Settings of the control loop that every arm has; an arm adds its gains and what else it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from robot_adapters.can.gravity import STANDARD_GRAVITY
from robot_adapters.safety import SafetyLimits


@dataclass(frozen=True)
class GripperMotor:
    """A gripper that the last motor of an arm drives.

    max_opening: between the fingers [m]. motor_angle: motor angle [rad] at an opening [m]. opening: its
    inverse. kp, kd: MIT gains [Nm/rad, Nm s/rad]. speed: of the opening on average [m/s].
    """

    max_opening: float
    motor_angle: Callable[[float], float]
    opening: Callable[[float], float]
    kp: float
    kd: float
    speed: float

    @property
    def motor_speed(self) -> float:
        """Motor speed [rad/s] at which the gripper opens all the way at `speed`."""
        travel = abs(self.motor_angle(self.max_opening) - self.motor_angle(0.0))
        return self.speed * travel / self.max_opening


@dataclass(frozen=True)
class LoopSettings:
    """How the control loop runs an arm.

    kp, kd: MIT gains per joint [Nm/rad, Nm s/rad]. final_damping: of the joints when all else is off
    [Nm s/rad]. lag: time constant of each of the two first-order lags with which the motors follow commands,
    dead time included [s], of which feedback may show all, half or none; empty for motors that follow at
    once. rate: control frequency [Hz]. velocity_feedforward: fraction of the interpolated velocity that
    is commanded along with the position. gravity: in the base frame [m/s^2]. limits: of the safety gate.
    listen: how long the driver listens for another master before it sends anything [s]; the slowest that can
    keep motors with a timeout of half a second going sends at 2 Hz. motor_timeout: silence of the driver
    after which the motors let go by themselves [s]; None leaves their registers as they are, and a killed
    process its last frame in force. shutdown: seconds each phase of the soft shutdown takes.
    """

    kp: tuple[float, ...]
    kd: tuple[float, ...]
    final_damping: tuple[float, ...]
    lag: tuple[float, ...] = ()
    rate: float = 250.0
    velocity_feedforward: float = 1.0
    gravity: tuple[float, float, float] = (0.0, 0.0, -STANDARD_GRAVITY)
    limits: SafetyLimits = field(default_factory=SafetyLimits)
    listen: float = 0.6
    motor_timeout: float | None = 0.5
    shutdown: float = 0.4

    def __post_init__(self) -> None:
        if not 50.0 <= self.rate <= 1000.0:
            raise ValueError(f"the control rate must lie in 50..1000 Hz, got {self.rate}")
        if self.motor_timeout is not None and not 0.1 <= self.motor_timeout <= 2.0:
            raise ValueError(f"the motor timeout must lie in 0.1..2 s or be None, got {self.motor_timeout}")
        if not 0.0 <= self.velocity_feedforward <= 1.0:
            raise ValueError(f"velocity_feedforward must lie in 0..1, got {self.velocity_feedforward}")
