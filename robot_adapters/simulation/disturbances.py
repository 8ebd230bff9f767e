"""What happens around an arm that its motors have no part in: others on the bus, and a driver that stands still.

The faults of motors and frames are in `faults`; these here are acted out beside the simulated arm.
"""

from __future__ import annotations

from collections import deque

import can
import numpy as np

from robot_adapters.airbot.arm import AirbotArm
from robot_adapters.airbot.protocol import DmLifecycle, DmMotor, DmRegister, all_motors
from robot_adapters.arm import StartRefusedError
from robot_adapters.can.bus import open_bus
from robot_adapters.clock import Schedule, SimulatedClock
from robot_adapters.simulation.cell import SimulatedCell
from robot_adapters.simulation.faults import Fault, FaultKind

# Ids that no motor and no board listens to.
_STRANGE_IDS = tuple(range(0x310, 0x700))
_BURST, _BURST_PERIOD = 16, 0.002  # frames, s: 8,000 frames a second fill a bus of 1 Mbit/s
_OLD = 75  # frames: commands that are replayed are 0.3 s old


class Disturbance:
    """Acts one fault out beside a cell on a simulated clock; `begin` and `end` when its time has come."""

    def __init__(self, cell: SimulatedCell, fault: Fault, seed: int = 0) -> None:
        """Nothing happens before `begin`; faults of other kinds than these never do."""
        self._cell, self._fault, self._random = cell, fault, np.random.default_rng(seed)
        self._bus = open_bus("virtual", cell.arm.channel)
        self._heard: deque[can.Message] = deque(maxlen=_OLD)
        self._schedules: list[Schedule] = []
        self.frozen = False
        self.complaints: list[str] = []
        if fault.kind is FaultKind.REPLAYED:
            self._every(0.002, self._record)

    def begin(self) -> None:
        """Start what the fault says."""
        kind, period = self._fault.kind, 1.0 / max(self._fault.magnitude, 1.0)
        if kind in (FaultKind.OTHER_MASTER, FaultKind.LIMP_MASTER):
            self._every(period, self._command)
        elif kind is FaultKind.HIDDEN_MASTER:
            self._every(period, self._command_unseen)
        elif kind is FaultKind.ONE_ORDER:
            self._send(self._one_order())
        elif kind is FaultKind.REPLAYED:
            self._every(0.004, self._replay)
        elif kind is FaultKind.BUSY_BUS:
            self._every(_BURST_PERIOD, self._burst)
        elif kind is FaultKind.SECOND_DRIVER:
            self._connect_second()
        elif kind is FaultKind.REBOOTED and self._fault.motor_id is not None:
            self._cell.simulation.motors[self._fault.motor_id].reboot()
        elif kind in (FaultKind.FROZEN, FaultKind.KILLED):
            self._cell.freeze()
            self.frozen = True

    def end(self) -> None:
        """Stop it; a killed driver stays dead."""
        for schedule in self._schedules:
            schedule.cancel()
        self._schedules = []
        if self.frozen and self._fault.kind is FaultKind.FROZEN:
            self._cell.thaw()
            self.frozen = False

    def close(self) -> None:
        """Stop it and leave the bus."""
        self.end()
        self._bus.shutdown()

    @property
    def let_go(self) -> bool:
        """Whether no motor acts any more."""
        simulation = self._cell.simulation
        stiff = np.any(simulation.plant.model.actuator_biasprm[:, 1] != 0.0)
        enabled = any(
            motor.enabled for motor in simulation.motors.values() if isinstance(motor.codec, DmMotor)
        )
        return not (stiff or enabled or np.any(simulation.plant.feed_forward != 0.0))

    def _every(self, period: float, action) -> None:
        assert isinstance(self._cell.clock, SimulatedClock)
        self._schedules.append(self._cell.clock.every(period, action))

    def _send(self, message: can.Message) -> None:
        if self._cell.listener is not None:
            self._cell.listener.others.add((message.arbitration_id, bytes(message.data)))
        self._bus.send(message)

    def _order(self) -> can.Message:
        """A command to where the motor is, a little beside it; a limp one without stiffness."""
        motor = self._cell.simulation.motors[self._fault.motor_id or 1]
        kp = 0.0 if self._fault.kind is FaultKind.LIMP_MASTER else 20.0
        position = motor.body.state()[0] + float(self._random.uniform(-0.05, 0.05))
        return motor.codec.encode_mit(position, 0.0, 0.0, kp, 1.0)

    def _command(self) -> None:
        self._send(self._order())

    def _command_unseen(self) -> None:
        self._cell.simulation.hear(self._order(), self._cell.clock.monotonic())

    def _one_order(self) -> can.Message:
        motor = self._cell.simulation.motors[self._fault.motor_id or 1].codec
        choices = [self._order()]
        if isinstance(motor, DmMotor):
            choices += [motor.lifecycle(action) for action in DmLifecycle]
            choices.append(motor.write(DmRegister.CONTROL_MODE, 2))
        return choices[int(self._random.integers(len(choices)))]

    def _record(self) -> None:
        while (message := self._bus.recv(0.0)) is not None:
            if any(motor.order(message) for motor in all_motors()):
                self._heard.append(message)

    def _replay(self) -> None:
        if len(self._heard) == _OLD:
            self._send(self._heard.popleft())

    def _burst(self) -> None:
        for arbitration_id in self._random.choice(_STRANGE_IDS, _BURST):
            data = self._random.bytes(8)
            self._bus.send(can.Message(arbitration_id=int(arbitration_id), data=data, is_extended_id=False))

    def _connect_second(self) -> None:
        before = self._bus_orders()
        second = AirbotArm("virtual", self._cell.arm.channel, clock=self._cell.clock, handle_signals=False)
        try:
            second.connect()
        except StartRefusedError:
            pass
        else:
            self.complaints.append("a second driver connected")
            second.close()
        if {order for order in self._bus_orders() if order != "MIT command"} - set(before):
            self.complaints.append("a second driver ordered motors that are driven")

    def _bus_orders(self) -> list[str]:
        """What was told to the motors since the last call, in words."""
        told = []
        while (message := self._bus.recv(0.0)) is not None:
            told += [order for motor in all_motors() if (order := motor.order(message)) is not None]
        return told
