"""Identifying an AIRBOT Play on its bus, and bringing its motors up in the order that real arms accept."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import can

from robot_adapters.airbot.boards import GRAVITY_FACTOR_OFFSET, SEGMENTS
from robot_adapters.airbot.protocol import (
    BASE_BOARD_ID,
    DM_JOINTS,
    END_BOARD_ID,
    GRIPPER_ID,
    MIT_MODE,
    OD_JOINTS,
    Board,
    BoardRegister,
    DmLifecycle,
    DmMotor,
    DmRegister,
    Motor,
    MotorFeedback,
    OdMotor,
    OdRegister,
    ParameterReply,
    Tool,
    all_motors,
)
from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.can.bus import NoAnswerError, ask, drain, receive, send
from robot_adapters.can.driver import ArmIdentity, MotorIdentity
from robot_adapters.can.one_master import find_master
from robot_adapters.clock import Clock
from robot_adapters.safety import ForeignMaster

RANGE_REGISTERS = (DmRegister.POS_MAX, DmRegister.VEL_MAX, DmRegister.TORQUE_MAX)
# Of the arm's DM motors (DM-J4310): pos_max [rad], vel_max [rad/s], torque_max [Nm]. A motor scales all its
# numbers by them, so that there is no such thing as a nearly right one.
DOCUMENTED_RANGES = (12.5, 30.0, 10.0)
_SAME = 1e-5  # relative: registers hold float32
DEFAULT_GRAVITY_FACTORS = (0.6, 0.6, 0.6, 1.6, 1.25, 1.5)
_WHOLE_VALUE_TIMEOUT = 0.1  # s for the segments after the first


class RegisterError(ValueError):
    """A motor whose registers do not hold what this arm needs; the message names register, value and remedy."""


class RangeError(RegisterError):
    """A motor that reports ranges it cannot have: with them every number would be scaled wrongly."""


@dataclass(frozen=True)
class AirbotIdentity(ArmIdentity):
    """What is on the bus, and which tool the end board reports."""

    tool: Tool

    @property
    def codecs(self) -> list[Motor]:
        """The motors' codecs, of the two families that this arm has."""
        return [each.motor for each in self.motors if isinstance(each.motor, OdMotor | DmMotor)]


def other_master(
    bus: can.BusABC, clock: Clock, settings: AirbotSettings | None = None
) -> ForeignMaster | None:
    """Whether somebody else commands the arm's motors: listens for `settings.listen` seconds, sends nothing."""
    return find_master(bus, clock, all_motors(), (settings or AirbotSettings()).listen)


def identify(bus: can.BusABC, clock: Clock, settings: AirbotSettings | None = None) -> AirbotIdentity:
    """Ask boards and motors who they are, read only: no motor is enabled, disabled or moved.

    Raises NoAnswerError for a motor, or for the end board unless the settings name the tool, and RangeError
    for a DM motor whose reported ranges are not those of this arm's motors.
    """
    settings = settings or AirbotSettings()
    tool = settings.tool if settings.tool is not None else read_tool(bus, clock)
    motors = [_identify_od(bus, clock, OdMotor(i)) for i in OD_JOINTS]
    motors += [_identify_dm(bus, clock, i, settings) for i in DM_JOINTS]
    if tool is Tool.G2:
        motors.append(_identify_dm(bus, clock, GRIPPER_ID, settings))
    return AirbotIdentity(
        _board_text(bus, clock, BoardRegister.NAME),
        _board_text(bus, clock, BoardRegister.PRODUCT_SERIAL),
        _board_number(bus, clock, BoardRegister.VOLTAGE),
        settings.gravity_factors or read_gravity_factors(bus, clock, tool),
        tuple(motors),
        tool,
    )


def bring_up(
    bus: can.BusABC, clock: Clock, identity: AirbotIdentity, settings: AirbotSettings | None = None
) -> list[float]:
    """Make the motors ready for MIT commands; their positions [rad] when all were, the first target to
    command.

    Every motor gets its timeout. Per DM motor: disable, wait for feedback, read the ranges, clear the error,
    enable, set the control mode. Raises NoAnswerError, RangeError for ranges that are not the motors', or
    RegisterError for a motor that does not take the timeout.
    """
    settings = settings or AirbotSettings()
    motors = identity.codecs
    for motor in motors:
        if not isinstance(motor, DmMotor):
            _set_timeout(bus, clock, motor, settings.motor_timeout)
            continue
        _act(bus, clock, motor, DmLifecycle.DISABLE)
        _set_timeout(bus, clock, motor, settings.motor_timeout)
        _read_ranges(bus, clock, motor.id, settings)
        _act(bus, clock, motor, DmLifecycle.CLEAR_ERROR)
        _act(bus, clock, motor, DmLifecycle.ENABLE)
        mode = motor.write(DmRegister.CONTROL_MODE, MIT_MODE)
        ask(bus, clock, mode, _parameter(motor, DmRegister.CONTROL_MODE), f"control mode of motor {motor.id}")
    positions = read_positions(bus, clock, motors)
    drain(bus)
    return positions


