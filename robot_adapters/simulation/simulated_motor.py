"""One simulated motor, and the simulated boards: what each answers to the frames it hears."""

from __future__ import annotations

import math
import struct
from typing import Protocol

import can
import numpy as np

from robot_adapters.airbot.gripper import MAX_OPENING, motor_angle_from_opening
from robot_adapters.airbot.protocol import (
    MIT_MODE,
    Board,
    DmLifecycle,
    DmMotor,
    DmRegister,
    Motor,
    MotorFeedback,
    OdMotor,
    OdRegister,
)
from robot_adapters.simulation.faults import Fault, FaultInjector, FaultKind
from robot_adapters.simulation.plant import ArmPlant
from robot_adapters.simulation.sensor_faults import SensorFaults

POSITION_NOISE, VELOCITY_NOISE, TORQUE_NOISE = 1e-4, 5e-3, 5e-3  # standard deviations [rad, rad/s, Nm]
AMBIENT = 30.0  # degrees C
_BRAKE = {"od": 3.0, "dm": 1.0}  # damping of a motor that has stopped itself [Nm s/rad]
_STOPPED_ERROR = {"od": 2, "dm": 14}
_LOST_COMMUNICATION = 13  # a DM motor's error after its timeout
_VENDOR_TIMEOUT = {"od": 500, "dm": 0}  # ticks: OD as the vendor's software expects it, DM off as delivered


class Body(Protocol):
    """What a motor turns."""

    def state(self) -> tuple[float, float, float]:
        """Position [rad], velocity [rad/s] and motor torque [Nm]."""
        ...

    def command(self, position: float, velocity: float, torque: float, kp: float, kd: float) -> None:
        """Apply an MIT law from now on."""
        ...

    def release(self, damping: float) -> None:
        """Give no torque but braking."""
        ...

    def move_zero(self, offset: float) -> None:
        """Count positions from `offset` [rad] further on."""
        ...


class JointBody:
    """One joint of the plant, counted from the motor's zero."""

    def __init__(self, plant: ArmPlant, joint: int) -> None:
        self._plant, self._joint = plant, joint
        self._zero = 0.0  # rad, the joint's angle at which the motor counts zero

    def state(self) -> tuple[float, float, float]:
        position, velocity, torque = self._plant.joint_state(self._joint)
        return position - self._zero, velocity, torque

    def command(self, position: float, velocity: float, torque: float, kp: float, kd: float) -> None:
        self._plant.command(self._joint, position + self._zero, velocity, torque, kp, kd)

    def move_zero(self, offset: float) -> None:
        """Count from an angle [rad] further on; commands under way mean the new zero at once."""
        self._zero += offset
        self._plant.shift_lag(self._joint, offset)

    def release(self, damping: float) -> None:
        self._plant.release(self._joint, damping)


class GripperBody:
    """The gripper's motor: an inertia with friction between the closed and the open stop."""

    inertia, damping = 0.01, 0.05  # kg m^2, Nm s/rad

    def __init__(self, opened: float | None = None) -> None:
        """`opened` is the motor's angle [rad] when open, below zero; by default the G2's. It is closed at zero."""
        self._position, self._velocity, self._torque = 0.0, 0.0, 0.0
        self._law = (0.0, 0.0, 0.0, 0.0, 0.0)
        self._open, self._closed = motor_angle_from_opening(MAX_OPENING) if opened is None else opened, 0.0

    def state(self) -> tuple[float, float, float]:
        return self._position, self._velocity, self._torque

    def command(self, position: float, velocity: float, torque: float, kp: float, kd: float) -> None:
        self._law = (position, velocity, torque, kp, kd)

    def release(self, damping: float) -> None:
        self._law = (0.0, 0.0, 0.0, 0.0, damping)

    def move_zero(self, offset: float) -> None:
        self._position -= offset

    def step(self, seconds: float) -> None:
        """Advance by `seconds`, implicitly in the velocity."""
        position, velocity, torque, kp, kd = self._law
        push = kp * (position - self._position) + kd * velocity + torque
        rate = 1.0 + seconds * (kd + self.damping) / self.inertia
        self._velocity = (self._velocity + seconds * push / self.inertia) / rate
        self._torque = min(max(push - kd * self._velocity, -10.0), 10.0)
        self._position += seconds * self._velocity
        if not self._open <= self._position <= self._closed:
            self._position = min(max(self._position, self._open), self._closed)
            self._velocity = 0.0


