"""An arm of MIT motors as its users see it: connect, read, command, close."""

from __future__ import annotations

import atexit
import logging
import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import can
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription
from lerobot_mimicik.kinematics.plausibility import joint_limits
from robot_adapters.arm import (
    ArmMode,
    ArmState,
    CommandResult,
    DriverStatistics,
    NotConnectedError,
    StartRefusedError,
)
from robot_adapters.can import real_time
from robot_adapters.can.bus import BusError, open_bus, unread
from robot_adapters.can.control import ControlLoop
from robot_adapters.can.gravity import GravityModel
from robot_adapters.can.motor import Motor
from robot_adapters.can.one_master import find_master
from robot_adapters.can.settings import GripperMotor, LoopSettings
from robot_adapters.clock import Clock, RealClock, Schedule, SimulatedClock
from robot_adapters.safety import ControllerFailure, JointLimitViolation, SafetyEvent, SafetyGate
from robot_adapters.signals import SignalGuard

_log = logging.getLogger(__name__)
_FIRST_FEEDBACK = 0.25  # s


@dataclass(frozen=True)
class MotorIdentity:
    """A motor as it answered: its codec with the ranges it reported, its position [rad], its firmware."""

    motor: Motor
    position: float
    firmware: str


@dataclass(frozen=True)
class ArmIdentity:
    """What is on the bus, motors in joint order and then the gripper's. What nobody said is empty or NaN.

    gravity_factors: motor torque per joint torque, one a joint. voltage: of the supply [V].
    """

    name: str
    serial: str
    voltage: float
    gravity_factors: tuple[float, ...]
    motors: tuple[MotorIdentity, ...]