def read_positions(bus: can.BusABC, clock: Clock, motors: list[Motor]) -> list[float]:
    """Positions [rad] of the motors now, asked without commanding anything. Raises NoAnswerError."""
    positions = []
    for motor in motors:
        what = f"position of motor {motor.id}"
        if isinstance(motor, DmMotor):
            positions.append(ask(bus, clock, motor.ping(), _feedback(motor), what).position)
        else:
            register = OdRegister.POSITION
            reply = ask(bus, clock, motor.request(register), _parameter(motor, register), what)
            positions.append(math.radians(float(reply.value if isinstance(reply.value, float) else math.nan)))
    return positions


def read_tool(bus: can.BusABC, clock: Clock) -> Tool:
    """The mounted tool, from the end board; NoAnswerError when it is silent, ValueError for a tool nobody
    knows.
    """
    board = Board(END_BOARD_ID)
    accept = _parameter(board, BoardRegister.TOOL_TYPE)
    reply = ask(bus, clock, board.request(BoardRegister.TOOL_TYPE), accept, "the tool type of the end board")
    known = {int(tool): tool for tool in Tool}
    if reply.value not in known:
        raise ValueError(
            f"the end board reports tool {reply.value}, known are {sorted(known)}; name it in the settings"
        )
    return known[int(reply.value)]


def read_gravity_factors(bus: can.BusABC, clock: Clock, tool: Tool) -> tuple[float, ...]:
    """Motor torque per joint torque of the six joints; typical values when the base board has none."""
    values = read_segments(bus, clock, Board(BASE_BOARD_ID), BoardRegister.GRAVITY_FACTORS)
    start = GRAVITY_FACTOR_OFFSET[tool]
    factors = [reply.value for reply in values[start : start + 6]]
    if len(factors) == 6 and all(isinstance(x, float) and 0.1 < x < 5.0 for x in factors):
        return tuple(float(x) for x in factors if x is not None)
    return DEFAULT_GRAVITY_FACTORS


def read_segments(
    bus: can.BusABC, clock: Clock, board: Board, register: BoardRegister
) -> list[ParameterReply]:
    """All segments of a board's register in order; empty when some are missing or the board is silent."""
    accept = _parameter(board, register)
    try:
        first = ask(
            bus, clock, board.request(register), accept, f"register {register.name} of board {board.id}"
        )
    except NoAnswerError:
        return []
    found = {first.segment: first}
    until = clock.monotonic() + _WHOLE_VALUE_TIMEOUT
    while len(found) < SEGMENTS[register] and (message := receive(bus, clock, until)) is not None:
        reply = accept(message)
        if reply is not None:
            found[reply.segment] = reply
    if sorted(found) != list(range(1, SEGMENTS[register] + 1)):
        return []
    return [found[segment] for segment in sorted(found)]


def _board_text(bus: can.BusABC, clock: Clock, register: BoardRegister) -> str:
    pieces = [reply.data for reply in read_segments(bus, clock, Board(BASE_BOARD_ID), register)]
    return b"".join(pieces).split(b"\0")[0].decode("ascii", errors="replace")


def _board_number(bus: can.BusABC, clock: Clock, register: BoardRegister) -> float:
    replies = read_segments(bus, clock, Board(BASE_BOARD_ID), register)
    return float(replies[0].value) if replies and isinstance(replies[0].value, float) else math.nan


def _parameter(codec: Motor | Board, register: int) -> Callable[[can.Message], ParameterReply | None]:
    """What accepts the answer about one register of one motor or board."""

    def accept(message: can.Message) -> ParameterReply | None:
        reply = codec.decode(message)
        return reply if isinstance(reply, ParameterReply) and reply.register == register else None

    return accept


