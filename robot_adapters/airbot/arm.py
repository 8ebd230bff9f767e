"""The AIRBOT Play as its users see it: connect, read, command, close."""

from __future__ import annotations

import atexit
import logging
import math
import threading
from dataclasses import dataclass
from typing import Any

import can
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from lerobot_mimicik.kinematics.plausibility import joint_limits
from robot_adapters.airbot.gripper import opening_from_motor_angle
from robot_adapters.airbot.protocol import Tool
from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.airbot.startup import ArmIdentity, bring_up, identify, other_master, release
from robot_adapters.can import real_time
from robot_adapters.can.bus import BusError, open_bus, unread
from robot_adapters.can.control import ArmMode, ControlLoop
from robot_adapters.can.gravity import GravityModel
from robot_adapters.can.statistics import DriverStatistics
from robot_adapters.clock import Clock, RealClock, Schedule, SimulatedClock
from robot_adapters.safety import (
    CommandStatus,
    ControllerFailure,
    JointLimitViolation,
    SafetyEvent,
    SafetyGate,
)
from robot_adapters.signals import SignalGuard

_log = logging.getLogger(__name__)
_FIRST_FEEDBACK = 0.25  # s


class NotConnectedError(ConnectionError):
    """The arm is used before `connect` or after `close`."""


class StartRefusedError(RuntimeError):
    """The arm answers, but is in no state to start; `event` says why."""

    def __init__(self, event: SafetyEvent) -> None:
        super().__init__(event.message)
        self.event = event