class SimulatedMotor:
    """A motor of either family as its frames show it: enabling, errors, registers, the MIT law, noisy
    feedback.
    """

    def __init__(self, codec: Motor, body: Body, faults: FaultInjector, random: np.random.Generator) -> None:
        self.codec, self.body = codec, body
        self.enabled = isinstance(codec, OdMotor)
        self.error = 0
        self.temperature = AMBIENT
        self.control_mode = 0 if isinstance(codec, DmMotor) else MIT_MODE
        self.commanded: float | None = None  # position [rad] of the MIT law in force, if any
        self.timeout = _VENDOR_TIMEOUT[codec.family]  # ticks, 0 for none
        self._heard: float | None = None  # when a command last came, while one acts or may act [s]
        self.neighbour: Body = body  # of the joint whose feedback SWAPPED_FEEDBACK gives
        self._faults, self._random = faults, random
        self._sensors = SensorFaults(faults, codec.id, random)
        self._slipped: Fault | None = None

    @property
    def id(self) -> int:
        """The motor's id on the bus."""
        return self.codec.id

    def answer(self, message: can.Message, now: float) -> list[can.Message] | None:
        """The frames with which the motor answers one it heard; None when the frame is not for it."""
        self._suffer(now)
        command = self.codec.decode_mit(message)
        if command is not None:
            if self.enabled and not self.error and self.control_mode == MIT_MODE:
                self.body.command(command.position, command.velocity, command.torque, command.kp, command.kd)
                self.commanded = command.position if command.kp > 0 else None
                self._heard = now
            return [self.feedback(now)]
        request = self.codec.decode_request(message)
        if request is not None and request.data and request.register == self._timeout_register:
            self.timeout = int.from_bytes(
                request.data, "big" if isinstance(self.codec, OdMotor) else "little"
            )
        if isinstance(self.codec, OdMotor):
            return None if request is None else self._od_parameter(self.codec, request.register)
        action = self.codec.decode_lifecycle(message)
        if action is not None:
            self._live(action, now)
            return [self.feedback(now)]
        if self.codec.is_ping(message):
            return [self.feedback(now)]
        if request is None:
            return None
        if request.data and request.register == DmRegister.CONTROL_MODE:
            self.control_mode = int.from_bytes(request.data, "little")
        values = self._dm_registers(self.codec, now)
        if request.register not in values:
            return []
        return [self.codec.encode_parameter(request.register, values[request.register], bool(request.data))]

    def feedback(self, now: float) -> can.Message:
        """The feedback frame of this moment."""
        position, velocity, torque = self._sensors.report(self.body.state(), self.neighbour.state(), now)
        noise = self._random.standard_normal(3).tolist()
        hot = self._faults.active(FaultKind.OVER_TEMPERATURE, self.id, now)
        temperature = round(hot.magnitude if hot else self.temperature)
        if heating := self._sensors.active(FaultKind.HEATING, now):
            temperature += round(abs(heating.magnitude) * (now - heating.start))
        error = self.error
        if isinstance(self.codec, DmMotor) and not error:
            error = int(self.enabled)
        return self.codec.encode_feedback(
            MotorFeedback(
                self.id,
                position + POSITION_NOISE * noise[0],
                velocity + VELOCITY_NOISE * noise[1],
                torque + TORQUE_NOISE * noise[2],
                error,
                temperature,
                temperature,
            )
        )

    def stop(self) -> None:
        """Stop by itself: brake, report an error and follow no command until it is cleared."""
        self.fail(_STOPPED_ERROR[self.codec.family])

    def fail(self, error: int) -> None:
        """Take an error."""
        self.error = error
        self.commanded = None
        self.body.release(_BRAKE[self.codec.family])

    def reboot(self) -> None:
        """Start anew, as after a loss of power: no law, registers that were not saved as delivered."""
        self.enabled, self.error = isinstance(self.codec, OdMotor), 0
        self.control_mode = 0 if isinstance(self.codec, DmMotor) else MIT_MODE
        self.timeout = _VENDOR_TIMEOUT[self.codec.family]
        self._heard = self.commanded = None
        self.body.release(0.0)

    def watch(self, now: float) -> None:
        """Let go when no command has come for the motor's timeout.

        A DM motor then disables itself with an error; an OD motor, of which nobody says it, is taken to brake and
        to follow the next command.
        """
        if not self.timeout or self._heard is None or self.error:
            return
        if now - self._heard > self.timeout * self.codec.timeout_tick:
            self._heard, self.commanded = None, None
            if isinstance(self.codec, DmMotor):
                self.enabled, self.error = False, _LOST_COMMUNICATION
                self.body.release(0.0)
            else:
                self.body.release(_BRAKE["od"])

    @property
    def _timeout_register(self) -> int:
        return OdRegister.TIMEOUT if isinstance(self.codec, OdMotor) else DmRegister.TIMEOUT

    def _suffer(self, now: float) -> None:
        fault = self._faults.active(FaultKind.MOTOR_ERROR, self.id, now)
        if fault and not self.error:
            self.fail(int(fault.magnitude))
        mode = self._faults.active(FaultKind.CONTROL_MODE, self.id, now)
        if mode and isinstance(self.codec, DmMotor):
            self.control_mode = int(mode.magnitude)
        slip = self._faults.active(FaultKind.SLIPPED_ZERO, self.id, now)
        if slip and slip is not self._slipped:
            self._slipped = slip
            self.body.move_zero(slip.magnitude)

    def _live(self, action: DmLifecycle, now: float) -> None:
        if action is DmLifecycle.ENABLE:
            self.enabled, self._heard = True, now
        elif action is DmLifecycle.CLEAR_ERROR:
            self.error = 0
        elif action is DmLifecycle.SET_ZERO:
            self.body.move_zero(self.body.state()[0])
        elif action is DmLifecycle.DISABLE:
            self.enabled = False
            self.commanded = self._heard = None
            self.body.release(0.0)

    def _od_parameter(self, codec: OdMotor, register: int) -> list[can.Message]:
        position, velocity, torque = self.body.state()
        values = {
            OdRegister.BOARD_ID: bytes([self.id]),
            OdRegister.FIRMWARE: bytes([1, 0, 0, 0]),
            OdRegister.POSITION: struct.pack(">f", math.degrees(position)),
            OdRegister.VELOCITY: struct.pack(">f", math.degrees(velocity)),
            OdRegister.TORQUE: struct.pack(">f", torque),
            OdRegister.TIMEOUT: struct.pack(">I", self.timeout),
        }
        if register == OdRegister.SERIAL:
            serial = f"SIMULATED-OD-{self.id:03d}".encode()
            return [codec.encode_parameter(register, serial[4 * i : 4 * i + 4], i + 1) for i in range(4)]
        return [codec.encode_parameter(register, values[OdRegister(register)])] if register in values else []

    def _dm_registers(self, codec: DmMotor, now: float) -> dict[int, bytes]:
        wrong = self._faults.active(FaultKind.WRONG_RANGES, self.id, now)
        factor = wrong.magnitude if wrong else 1.0
        return {
            DmRegister.TIMEOUT: struct.pack("<I", self.timeout),
            DmRegister.CONTROL_MODE: struct.pack("<I", self.control_mode),
            DmRegister.FIRMWARE: b"sim1",
            DmRegister.GEAR_RATIO: struct.pack("<f", 10.0),
            DmRegister.POS_MAX: struct.pack("<f", factor * codec.position_range.high),
            DmRegister.VEL_MAX: struct.pack("<f", factor * codec.velocity_range.high),
            DmRegister.TORQUE_MAX: struct.pack("<f", factor * codec.torque_range.high),
        }


class SimulatedBoard:
    """A board that answers requests from a table of register values."""

    def __init__(self, board_id: int, registers: dict[int, bytes]) -> None:
        self.codec, self.registers = Board(board_id), registers

    @property
    def id(self) -> int:
        """The board's id on the bus."""
        return self.codec.id

    def answer(self, message: can.Message) -> list[can.Message] | None:
        """The frames with which the board answers; None when the frame is not for it."""
        request = self.codec.decode_request(message)
        if request is None:
            return None
        if request.data or request.register not in self.registers:
            return []
        return self.codec.encode_parameter(request.register, self.registers[request.register])