def _feedback(motor: Motor) -> Callable[[can.Message], MotorFeedback | None]:
    def accept(message: can.Message) -> MotorFeedback | None:
        reply = motor.decode(message)
        return reply if isinstance(reply, MotorFeedback) else None

    return accept


def _identify_od(bus: can.BusABC, clock: Clock, motor: OdMotor) -> MotorIdentity:
    for register in (OdRegister.POSITION, OdRegister.VELOCITY, OdRegister.TORQUE, OdRegister.FIRMWARE):
        what = f"{register.name.lower()} of motor {motor.id}"
        reply = ask(bus, clock, motor.request(register), _parameter(motor, register), what)
    firmware = ".".join(str(byte) for byte in reply.data)
    return MotorIdentity(motor, read_positions(bus, clock, [motor])[0], firmware)


def _identify_dm(bus: can.BusABC, clock: Clock, motor_id: int, settings: AirbotSettings) -> MotorIdentity:
    motor = _read_ranges(bus, clock, motor_id, settings)
    what = f"firmware of motor {motor_id}"
    firmware = ask(
        bus, clock, motor.request(DmRegister.FIRMWARE), _parameter(motor, DmRegister.FIRMWARE), what
    )
    return MotorIdentity(motor, read_positions(bus, clock, [motor])[0], str(firmware.value))


def _read_ranges(bus: can.BusABC, clock: Clock, motor_id: int, settings: AirbotSettings) -> DmMotor:
    expected = settings.motor_ranges.get(motor_id, DOCUMENTED_RANGES)
    asking = DmMotor(motor_id)
    for register, known in zip(RANGE_REGISTERS, expected, strict=True):
        name = register.name.lower()
        what = f"{name} of motor {motor_id}"
        value = ask(bus, clock, asking.request(register), _parameter(asking, register), what).value
        number = float(value) if isinstance(value, float) else math.nan
        if not abs(number - known) <= _SAME * known:
            raise RangeError(
                f"motor {motor_id} reports {name} = {number:g} in register 0x{register:02X}, this arm's motors "
                f"have {known:g}; write {known:g} into it with the maker's tool or, if the motor is of another "
                f"type, give AirbotSettings(motor_ranges={{{motor_id}: (pos_max, vel_max, torque_max)}})"
            )
    return DmMotor(motor_id, *expected)


def _set_timeout(bus: can.BusABC, clock: Clock, motor: Motor, seconds: float | None) -> None:
    """Have a motor let go by itself after `seconds` without a command, and see that it is so."""
    if seconds is None:
        return
    ticks, what = round(seconds / motor.timeout_tick), f"timeout of motor {motor.id}"
    register: int = OdRegister.TIMEOUT
    if isinstance(motor, DmMotor):
        register, write = DmRegister.TIMEOUT, motor.write(DmRegister.TIMEOUT, ticks)
    else:
        write = motor.write(OdRegister.TIMEOUT, ticks)

    def accept(message: can.Message) -> ParameterReply | None:
        reply = motor.decode(message)
        if not isinstance(reply, ParameterReply) or reply.register != register or reply.written:
            return None
        return reply

    value = ask(bus, clock, motor.request(register), accept, what).value
    if value != ticks:
        send(bus, write)
        value = ask(bus, clock, motor.request(register), accept, what).value
    if value != ticks:
        raise RegisterError(
            f"motor {motor.id} has {value} in register 0x{register:02X} (timeout) and did not take {ticks} "
            f"({seconds:g} s); set it with the maker's tool, or give AirbotSettings(motor_timeout=None) and "
            "accept that the arm stays stiff when the process is killed"
        )


def _act(bus: can.BusABC, clock: Clock, motor: DmMotor, action: DmLifecycle) -> MotorFeedback:
    # A lifecycle frame may find the bus busy; it is harmless to send twice.
    what = f"{action.name.lower()} of motor {motor.id}"
    return ask(bus, clock, motor.lifecycle(action), _feedback(motor), what)


def release(bus: can.BusABC, motors: list[Motor], damping: tuple[float, ...]) -> None:
    """Leave the motors without torque: OD motors braked by `damping` per motor [Nm s/rad] only, DM motors
    disabled.
    """
    for motor, brake in zip(motors, damping, strict=False):
        if isinstance(motor, DmMotor):
            send(bus, motor.lifecycle(DmLifecycle.DISABLE))
        else:
            send(bus, motor.encode_mit(0.0, 0.0, 0.0, 0.0, brake))