class CanArm[IdentityT: ArmIdentity](ABC):
    """One arm on one bus, with its safety gate. A context manager that connects and closes.

    On a real clock a thread of its own talks to the motors; on a `SimulatedClock` that happens while the
    caller sleeps. A kind of arm says how its motors are found, started and let go, and which gripper it has.
    """

    def __init__(
        self,
        interface: str,
        channel: str | None,
        *,
        settings: LoopSettings,
        description: ArmDescription,
        clock: Clock | None = None,
        handle_signals: bool = True,
        **bus_options: Any,
    ) -> None:
        """Nothing is opened before `connect`.

        `interface` and `channel` are python-can's, `bus_options` go to it. `handle_signals` makes SIGINT and
        SIGTERM leave the motors safe before they do what they did before.
        """
        self.interface, self.channel = interface, channel
        self._settings, self.description = settings, description
        self.joint_names = self.description.joint_names
        self.clock: Clock = clock or RealClock()
        self.gate = SafetyGate(self.joint_names, *joint_limits(self.description), self._settings.limits)
        self.identity: IdentityT | None = None
        self._bus_options = bus_options
        self._bus: can.BusABC | None = None
        self._loop: ControlLoop | None = None
        self._thread: threading.Thread | None = None
        self.schedule: Schedule | None = None  # of the control loop on a simulated clock
        self._stopping = threading.Event()
        self._guard = SignalGuard(self._stopping.set) if handle_signals else None
        self._last_statistics: DriverStatistics | None = None

    # --- What a kind of arm says of itself ---

    @abstractmethod
    def _all_motors(self) -> Sequence[Motor]:
        """Codecs of every motor that may be on the bus, to recognise another master before anything is sent."""

    @abstractmethod
    def _identify(self, bus: can.BusABC) -> IdentityT:
        """Who is on the bus, read only. Raises NoAnswerError, or ValueError for motors that are not the arm's."""

    @abstractmethod
    def _bring_up(self, bus: can.BusABC, identity: IdentityT) -> list[float]:
        """Make the motors ready for MIT commands; their positions [rad], the first target to command."""

    @abstractmethod
    def _let_go(self, bus: can.BusABC, identity: IdentityT) -> None:
        """Leave the motors without torque. Raises BusError."""

    def _gripper(self, identity: IdentityT) -> GripperMotor | None:
        """The gripper that the last motor drives; None without one."""
        return None

    # --- What its users see ---

    @property
    def is_connected(self) -> bool:
        """Whether the control loop runs."""
        return self._loop is not None

    @property
    def mode(self) -> ArmMode:
        """What the control loop is doing."""
        return self._running().mode

    def connect(self) -> IdentityT:
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
            other = find_master(self._bus, self.clock, self._all_motors(), self._settings.listen)
            if other is not None:
                raise StartRefusedError(other)
            identity = self._identify(self._bus)
            self._check_start([motor.position for motor in identity.motors])
            self.identity = identity
            positions = self._bring_up(self._bus, identity)
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
            if loop.gripper is not None:
                record = records[loop.motors[-1].id]
                silent = self.clock.monotonic() - record.stamp > self._settings.limits.feedback_timeout
                gripper = math.nan if silent else loop.gripper.opening(record.position)
            hottest = {i: max(r.motor_temperature, r.mosfet_temperature) for i, r in records.items()}
            return ArmState(q, dq, torque, gripper, hottest, -age, loop.mode)

    def command(self, q: ArrayLike, gripper: float | None = None) -> CommandResult:
        """Move to joint angles `q` [rad] (dof,) and a gripper opening [m], within the safety gate's limits.

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
        return self._running().new_events()

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
        """Let the arm down softly, release the motors and close the bus. Closing twice is harmless.

        Stiffness fades, then gravity compensation, under damping. After a fault of the bus it does what still gets through.
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

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _running(self) -> ControlLoop:
        if self._loop is None:
            raise NotConnectedError("the arm is not connected: call connect() first")
        return self._loop

    def _check_start(self, positions: list[float]) -> None:
        margin = self._settings.limits.start_margin
        for joint, name in enumerate(self.joint_names):
            position, lower, upper = positions[joint], self.gate.lower[joint], self.gate.upper[joint]
            if not lower - margin <= position <= upper + margin:
                where = f"{name} stands at {position:.3f} rad, outside [{lower}, {upper}]"
                raise StartRefusedError(JointLimitViolation(where))

    def _make_loop(self, bus: can.BusABC, identity: IdentityT, positions: list[float]) -> ControlLoop:
        dof = len(self.joint_names)
        return ControlLoop(
            bus,
            self.clock,
            [each.motor for each in identity.motors],
            self.gate,
            GravityModel(self.description, self._settings.gravity),
            identity.gravity_factors,
            self._settings,
            positions[:dof],
            self._gripper(identity),
            positions[-1],
        )

    def _start(self, loop: ControlLoop) -> None:
        self._stopping.clear()
        atexit.register(self.close)
        if self._guard is not None:
            self._guard.install()
        if isinstance(self.clock, SimulatedClock):
            self.schedule = self.clock.every(1.0 / self._settings.rate, loop.tick)
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
        period = 1.0 / self._settings.rate
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
        steps = max(round(self._settings.shutdown * self._settings.rate), 1)
        period = 1.0 / self._settings.rate
        loop.end()
        try:
            for step in range(1, 2 * steps + 1):
                fading = step / steps  # 0 to 1 for the stiffness, then 1 to 2 for the gravity compensation
                damping = None if step <= steps else self._settings.final_damping
                loop.relax(max(1.0 - fading, 0.0), min(2.0 - fading, 1.0), damping)
                loop.tick()
                self.clock.sleep(period)
        except BaseException:
            _log.exception("the arm could not be let down softly")
        if self.identity is not None:
            self._release(loop.bus, self.identity)

    def _release(self, bus: can.BusABC, identity: IdentityT) -> None:
        for _ in range(2):
            try:
                self._let_go(bus, identity)
            except BusError as error:
                _log.warning("the motors could not be released: %s", error)
                return
            self.clock.sleep(0.005)
