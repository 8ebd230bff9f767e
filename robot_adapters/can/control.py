"""The control loop of an arm of MIT motors: one tick reads feedback, judges the arm's state and commands every
motor.

A tick is a plain call, so that a thread runs it at 250 Hz on a real clock and a schedule on a simulated one.

    target accepted            targets older than 250 ms,
      ----------->  TRACKING  feedback older than 100 ms, arm not following  ----->  HOLD
          ^                                                                           |
          +------------------------------ target accepted ----------------------------+
    TRACKING or HOLD  -- motor error, over-temperature, bus off, motor lost, another
                         master, false feedback -->  STOPPED (until reconnected)

A hold or a stop keeps every joint where it was last commanded: what feedback says moves nothing. The one
exception is an arm that is blocked or pushed away, by feedback that nothing contradicts: it yields, and holds
where it stands. Joints in trouble are braked instead.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Sequence

import can
import numpy as np
from numpy.typing import ArrayLike, NDArray

from robot_adapters.arm import ArmMode
from robot_adapters.can.bus import BusError, reports_bus_off, send
from robot_adapters.can.dm_motor import DmRegister
from robot_adapters.can.feedback import FeedbackTable
from robot_adapters.can.gravity import GravityModel
from robot_adapters.can.interpolation import Interpolator
from robot_adapters.can.mit_frames import MotorFeedback, ParameterReply
from robot_adapters.can.mode_watch import ModeWatch
from robot_adapters.can.motor import Motor
from robot_adapters.can.one_master import MasterWatch
from robot_adapters.can.settings import GripperMotor, LoopSettings
from robot_adapters.can.statistics import Recorder
from robot_adapters.can.witness import TorqueWitness
from robot_adapters.clock import Clock
from robot_adapters.safety import (
    ArmStopped,
    BusOff,
    CommandStatus,
    CommandTimeout,
    ControllerFailure,
    FeedbackTimeout,
    FollowingError,
    ForeignMaster,
    GateDecision,
    JointLimitViolation,
    NonFiniteCommand,
    SafetyEvent,
    SafetyGate,
    SensorFault,
)

_SEND_FAILURES = 25  # ticks in a row without a frame sent before the bus counts as off
_BEHIND = 5  # ticks in a row before a joint counts as left behind: a damaged frame must not hold the arm
_TORQUE_SHARE = 0.8  # of the motor's torque range that the feed-forward may take
_EVENTS_KEPT = 1000


class ControlLoop:
    """The state of one running arm. `tick` runs in one thread; the other methods may be called from any."""

    def __init__(
        self,
        bus: can.BusABC,
        clock: Clock,
        motors: Sequence[Motor],
        gate: SafetyGate,
        gravity: GravityModel,
        factors: ArrayLike,
        settings: LoopSettings,
        q: ArrayLike,
        gripper: GripperMotor | None = None,
        gripper_angle: float = 0.0,
    ) -> None:
        """Starts holding `q` [rad] (dof,) and the gripper's motor at `gripper_angle` [rad], as measured.

        `motors` are in joint order, then the gripper's where there is a `gripper`.
        """
        self.bus, self.clock, self.gate, self.settings = bus, clock, gate, settings
        self.motors, self.dof = motors, len(gate.joint_names)
        self.limits = gate.limits
        known = [*np.asarray(q, dtype=float), *([] if gripper is None else [gripper_angle])]
        self.table = FeedbackTable(motors, gate, known, clock.monotonic())
        self.recorder = Recorder()
        self.mode = ArmMode.HOLD
        self.lock = threading.RLock()
        self._gravity, self._factors = gravity, np.asarray(factors, dtype=float)
        torque_ranges = np.array([m.torque_range.high for m in motors[: self.dof]])
        self._torque_limits = _TORQUE_SHARE * torque_ranges
        self._witness = TorqueWitness(gate.joint_names, q, torque_ranges, settings.lag or np.zeros(self.dof))
        speed = min(self.limits.max_step / self.limits.frame, self.limits.max_velocity)
        self._setpoint = Interpolator(q, speed)
        # A tick that comes late must not catch up in one step.
        self._speed, self._longest_step = speed, 2.0 / settings.rate
        self._sent, self._sent_at = np.array(q, dtype=float), clock.monotonic()
        self.gripper = gripper
        self._gripper_setpoint = (
            None if gripper is None else Interpolator([gripper_angle], gripper.motor_speed)
        )
        self._decoders = _decoders(motors)
        self._masters, self._modes = MasterWatch(motors), ModeWatch(motors)
        self._last_tick = clock.monotonic()
        self._let_go = False
        self._doubted: dict[int, float] = {}  # where joints must be that report false angles [rad], by number
        self._resting = _resting_velocity(settings, self.dof)
        self._target_stamp = clock.monotonic()
        self._had_target = False
        self._started = clock.monotonic()
        self._silent_ticks = self._behind = 0
        self._gain_scale = self._torque_scale = 1.0
        self._damping: NDArray[np.float64] | None = None
        self._news: deque[SafetyEvent] = deque(maxlen=_EVENTS_KEPT)
        self.stop_event: SafetyEvent | None = None

    def submit(self, q: ArrayLike, opening: float | None = None) -> GateDecision:
        """Judge a target [rad] (dof,) with a gripper opening [m], and follow it unless refused.

        The verdict's `q` is the target in force after it, and its events include the loop's since the last
        call.
        """
        with self.lock:
            now = self.clock.monotonic()
            if self.mode is ArmMode.STOPPED:
                cause = (
                    self.stop_event.message
                    if self.stop_event
                    else "close() or a signal: it is being let down"
                )
                verdict = _refusal(ArmStopped(f"stopped by {cause}"))
            else:
                verdict = self._judge(q, opening, now)
            self.recorder.targets[verdict.status] += 1
            for event in verdict.events:
                self.recorder.events[event.name] += 1
            if verdict.q is not None:
                self._setpoint.aim(verdict.q, now)
                self._target_stamp, self._had_target = now, True
                self.mode = ArmMode.TRACKING
                if opening is not None and self.gripper is not None and self._gripper_setpoint is not None:
                    within = min(max(opening, 0.0), self.gripper.max_opening)
                    self._gripper_setpoint.aim([self.gripper.motor_angle(within)], now)
            return GateDecision(
                verdict.status, self._setpoint.target.copy(), self.new_events() + verdict.events
            )

    def target(self) -> NDArray[np.float64]:
        """The target in force [rad] (dof,): the last one admitted, or where the arm holds."""
        with self.lock:
            return self._setpoint.target.copy()

    def new_events(self) -> tuple[SafetyEvent, ...]:
        """The events of the control loop since the last call."""
        with self.lock:
            events = tuple(self._news)
            self._news.clear()
            return events

    def stop(self, event: SafetyEvent) -> None:
        """Stop for a reason: hold the commanded position and refuse targets from now on."""
        with self.lock:
            if self.mode is not ArmMode.STOPPED:
                self._hold(self.clock.monotonic(), event)
                self.mode, self.stop_event = ArmMode.STOPPED, event

    def end(self) -> None:
        """Refuse targets from now on, because the arm is being let down; not an event."""
        with self.lock:
            if self.mode is not ArmMode.STOPPED:
                now = self.clock.monotonic()
                self._setpoint.settle(self._setpoint.sample(now)[0], now)
                self.mode, self.stop_event = ArmMode.STOPPED, None

    def relax(self, gain_scale: float, torque_scale: float, damping: ArrayLike | None) -> None:
        """Scale stiffness and gravity feed-forward, and replace the joints' damping, on the way to switching
        off.
        """
        with self.lock:
            self._gain_scale, self._torque_scale = gain_scale, torque_scale
            self._damping = None if damping is None else np.asarray(damping, dtype=float)

    def tick(self) -> None:
        """One period of the loop."""
        with self.lock:
            start = self.clock.monotonic()
            self._note_standstill(start - self._last_tick)
            self._last_tick = start
            self._read(start)
            self._watch(start)
            age, quietest = self.table.oldest(start)
            age = min(age, start - self._started)
            self._supervise(start, age, quietest)
            if not isinstance(self.stop_event, BusOff):
                self._command(start)
            self.recorder.tick(start, self.clock.monotonic(), age)

    def _judge(self, q: ArrayLike, opening: float | None, now: float) -> GateDecision:
        age, quietest = self.table.oldest(now)
        if age > self.limits.feedback_timeout:
            silence = min(age, now - self._started) * 1e3
            return _refusal(FeedbackTimeout(f"motor {quietest} silent for {silence:.0f} ms"))
        elapsed = now - self._target_stamp if self._had_target else self.limits.frame
        if opening is not None and not math.isfinite(opening):
            return _refusal(NonFiniteCommand(f"gripper opening {opening}"))
        verdict = self.gate.admit(q, self._setpoint.target, elapsed)
        if verdict.q is None or opening is None or self.gripper is None:
            return verdict
        widest = self.gripper.max_opening
        if 0.0 <= opening <= widest:
            return verdict
        event = JointLimitViolation(f"gripper opening {opening:.4f} m outside [0, {widest}]")
        return GateDecision(CommandStatus.LIMITED, verdict.q, (*verdict.events, event))

    def _read(self, now: float) -> None:
        while (message := self.bus.recv(0.0)) is not None:
            if reports_bus_off(message):
                self.stop(BusOff("the CAN controller reports that it is off the bus"))
                continue
            other = self._masters.heard(message)
            if other is not None:
                self.stop(other)
            motor = self._decoders.get(message.arbitration_id)
            reply = motor.decode(message) if motor else None
            if isinstance(reply, MotorFeedback):
                self.table.update(reply, now)
            elif isinstance(reply, ParameterReply) and (event := self._modes.heard(reply)):
                self.stop(event)
            elif reply is None and not (motor and motor.decode_mit(message)):
                # Some interfaces give back one's own frames: commands are not unknown.
                self.recorder.unknown += 1

    def _note_standstill(self, seconds: float) -> None:
        timeout = self.settings.motor_timeout
        if timeout is not None and seconds > timeout:
            # Where the arm is now nobody knows: whatever stiffened it would move it.
            self._let_go = True
            detail = (
                f"the control loop stood still for {seconds:.2f} s, the motors let go after {timeout:g} s"
            )
            self.stop(ControllerFailure(detail))

    def _watch(self, now: float) -> None:
        """Compare the motors' torques with the commands in force; joints in trouble no longer follow them."""
        reasons = self._witness.judge(now, *self.table.joints(), *self.table.timely(now))
        if self.mode is not ArmMode.STOPPED:
            self.table.distrust(reasons)

    def _supervise(self, now: float, age: float, quietest: int) -> None:
        for event in self.table.faults():
            self.stop(event)
        if age > self.limits.feedback_timeout:
            event = FeedbackTimeout(
                f"motor {quietest} silent for more than {self.limits.feedback_timeout * 1e3:.0f} ms"
            )
            if age > self.limits.lost_timeout:
                self.stop(FeedbackTimeout(f"motor {quietest} lost: silent for {age:.1f} s"))
            elif self.mode is ArmMode.TRACKING:
                self._hold(now, event)
        if self.mode is not ArmMode.TRACKING:
            return
        if now - self._target_stamp > self.limits.target_timeout:
            self._hold(now, CommandTimeout(f"no target for {self.limits.target_timeout * 1e3:.0f} ms"))
            return
        setpoint, _ = self._setpoint.sample(now)
        errors = np.abs(setpoint - self.table.joints()[0])
        worst = int(np.argmax(errors))
        self._behind = self._behind + 1 if errors[worst] > self.limits.max_following_error else 0
        if self._behind >= _BEHIND:
            self._hold(
                now, FollowingError(f"{self.gate.joint_names[worst]} is {errors[worst]:.2f} rad behind")
            )
            # Nothing contradicts the feedback, or the arm would have stopped: it yields to what pushes it.
            measured = self.table.joints()[0]
            self._setpoint.settle(np.clip(measured, self.gate.lower, self.gate.upper), now)

    def _hold(self, now: float, event: SafetyEvent) -> None:
        self._setpoint.settle(self._sent, now)
        if self._gripper_setpoint is not None:
            self._gripper_setpoint.settle(self._gripper_setpoint.sample(now)[0], now)
        self.mode = ArmMode.HOLD
        self.recorder.events[event.name] += 1
        self._news.append(event)

    def _command(self, now: float) -> None:
        settings = self.settings
        position, velocity = self._setpoint.sample(now)
        reach = self._speed * min(now - self._sent_at, self._longest_step) + 1e-9
        position = self._sent + np.clip(position - self._sent, -reach, reach)
        velocity = self._harmless(position, velocity * settings.velocity_feedforward)
        self._sent, self._sent_at = position, now
        measured = self.table.joints()[0]
        faults = [self.table.records[motor.id].fault(self.limits) for motor in self.motors[: self.dof]]
        for joint, fault in enumerate(faults):
            if isinstance(fault, SensorFault):
                # Its angle is false: a load carried by it would be carried wrongly.
                self._doubted.setdefault(joint, float(self._witness.expected[joint]))
        posture = measured.copy()
        posture[list(self._doubted)] = list(self._doubted.values())
        torque = self._torque_scale * self._factors * self._gravity.torques(posture)
        torque = np.clip(torque, -self._torque_limits, self._torque_limits)
        damping = settings.kd if self._damping is None else self._damping.tolist()
        # A joint that another master has moved away is not pulled back: it may let go of it any time.
        disputed = isinstance(self.stop_event, ForeignMaster)
        taken = (disputed & (np.abs(position - measured) > self.limits.max_step)).tolist()
        self._witness.command(position, velocity, torque, settings.kp, settings.kd)
        failures = 0
        # As floats: the codecs compute with them several times faster than with elements of arrays.
        laws = zip(position.tolist(), velocity.tolist(), torque.tolist(), damping, strict=True)
        for joint, (motor, (q, dq, tau, kd)) in enumerate(zip(self.motors[: self.dof], laws, strict=True)):
            kp = 0.0 if taken[joint] else self._gain_scale * settings.kp[joint]
            fault = faults[joint]
            if self._let_go:
                dq = tau = kp = 0.0
            elif self.mode is ArmMode.STOPPED and fault:
                # A joint whose angle is wrong is not driven by it: braked, and carried against gravity.
                blind = isinstance(fault, SensorFault)
                dq, kp, tau = 0.0, 0.0, tau if blind else 0.0
                kd = max(kd, settings.final_damping[joint]) if blind else kd
            failures += self._send(motor, motor.encode_mit(q, dq, tau, kp, kd))
        if self.gripper is not None and self._gripper_setpoint is not None:
            angle, rate = (value.item() for value in self._gripper_setpoint.sample(now))
            kp, kd = self._gain_scale * self.gripper.kp, self.gripper.kd
            if self.mode is ArmMode.STOPPED:
                rate = 0.0
            if self._let_go:
                kp = 0.0
            motor = self.motors[-1]
            failures += self._send(motor, motor.encode_mit(angle, rate, 0.0, kp, kd))
        asked = self._modes.due(now)
        if asked is not None:
            self._send(asked, asked.request(DmRegister.CONTROL_MODE))
        self._silent_ticks = self._silent_ticks + 1 if failures == len(self.motors) else 0
        if self._silent_ticks >= _SEND_FAILURES:
            self.stop(BusOff(f"no frame could be sent for {_SEND_FAILURES} ticks"))

    def _harmless(self, position: NDArray[np.float64], velocity: NDArray[np.float64]) -> NDArray[np.float64]:
        """The velocities to command [rad/s] (dof,), such that any frame may be the last one.

        Under a frame that is left acting a joint comes to rest at position + kd/kp velocity: that must lie inside
        its limits. Where the arm does not track, no velocity is commanded at all.
        """
        if self.mode is not ArmMode.TRACKING:
            return np.zeros_like(velocity)
        least = np.minimum(self._resting * (self.gate.lower - position), 0.0)
        most = np.maximum(self._resting * (self.gate.upper - position), 0.0)
        return np.clip(velocity, least, most)

    def _send(self, motor: Motor, message: can.Message) -> bool:
        """Send a frame to a motor; True when that failed."""
        self._masters.sent(message, motor.id)
        try:
            send(self.bus, message)
        except BusError:
            self.recorder.send_errors += 1
            return True
        self.recorder.sent += 1
        return False


def _resting_velocity(settings: LoopSettings, dof: int) -> NDArray[np.float64]:
    """kp/kd [1/s] (dof,): the commanded velocity per angle by which a joint would rest beside its position."""
    return np.asarray(settings.kp[:dof], dtype=float) / np.maximum(settings.kd[:dof], 1e-6)


def _refusal(event: SafetyEvent) -> GateDecision:
    return GateDecision(CommandStatus.REFUSED, None, (event,))


def _decoders(motors: Sequence[Motor]) -> dict[int, Motor]:
    """Which motor sends on which id."""
    return {arbitration_id: motor for motor in motors for arbitration_id in motor.reply_ids}
