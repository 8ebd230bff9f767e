"""A simulated AIRBOT Play that sits on a CAN bus like the real one: same ids, same frames, same protections.

On a `SimulatedClock` it is polled between the driver's ticks in one thread, faster than real time; on a
`RealClock` it runs in a thread of its own. With the interface `udp_multicast` it serves drivers in other
processes.
"""

from __future__ import annotations

import heapq
import itertools
import struct
import threading
from collections.abc import Iterable
from typing import Any

import can
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.kinematics.arms import ArmDescription, describe_arm
from robot_adapters.airbot.boards import BASE_BOARD_ID, END_BOARD_ID, BoardRegister, Tool
from robot_adapters.airbot.gripper import opening_from_motor_angle
from robot_adapters.airbot.protocol import DM_JOINTS, GRIPPER_ID, OD_JOINTS, DmMotor, OdMotor
from robot_adapters.can.bus import bus_off_report, open_bus
from robot_adapters.clock import Clock, RealClock, Schedule, SimulatedClock
from robot_adapters.simulation.faults import Fault, FaultInjector
from robot_adapters.simulation.plant import ArmPlant, PlantParameters
from robot_adapters.simulation.protection import StepProtection
from robot_adapters.simulation.simulated_motor import GripperBody, JointBody, SimulatedBoard, SimulatedMotor

_POLL_PERIOD = 0.002  # s
_REPLY_DELAY, _REPLY_JITTER = 3e-4, 5e-5  # s, mean and standard deviation
_MOST_CATCH_UP = 0.1  # s of physics made good at once after the process was held up