@dataclass(frozen=True)
class ArmState:
    """The arm as last measured.

    q, dq, torque: joint angles [rad], velocities [rad/s] and motor torques [Nm], each (6,). gripper: opening
    [m], NaN while its motor is silent, None without a G2. temperatures: hottest part of each motor in degrees
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
    """What became of a command: `q_sent` (6,) [rad] is the target in force after it, whatever the status.

    `events` tell of this command and of what the control loop did since the command before.
    """

    status: CommandStatus
    q_sent: NDArray[np.float64]
    events: tuple[SafetyEvent, ...]


class AirbotArm:
    """One arm on one bus, with its safety gate. A context manager: `with AirbotArm("socketcan", "can0") as
    arm`.

    On a real clock a thread of its own talks to the motors; on a `SimulatedClock` that happens while the
    caller sleeps.
    """

    def __init__(
        self,
        interface: str = "socketcan",
        channel: str | None = None,
        *,
        settings: AirbotSettings | None = None,
        description: ArmDescription | None = None,
        clock: Clock | None = None,
        handle_signals: bool = True,
        **bus_options: Any,
    ) -> None:
        """Nothing is opened before `connect`.

        `interface` and `channel` are python-can's, `bus_options` go to it. `handle_signals` makes SIGINT and
        SIGTERM leave the motors safe before they do what they did before.
        """
        self.interface, self.channel = interface, channel
        self.settings = settings or AirbotSettings()
        self.description = description or describe_arm("airbot_play")
        self.joint_names = self.description.joint_names
        self.clock: Clock = clock or RealClock()
        self.gate = SafetyGate(self.joint_names, *joint_limits(self.description), self.settings.limits)
        self.identity: ArmIdentity | None = None
        self._bus_options = bus_options
        self._bus: can.BusABC | None = None
        self._loop: ControlLoop | None = None
        self._thread: threading.Thread | None = None
        self.schedule: Schedule | None = None  # of the control loop on a simulated clock
        self._stopping = threading.Event()
        self._guard = SignalGuard(self._stopping.set) if handle_signals else None
        self._last_statistics: DriverStatistics | None = None

    @property
    def is_connected(self) -> bool:
        """Whether the control loop runs."""
        return self._loop is not None

    @property
    def mode(self) -> ArmMode:
        """What the control loop is doing."""
        return self._running().mode

    def connect(self) -> ArmIdentity:
        """Open the bus, identify and enable the motors, and hold the measured position; who is on the bus.

        Raises BusError, NoAnswerError, RangeError, or StartRefusedError for an arm that somebody else commands,
        that stands outside its joint limits or reports no position; the bus is then closed again. Nothing is
        sent before the driver has listened for another master. Connecting twice is harmless.
        """
        if self._loop is not None and self.identity is not None:
            return self.identity
        self.identity = None  # until the motors are ours: `close` then has none to release
        self._bus = open_bus(self.interface, self.channel, **self._bus_options)
        try:
            other = other_master(self._bus, self.clock, self.settings)
            if other is not None:
                raise StartRefusedError(other)
            identity = identify(self._bus, self.clock, self.settings)
            self._check_start([motor.position for motor in identity.motors])
            self.identity = identity
            positions = bring_up(self._bus, self.clock, self.identity, self.settings)
            self._check_start(positions)
            self._loop = self._make_loop(self._bus, self.identity, positions)
            self._start(self._loop)
        except BaseException:
            self.close()
            raise
        return self.identity

    def read(self) -> ArmState:
        """The latest measured state. Raises NotConnectedError."""
        loop = self._running()
        with loop.lock:
            q, dq, torque = loop.table.joints()
            records = loop.table.records
            age, _ = loop.table.oldest(0.0)
            gripper = None
            if self.identity is not None and self.identity.tool is Tool.G2:
                record = records[loop.motors[-1].id]
                silent = self.clock.monotonic() - record.stamp > self.settings.limits.feedback_timeout
                gripper = math.nan if silent else opening_from_motor_angle(record.position)
            hottest = {i: max(r.motor_temperature, r.mosfet_temperature) for i, r in records.items()}
            return ArmState(q, dq, torque, gripper, hottest, -age, loop.mode)

    def command(self, q: ArrayLike, gripper: float | None = None) -> CommandResult:
        """Move to joint angles `q` [rad] (6,) and a gripper opening [m], within the safety gate's limits.

        Raises NotConnectedError, and ValueError for a wrong number of joints; everything else is in the
        result.
        """
        verdict = self._running().submit(q, gripper)
        assert verdict.q is not None  # the loop always has a target in force
        return CommandResult(verdict.status, verdict.q, verdict.events)

    def target(self) -> NDArray[np.float64]:
        """The joint target in force [rad] (dof,). Raises NotConnectedError."""
        return self._running().target()

    def events(self) -> tuple[SafetyEvent, ...]:
        """What the control loop did since the last command or call, for callers that send no commands."""
        return self._running().news()

    def statistics(self) -> DriverStatistics:
        """Counts and timings since `connect`; after `close`, those at the end. Raises NotConnectedError
        before.
        """
        loop = self._loop
        if loop is None:
            if self._last_statistics is not None:
                return self._last_statistics
            raise NotConnectedError("the arm is not connected: call connect() first")
        with loop.lock:
            records = loop.table.records
            received = {i: record.frames for i, record in records.items()}
            implausible = sum(record.implausible for record in records.values())
            return loop.recorder.summary(received, implausible, unread(loop.bus))

    def close(self) -> None:
        """Let the arm down softly, disable the motors and close the bus. Closing twice is harmless.

        Stiffness fades, then gravity compensation, under damping; at the end DM motors are disabled and OD
        motors only brake. After a fault of the bus it does what still gets through.
        """
        if self._guard is not None:
            self._guard.remove()
        atexit.unregister(self.close)
        self._stopping.set()
        if self.schedule is not None:
            self.schedule.cancel()
            self.schedule = None
            if self._loop is not None:
                self._let_down(self._loop)
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=10.0)
            self._thread = None
            real_time.leave()
        if self._loop is not None:
            self._last_statistics = self.statistics()
            self._loop = None
        elif self._bus is not None and self.identity is not None:
            self._release(self._bus, self.identity)
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None

    def __enter__(self) -> AirbotArm:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _running(self) -> ControlLoop:
        if self._loop is None:
            raise NotConnectedError("the arm is not connected: call connect() first")
        return self._loop

    def _check_start(self, positions: list[float]) -> None:
        margin = self.settings.limits.start_margin
        for joint, name in enumerate(self.joint_names):
            position, lower, upper = positions[joint], self.gate.lower[joint], self.gate.upper[joint]
            if not lower - margin <= position <= upper + margin:
                where = f"{name} stands at {position:.3f} rad, outside [{lower}, {upper}]"
                raise StartRefusedError(JointLimitViolation(where))

    def _make_loop(self, bus: can.BusABC, identity: ArmIdentity, positions: list[float]) -> ControlLoop:
        dof = len(self.joint_names)
        return ControlLoop(
            bus,
            self.clock,
            [each.motor for each in identity.motors],
            self.gate,
            GravityModel(self.description, self.settings.gravity),
            identity.gravity_factors,
            self.settings,
            positions[:dof],
            positions[dof] if len(positions) > dof else None,
        )

    def _start(self, loop: ControlLoop) -> None:
        self._stopping.clear()
        atexit.register(self.close)
        if self._guard is not None:
            self._guard.install()
        if isinstance(self.clock, SimulatedClock):
            self.schedule = self.clock.every(1.0 / self.settings.rate, loop.tick)
        else:
            real_time.enter()
            self._thread = threading.Thread(
                target=self._run, args=(loop,), name="airbot-control", daemon=True
            )
            self._thread.start()
        until = self.clock.monotonic() + _FIRST_FEEDBACK
        while not loop.table.complete and self.clock.monotonic() < until:
            self.clock.sleep(0.002)

    def _run(self, loop: ControlLoop) -> None:
        period = 1.0 / self.settings.rate
        due = self.clock.monotonic()
        try:
            while not self._stopping.is_set():
                loop.tick()
                due += period
                late = self.clock.monotonic() - due
                if late > period:
                    loop.recorder.overruns += 1
                    due += late
                self.clock.sleep(-late)
        except BaseException as error:  # SystemExit too would leave the motors with their last frame
            _log.exception("the control loop of the arm failed")
            loop.stop(ControllerFailure(f"{type(error).__name__}: {error}"))
        self._let_down(loop)

    def _let_down(self, loop: ControlLoop) -> None:
        """Fade stiffness, then gravity compensation, then release; when a tick fails, release at once."""
        steps = max(round(self.settings.shutdown * self.settings.rate), 1)
        period = 1.0 / self.settings.rate
        loop.end()
        try:
            for step in range(1, 2 * steps + 1):
                fading = step / steps  # 0 to 1 for the stiffness, then 1 to 2 for the gravity compensation
                damping = None if step <= steps else self.settings.final_damping
                loop.relax(max(1.0 - fading, 0.0), min(2.0 - fading, 1.0), damping)
                loop.tick()
                self.clock.sleep(period)
        except BaseException:
            _log.exception("the arm could not be let down softly")
        if self.identity is not None:
            self._release(loop.bus, self.identity)

    def _release(self, bus: can.BusABC, identity: ArmIdentity) -> None:
        motors = [each.motor for each in identity.motors]
        for _ in range(2):
            try:
                release(bus, motors, (*self.settings.final_damping, 0.0))
            except BusError as error:
                _log.warning("the motors could not be released: %s", error)
                return
            self.clock.sleep(0.005)
