"""What deployment, display, robots and evaluation need of an arm, whoever made it and whatever drives it."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_adapters.clock import Clock
from robot_adapters.safety import CommandStatus, SafetyEvent


class NotConnectedError(ConnectionError):
    """The arm is used before `connect` or after `close`."""


class StartRefusedError(RuntimeError):
    """The arm answers, but is in no state to start; `event` says why."""

    def __init__(self, event: SafetyEvent) -> None:
        super().__init__(event.message)
        self.event = event


class ArmMode(enum.StrEnum):
    """What an arm's driver is doing."""

    TRACKING = "tracking"
    HOLD = "hold"
    STOPPED = "stopped"


@dataclass(frozen=True)
class ArmState:
    """The arm as last measured.

    q, dq, torque: joint angles [rad], velocities [rad/s] and motor torques [Nm], each (dof,). gripper: opening
    [m], NaN while its motor is silent, None without one. temperatures: hottest part of each motor in degrees
    C, by motor id. stamp: time of the oldest of the motors' readings [s, the arm's clock].
    """

    q: NDArray[np.float64]
    dq: NDArray[np.float64]
    torque: NDArray[np.float64]
    gripper: float | None
    temperatures: dict[int, int]
    stamp: float
    mode: ArmMode


@dataclass(frozen=True)
class CommandResult:
    """What became of a command: `q_sent` (dof,) [rad] is the target in force after it, whatever the status.

    `events` tell of this command and of what the control loop did since the command before.
    """

    status: CommandStatus
    q_sent: NDArray[np.float64]
    events: tuple[SafetyEvent, ...]


@dataclass(frozen=True)
class DriverStatistics:
    """What the driver has counted since it connected.

    Times in milliseconds over the last minute: `period_*` between ticks, `busy_*` inside them, `age_max` of
    the oldest joint feedback at a tick. `unread` is the number of frames waiting in the receive queue.
    """

    ticks: int
    overruns: int
    period_mean_ms: float
    period_p99_ms: float
    period_max_ms: float
    jitter_std_ms: float
    busy_p99_ms: float
    age_max_ms: float
    frames_sent: int
    frames_received: dict[int, int]
    frames_unknown: int
    frames_implausible: int
    send_errors: int
    unread: int
    targets_accepted: int
    targets_limited: int
    targets_refused: int
    events: dict[str, int]


class Arm(Protocol):
    """One arm with a safety gate of its own, driven by joint targets; angles in radians, openings in metres.

    A driver that has these methods is deployed, displayed, checked and evaluated like every other.
    """

    joint_names: tuple[str, ...]
    clock: Clock

    @property
    def is_connected(self) -> bool:
        """Whether the control loop runs."""
        ...

    @property
    def mode(self) -> ArmMode:
        """What the control loop is doing. Raises NotConnectedError."""
        ...

    @property
    def max_opening(self) -> float | None:
        """The gripper's largest opening [m]; None without a gripper."""
        ...

    def connect(self) -> Any:
        """Reach the arm and hold it where it stands; who is there. Connecting twice is harmless.

        Raises:
            ConnectionError: Nobody answers.
            StartRefusedError: The arm is in no state to start.
        """
        ...

    def read(self) -> ArmState:
        """The latest measured state. Raises NotConnectedError."""
        ...

    def command(self, q: ArrayLike, gripper: float | None = None) -> CommandResult:
        """Move to joint angles `q` [rad] (dof,) and an opening [m], within the safety gate's limits.

        Raises NotConnectedError, and ValueError for a wrong number of joints; everything else is in the result.
        """
        ...

    def target(self) -> NDArray[np.float64]:
        """The joint target in force [rad] (dof,). Raises NotConnectedError."""
        ...

    def events(self) -> tuple[SafetyEvent, ...]:
        """What the driver did since the last command or call."""
        ...

    def statistics(self) -> DriverStatistics:
        """Counts and timings since `connect`; after `close`, those at the end. Raises NotConnectedError before."""
        ...

    def close(self) -> None:
        """Let the arm down softly and let go of it. Closing twice is harmless."""
        ...


class SimulatedArmCell(Protocol):
    """A simulated arm and its driver, on a bus of their own; a context manager that closes all."""

    arm: Arm
    clock: Clock
    channel: str

    def protections(self) -> dict[str, Any]:
        """What the arm's own protections counted: emergency stops, large steps."""
        ...

    def close(self) -> None:
        """Close the driver, stop the simulation and close the bus. Closing twice is harmless."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...
