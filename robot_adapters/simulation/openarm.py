"""A simulated OpenArm on a CAN bus: eight Damiao motors at the ids and ranges that LeRobot's `openarm_follower` expects.

LeRobot's driver stays as it is: it opens the same bus with `can_interface` virtual (in this process) or udp_multicast
(in another one) and `use_can_fd=False`. Needs the `sim` extra.
"""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from typing import Any

import can
import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_mimicik.kinematics.arms import describe_arm
from robot_adapters.can.bus import open_bus
from robot_adapters.can.dm_motor import MIT_MODE, DmMotor
from robot_adapters.clock import RealClock
from robot_adapters.simulation.faults import FaultInjector
from robot_adapters.simulation.plant import ArmPlant, PlantParameters
from robot_adapters.simulation.servo_arm import chain_only
from robot_adapters.simulation.simulated_motor import Body, GripperBody, JointBody, SimulatedMotor

# Largest velocity and torque [rad/s, Nm] of DM-J8009, DM-J4340 and DM-J4310, from the manufacturer's tables.
_DM8009, _DM4340, _DM4310 = (45.0, 54.0), (8.0, 28.0), (30.0, 10.0)
_MOTORS = (_DM8009, _DM8009, _DM4340, _DM4340, _DM4310, _DM4310, _DM4310, _DM4310)
_POSITION = 12.5  # rad, of all of them
_ANSWERS = 0x10  # a motor with id i answers under 0x10 + i
_OPEN = math.radians(-65.0)  # of the gripper's motor
_TIMESTEP = 0.002  # s
_POLL = 0.002  # s without a frame after which the mechanics go on
_MOST_CATCH_UP = 0.1  # s of mechanics made good at once after the process was held up
_PARAMETERS = PlantParameters(
    torque_factors=(1.0,) * 7,
    friction=(0.3, 0.3, 0.2, 0.2, 0.05, 0.05, 0.05),
    damping=(0.5, 0.5, 0.3, 0.3, 0.1, 0.1, 0.1),
    armature=(0.02, 0.02, 0.02, 0.02, 0.01, 0.01, 0.01),
    lag=(0.0,) * 7,
    dead_time=0.0,
    timestep=_TIMESTEP,
)


class SimulatedOpenArm:
    """One arm and its gripper behind a bus, running in a thread of its own from `start` to `stop`."""

    def __init__(
        self, bus: can.BusABC, side: str = "right", q: ArrayLike | None = None, seed: int = 0
    ) -> None:
        """Hangs straight down, or rests at `q` [rad] (7,), with motors that give no torque; the bus stays the caller's.

        Raises:
            ModuleNotFoundError: Without MuJoCo.
            ValueError: A side that is none.
        """
        if side not in ("left", "right"):
            raise ValueError(f"side={side!r}: expected 'left' or 'right'")
        self.bus = bus
        self.description = describe_arm(f"openarm_{side}")
        start = np.zeros(7) if q is None else np.asarray(q, dtype=float)
        chain = replace(self.description, urdf=chain_only(self.description))
        self._plant = ArmPlant(chain, _PARAMETERS, start)
        self._gripper = GripperBody(_OPEN)
        bodies: list[Body] = [*(JointBody(self._plant, joint) for joint in range(7)), self._gripper]
        random, faults = np.random.default_rng(seed), FaultInjector((), seed)
        self.motors: dict[int, SimulatedMotor] = {}
        for number, (body, (velocity, torque)) in enumerate(zip(bodies, _MOTORS, strict=True), start=1):
            codec = DmMotor(number, _POSITION, velocity, torque, answer_id=_ANSWERS + number)
            motor = self.motors[number] = SimulatedMotor(codec, body, faults, random)
            motor.control_mode = MIT_MODE  # as an assembled arm's motors are configured
        self._clock = RealClock()
        self._now = self._clock.monotonic()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def q(self) -> NDArray[np.float64]:
        """The true joint angles [rad] (7,)."""
        return self._plant.q

    @property
    def gripper_angle(self) -> float:
        """The true angle of the gripper's motor [rad]: 0 closed, -1.13 open."""
        return self._gripper.state()[0]

    def start(self) -> SimulatedOpenArm:
        """Run in a thread; starting twice is harmless."""
        if self._thread is None:
            self._stopping.clear()
            self._now = self._clock.monotonic()
            self._thread = threading.Thread(target=self.run, name="simulated-openarm", daemon=True)
            self._thread.start()
        return self

    def stop(self) -> None:
        """Stop running; stopping twice is harmless."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout=2.0)
            self._thread = None

    def __enter__(self) -> SimulatedOpenArm:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def run(self) -> None:
        """Serve the bus in real time until `stop` is called from elsewhere."""
        while not self._stopping.is_set():
            try:
                message = self.bus.recv(_POLL)
                self._advance()
                if message is not None:
                    self._hear(message)
            except (can.CanError, OSError):
                if not self._stopping.is_set():
                    raise
                return

    def _hear(self, message: can.Message) -> None:
        for motor in self.motors.values():
            replies = motor.answer(message, self._now)
            if replies is not None:
                for reply in replies:
                    self.bus.send(reply)
                return

    def _advance(self) -> None:
        now = self._clock.monotonic()
        self._now = max(self._now, now - _MOST_CATCH_UP)
        steps = int((now - self._now) / _TIMESTEP)
        # Resting on its support until it is first enabled, as the arm does before anybody drives it.
        if steps and any(motor.enabled for motor in self.motors.values()):
            self._plant.step(steps)
            self._gripper.step(steps * _TIMESTEP)
        self._now += steps * _TIMESTEP


def serve(interface: str = "udp_multicast", channel: str | None = None, **options: Any) -> None:
    """Put a simulated OpenArm on a bus and serve it in real time until interrupted; `options` are its own.

    Blocks. KeyboardInterrupt and SystemExit pass through after the bus is closed.
    """
    bus = open_bus(interface, channel)
    try:
        SimulatedOpenArm(bus, **options).run()
    finally:
        bus.shutdown()
