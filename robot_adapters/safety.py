"""The safety gate between whatever decides on joint targets and an arm: limits, refusals and the events they
cause.

The gate is part of the driver, on by default and without a switch. A target is passed, limited or refused;
each limit and refusal is an event with a name of its own and a remedy, handed back to the caller and counted.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class SafetyEvent:
    """Something the safety layer did; `detail` says what with names, values and units, `remedy` what to do
    about it.
    """

    detail: str
    remedy: ClassVar[str] = ""

    @property
    def name(self) -> str:
        """The event's name, that of its class."""
        return type(self).__name__

    @property
    def message(self) -> str:
        """Detail and remedy in one sentence."""
        return f"{self.name}: {self.detail}; {self.remedy}"


class NonFiniteCommand(SafetyEvent):
    """A target with NaN or infinity, refused."""

    remedy = "check what computes the targets: a policy fed with bad statistics or an IK that failed"


class JointLimitViolation(SafetyEvent):
    """A target outside the joint range, limited to it; at start-up, an arm that stands outside."""

    remedy = "plan inside the joint limits, or move the arm back by hand while it is off"


class VelocityLimitViolation(SafetyEvent):
    """A target that asks for more speed than allowed, limited."""

    remedy = "slow the motion down or send targets more often"


class StepLimitViolation(SafetyEvent):
    """A target too far from the one before for one 20 Hz frame, limited."""

    remedy = "slow the motion down: between frames of 50 ms no joint may move by more than 0.1 rad"


class JumpViolation(SafetyEvent):
    """A jump at which the motors would stop in emergency, refused."""

    remedy = "send targets that start at the measured position; look for an IK that switches branches"


class CommandTimeout(SafetyEvent):
    """No target for too long; the arm holds its position."""

    remedy = "send targets at 20 to 50 Hz; a slow policy needs action chunks or a faster computer"


class FeedbackTimeout(SafetyEvent):
    """A motor has been silent for too long; the arm holds its position, and stops when the silence lasts."""

    remedy = "check the motor's power, its cable and the load of the bus"


class FollowingError(SafetyEvent):
    """The arm does not follow its setpoint; it holds its position."""

    remedy = "look for a collision, a blocked joint or a payload beyond the arm's"


class SensorFault(SafetyEvent):
    """A joint's feedback contradicts itself, the joint's range or the commands; the arm stops, that joint braked."""

    remedy = (
        "do not drive the joint: check its encoder, zero and cable, power the arm off and on, then reconnect"
    )


class OverTemperature(SafetyEvent):
    """A motor is too hot; the arm stops."""

    remedy = "let the arm cool down, reduce payload and outstretched poses"


class MotorFault(SafetyEvent):
    """A motor reports an error; the arm stops."""

    remedy = "clear the cause, then reconnect; if it returns, power the arm off and on"


class ForeignMaster(SafetyEvent):
    """Somebody else commands the motors; the arm stops, or is not started."""

    remedy = (
        "end the other program that uses this bus, then reconnect (OD motors set to report by themselves look "
        "the same: set them to answer)"
    )


class WrongControlMode(SafetyEvent):
    """A motor has been put into another control mode, in which it does not follow; the arm stops."""

    remedy = "end the program that changed it, then reconnect: the driver sets the mode again"


class BusOff(SafetyEvent):
    """The CAN controller has left the bus or cannot send; the arm stops."""

    remedy = "check wiring, termination and bitrate, bring the interface down and up, then reconnect"


class ControllerFailure(SafetyEvent):
    """The control loop itself failed; the arm stops."""

    remedy = "report the error with the message; reconnect to go on"


class ArmStopped(SafetyEvent):
    """A target for an arm that has stopped, refused."""

    remedy = "read the event that stopped it, clear the cause and reconnect"


class CommandStatus(enum.StrEnum):
    """What became of a target."""

    ACCEPTED = "accepted"
    LIMITED = "limited"
    REFUSED = "refused"