class SimulatedArm:
    """The arm's motors, boards and mechanics behind one bus."""

    def __init__(
        self,
        bus: can.BusABC,
        clock: Clock | None = None,
        *,
        description: ArmDescription | None = None,
        parameters: PlantParameters | None = None,
        q: ArrayLike | None = None,
        tool: Tool = Tool.G2,
        faults: Iterable[Fault] = (),
        seed: int = 0,
    ) -> None:
        """Build the arm at rest at `q` [rad] (6,), the description's home by default, on a bus that stays the
        caller's.

        The same seed, commands and simulated clock give the same motion and frames. `parameters` default to
        those of a real arm's log, lags included; `PlantParameters().without_lag()` follows commands at once.
        Raises ModuleNotFoundError without MuJoCo.
        """
        self.bus = bus
        self.clock: Clock = clock or RealClock()
        self.description = description or describe_arm("airbot_play")
        self.parameters = parameters or PlantParameters()
        start = np.asarray(self.description.home if q is None else q, dtype=float)
        random = np.random.default_rng(seed)
        self.plant = ArmPlant(self.description, self.parameters, start)
        self.faults = FaultInjector(faults, seed + 1)
        self.gripper = GripperBody()
        bodies = [(i, JointBody(self.plant, i - 1)) for i in (*OD_JOINTS, *DM_JOINTS)]
        self.motors = {
            i: SimulatedMotor(OdMotor(i) if i in OD_JOINTS else DmMotor(i), body, self.faults, random)
            for i, body in bodies
        }
        if tool is Tool.G2:
            self.motors[GRIPPER_ID] = SimulatedMotor(DmMotor(GRIPPER_ID), self.gripper, self.faults, random)
        for joint in self.motors:
            # The joint that is driven by the same kind of motor, where there is one.
            self.motors[joint].neighbour = self.motors.get(
                joint % 3 + 1 + 3 * (joint > 3), self.motors[joint]
            ).body
        self._all_motors = list(self.motors.values())
        self._listeners = {motor.id: [motor] for motor in self._all_motors}
        self.protections = {i: StepProtection() for i, _ in bodies}
        self.boards = [
            SimulatedBoard(BASE_BOARD_ID, _base_registers(self.parameters)),
            SimulatedBoard(END_BOARD_ID, _end_registers(tool)),
        ]
        self._random = random
        self._outbox: list[tuple[float, int, can.Message]] = []
        self._order = itertools.count()
        self._physics_time = self.clock.monotonic()
        self._was_off = False
        self._carried = False
        self._schedule: Schedule | None = None
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self.lost_time = 0.0

    @property
    def q(self) -> NDArray[np.float64]:
        """The true joint angles [rad] (6,)."""
        return self.plant.q

    @property
    def gripper_opening(self) -> float:
        """The gripper's true opening [m]."""
        return opening_from_motor_angle(self.gripper.state()[0])

    @property
    def warnings(self) -> int:
        """Frames in which a command moved a joint by more than 0.1 rad."""
        return sum(protection.warnings for protection in self.protections.values())

    @property
    def emergency_stopped(self) -> bool:
        """Whether a command moved a joint by more than 0.5 rad in a frame; the motors then brake for good."""
        return any(protection.tripped for protection in self.protections.values())

    @property
    def largest_step(self) -> float:
        """The largest commanded step of a joint in one 20 Hz frame so far [rad]."""
        return max(protection.largest_step for protection in self.protections.values())

    def start(self) -> SimulatedArm:
        """Run: scheduled on a simulated clock, in a thread on a real one. Starting twice is harmless."""
        if isinstance(self.clock, SimulatedClock):
            if self._schedule is None:
                self._physics_time = self.clock.monotonic()
                self._schedule = self.clock.every(_POLL_PERIOD, self.poll)
        elif self._thread is None:
            self._stopping.clear()
            self._physics_time = self.clock.monotonic()
            self._thread = threading.Thread(target=self.run, name="simulated-arm", daemon=True)
            self._thread.start()
        return self

    def stop(self) -> None:
        """Stop running; stopping twice is harmless. The bus stays open."""
        if self._schedule is not None:
            self._schedule.cancel()
            self._schedule = None
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
            self._thread = None

    def __enter__(self) -> SimulatedArm:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def run(self) -> None:
        """Serve the bus in real time until `stop` is called from elsewhere."""
        while not self._stopping.is_set():
            # Not at every frame: seven come at once, and waking for each would take a core from the driver.
            self.clock.sleep(_POLL_PERIOD)
            try:
                self.poll()
            except (can.CanError, OSError):
                if not self._stopping.is_set():
                    raise
                return

    def poll(self) -> None:
        """Advance the mechanics to now, hear the frames that came, send the replies due."""
        now = self.clock.monotonic()
        self._advance(now)
        self._go_off_or_on(now)
        while (message := self.bus.recv(0.0)) is not None:
            self.hear(message, now)
        for motor in self._all_motors:
            motor.watch(now)
        while self._outbox and self._outbox[0][0] <= now:
            _, _, reply = heapq.heappop(self._outbox)
            if not self.faults.bus_off(now):
                self.bus.send(reply)

    def _advance(self, now: float) -> None:
        behind = now - self._physics_time
        if behind > _MOST_CATCH_UP:
            self.lost_time += behind - _MOST_CATCH_UP
            self._physics_time = now - _MOST_CATCH_UP
            behind = _MOST_CATCH_UP
        steps = int(behind / self.parameters.timestep + 1e-6)
        if steps > 0:
            # Nothing falls before the motors are first in control: the arm rests on its support until then.
            self._carried = self._carried or all(
                self.motors[i].commanded is not None for i in self.protections
            )
            if self._carried:
                self.plant.step(steps)
            self.gripper.step(steps * self.parameters.timestep)
            self._physics_time += steps * self.parameters.timestep

    def _go_off_or_on(self, now: float) -> None:
        off = self.faults.bus_off(now)
        if off and not self._was_off:
            self._outbox.clear()
            self.bus.send(bus_off_report())
        self._was_off = off

    def hear(self, message: can.Message, now: float) -> None:
        """Take a frame that reaches the motors and boards now [s]."""
        for motor in self._listeners.get(message.arbitration_id, self._all_motors):
            if not self.faults.hears(motor.id, now):
                continue
            replies = motor.answer(message, now)
            if replies is not None:
                # A process that was held up hears many frames at once; the bus knows when they were sent.
                self._protect(motor, now if self.clock.simulated else message.timestamp)
                self._send(replies, motor.id, now)
                return
        for board in self.boards:
            replies = board.answer(message)
            if replies is not None and not self.faults.bus_off(now):
                self._send(replies, board.id, now)
                return

    def _protect(self, motor: SimulatedMotor, now: float) -> None:
        protection = self.protections.get(motor.id)
        if protection and protection.watch(motor.commanded, motor.body.state()[0], now):
            for each in self.motors.values():
                if not each.error:
                    each.stop()

    def _send(self, replies: list[can.Message], sender: int, now: float) -> None:
        due = now
        for reply in replies:
            due += max(self._random.normal(_REPLY_DELAY, _REPLY_JITTER), 1e-4)
            for when, what in self.faults.replies(reply, sender, due, now):
                heapq.heappush(self._outbox, (when, next(self._order), what))


def serve(interface: str = "udp_multicast", channel: str | None = None, **options: Any) -> None:
    """Put a simulated arm on a bus and serve it in real time until interrupted; `options` are
    `SimulatedArm`'s.

    Blocks. KeyboardInterrupt and SystemExit pass through after the bus is closed.
    """
    bus = open_bus(interface, channel)
    try:
        SimulatedArm(bus, RealClock(), **options).run()
    finally:
        bus.shutdown()


def _base_registers(parameters: PlantParameters) -> dict[int, bytes]:
    factors = struct.pack("<6f", *parameters.torque_factors) * 4
    return {
        BoardRegister.FIRMWARE: bytes([1, 0, 0, 0]),
        BoardRegister.SERIAL: b"SIMULATED-BASE-1",
        BoardRegister.PRODUCT_SERIAL: b"SIMULATED-PLAY-1",
        BoardRegister.NAME: b"AIRBOT Play (simulated)\0",
        BoardRegister.ZERO_POSITION: struct.pack("<6f", *(0.0,) * 6),
        BoardRegister.VOLTAGE: struct.pack("<f", 24.0),
        BoardRegister.GRAVITY_FACTORS: factors,
    }


def _end_registers(tool: Tool) -> dict[int, bytes]:
    return {
        BoardRegister.FIRMWARE: bytes([1, 0, 0, 0]),
        BoardRegister.SERIAL: b"SIMULATED-END-01",
        BoardRegister.TOOL_TYPE: struct.pack("<I", tool),
    }