@dataclass(frozen=True)
class SafetyLimits:
    """What the gate allows. Limits can be tightened; a looser one than the default is a ValueError.

    max_step: largest change of a joint per 20 Hz frame [rad]. refuse_step: change from which a target is
    refused [rad]. max_velocity: largest joint velocity [rad/s]. max_following_error: between setpoint and
    measured angle [rad]. target_timeout, feedback_timeout: age at which targets and feedback are stale [s].
    lost_timeout: silence of a motor after which the arm stops [s]. Temperatures in degrees C.
    """

    max_step: float = 0.1
    refuse_step: float = 0.5
    max_velocity: float = 2.0
    max_following_error: float = 0.6
    target_timeout: float = 0.25
    feedback_timeout: float = 0.1
    lost_timeout: float = 1.0
    max_motor_temperature: float = 80.0
    max_mosfet_temperature: float = 85.0
    start_margin: float = 0.1

    frame: ClassVar[float] = 0.05

    def __post_init__(self) -> None:
        for name, most in vars(SafetyLimits).items():
            if name in self.__dataclass_fields__ and name != "frame":
                value = getattr(self, name)
                if not (math.isfinite(value) and 0 < value <= most):
                    raise ValueError(f"safety limit {name} must lie in (0, {most}], got {value}")


@dataclass(frozen=True)
class GateDecision:
    """What the gate makes of a target: `q` [rad] is what may be sent, None when it was refused."""

    status: CommandStatus
    q: NDArray[np.float64] | None
    events: tuple[SafetyEvent, ...] = ()


class SafetyGate:
    """Checks joint targets against limits; stateless but for its configuration."""

    def __init__(
        self,
        joint_names: Sequence[str],
        lower: ArrayLike,
        upper: ArrayLike,
        limits: SafetyLimits | None = None,
    ) -> None:
        """Joint limits `lower` and `upper` [rad] (dof,) belong to `joint_names`; ValueError when they do not
        fit.
        """
        self.joint_names = tuple(joint_names)
        self.lower, self.upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        self.limits = limits or SafetyLimits()
        dof = len(self.joint_names)
        if self.lower.shape != (dof,) or self.upper.shape != (dof,) or not np.all(self.lower < self.upper):
            raise ValueError(
                f"expected {dof} lower joint limits below {dof} upper ones, got {self.lower}, {self.upper}"
            )

    def admit(self, target: ArrayLike, reference: ArrayLike, elapsed: float) -> GateDecision:
        """Judge a target [rad] (dof,) against the target before it, `reference` (dof,), given `elapsed` [s]
        ago.

        Refused: not finite, or a joint further than `refuse_step` from the reference. Limited, in this order:
        to the joint range, joint by joint; to the step per frame and to the velocity, all joints by one
        factor, so that the arm stays on its way. Targets that come faster than 20 Hz share a frame's step.
        ValueError for a wrong shape.
        """
        q, before = np.asarray(target, dtype=float), np.asarray(reference, dtype=float)
        if q.shape != self.lower.shape:
            raise ValueError(
                f"expected {len(self.joint_names)} joint targets {self.joint_names}, got shape {q.shape}"
            )
        if not np.all(np.isfinite(q)):
            return GateDecision(CommandStatus.REFUSED, None, (NonFiniteCommand(f"target {_listed(q)} rad"),))
        steps = np.abs(q - before)
        worst = int(np.argmax(steps))
        if steps[worst] > self.limits.refuse_step:
            jump = f"{self.joint_names[worst]} would jump by {steps[worst]:.3f} rad"
            event = JumpViolation(f"{jump}, limit {self.limits.refuse_step}")
            return GateDecision(CommandStatus.REFUSED, None, (event,))
        events: list[SafetyEvent] = []
        inside = np.clip(q, self.lower, self.upper)
        for joint in np.flatnonzero(inside != q):
            limits = f"[{self.lower[joint]}, {self.upper[joint]}]"
            events.append(
                JointLimitViolation(f"{self.joint_names[joint]} target {q[joint]:.4f} rad outside {limits}")
            )
        steps = np.abs(inside - before)
        worst = int(np.argmax(steps))
        step, q = float(steps[worst]), inside
        # A tenth of grace on the time: targets at 20 Hz that come a little early are not slowed down.
        share = min(1.1 * max(elapsed, 0.0) / self.limits.frame, 1.0)
        for allowed, kind in (
            (self.limits.max_step, StepLimitViolation),
            (self.limits.max_velocity * self.limits.frame, VelocityLimitViolation),
        ):
            if step > allowed * share + 1e-9:
                detail = (
                    f"{self.joint_names[worst]} would move by {step:.4f} rad, allowed {allowed * share:.4f}"
                )
                events.append(kind(detail))
                q = before + (inside - before) * (allowed * share / float(steps[worst]))
                step = allowed * share
        return GateDecision(CommandStatus.LIMITED if events else CommandStatus.ACCEPTED, q, tuple(events))


def _listed(values: NDArray) -> str:
    return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"
