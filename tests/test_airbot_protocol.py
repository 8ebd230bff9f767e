"""The codecs reproduce independent frames bit for bit, invert themselves and survive any bytes."""

from __future__ import annotations

import json
import math

import can
import numpy as np
import pytest
from airbot_data import airbot_data
from hypothesis import given
from hypothesis import strategies as st

from robot_adapters.airbot.protocol import (
    BASE_BOARD_ID,
    Board,
    BoardRegister,
    DmLifecycle,
    DmMotor,
    DmRegister,
    MotorFeedback,
    OdMotor,
    OdRegister,
    ParameterReply,
    motor_angle_from_opening,
    opening_from_motor_angle,
)

# A few frames of an independent implementation; the data folder, where there is one, holds all 48.
COMMAND_KEYS = ("motor", "id", "pos", "vel", "eff", "kp", "kd", "can_id", "data")
COMMANDS = [
    ("od", 3, 0.7495, -7.9278, -4.4275, 45.368, 1.9928, "003", "02E81487AC47A6D1"),
    ("od", 3, 2.3025, 4.2875, -4.3222, 181.686, 4.1901, "003", "0BA02B97939E76D9"),
    ("dm", 7, -1.0458, -1.0882, -2.0956, 87.289, 3.1676, "007", "754A7B52CBA22652"),
    ("dm", 5, 1.2873, 30.2306, -5.1745, 132.258, 4.6037, "005", "8D2EFFF43BEBA3DC"),
]
FEEDBACK_KEYS = ("motor", "id", "can_id", "data", "pos", "vel", "eff", "error", "motor_temp", "mos_temp")
FEEDBACK = [
    (
        "od",
        2,
        "002",
        "201E27E40C3D5200",
        -9.555390357971191,
        14.070331573486328,
        15.904762268066406,
        0,
        16,
        0,
    ),
    (
        "od",
        1,
        "001",
        "2C1495191C7047",
        -10.490005493164062,
        -14.474725723266602,
        16.652015686035156,
        12,
        10,
        0,
    ),
    ("od", 3, "003", "28FE96BF889D45", 12.362287521362305, 8.936264038085938, 2.3076934814453125, 8, 9, 0),
    (
        "dm",
        4,
        "704",
        "8448AC435568981D",
        -5.403028964996338,
        -14.219779014587402,
        -3.240537166595459,
        8,
        152,
        29,
    ),
    (
        "dm",
        4,
        "704",
        "1459FDC9D2246749",
        -3.711947441101074,
        17.311355590820312,
        -7.323565483093262,
        1,
        103,
        73,
    ),
]


def _vectors(kind: str, keys: tuple, rows: list) -> list[dict]:
    every = airbot_data("can_vectors.json")
    return (
        [dict(zip(keys, row, strict=True)) for row in rows]
        if every is None
        else json.loads(every.read_text())[kind]
    )


MOTORS = {"od": OdMotor, "dm": DmMotor}
DECODERS = [OdMotor(1), OdMotor(3), DmMotor(4), DmMotor(7), Board(0), Board(8)]

messages = st.builds(
    can.Message,
    arbitration_id=st.sampled_from([0, 1, 3, 4, 7, 8, 0x83, 0x100, 0x103, 0x108, 0x704, 0x707, 0x7FF]),
    data=st.binary(max_size=64),
    is_extended_id=st.booleans(),
    is_remote_frame=st.booleans(),
    is_error_frame=st.booleans(),
)
dm_motors = st.builds(
    DmMotor, st.sampled_from([4, 5, 6, 7]), st.floats(1, 30), st.floats(1, 60), st.floats(1, 60)
)
motors = st.one_of(st.builds(OdMotor, st.sampled_from([1, 2, 3])), dm_motors)
numbers = st.floats(-1e6, 1e6)


@pytest.mark.parametrize("vector", _vectors("mit_commands", COMMAND_KEYS, COMMANDS))
def test_commands_match_independent_frames_bit_for_bit(vector):
    motor = MOTORS[vector["motor"]](vector["id"])
    message = motor.encode_mit(vector["pos"], vector["vel"], vector["eff"], vector["kp"], vector["kd"])
    assert message.data.hex().upper() == vector["data"]
    assert message.arbitration_id == int(vector["can_id"], 16)
    assert not message.is_extended_id


@pytest.mark.parametrize("vector", _vectors("feedback", FEEDBACK_KEYS, FEEDBACK))
def test_feedback_matches_independent_values(vector):
    message = can.Message(
        arbitration_id=int(vector["can_id"], 16), data=bytes.fromhex(vector["data"]), is_extended_id=False
    )
    feedback = MOTORS[vector["motor"]](vector["id"]).decode(message)
    assert isinstance(feedback, MotorFeedback)
    for name, key in (("position", "pos"), ("velocity", "vel"), ("torque", "eff")):
        assert np.float32(getattr(feedback, name)) == np.float32(vector[key])
    assert feedback.error == vector["error"]
    assert feedback.motor_temperature == vector["motor_temp"]
    assert feedback.mosfet_temperature == vector["mos_temp"]


@given(messages)
def test_no_decoder_raises_on_any_frame(message):
    for decoder in DECODERS:
        reply = decoder.decode(message)
        assert reply is None or isinstance(reply, MotorFeedback | ParameterReply)
        decoder.decode_request(message)
    for motor in DECODERS[:4]:
        motor.decode_mit(message)
    for motor in DECODERS[2:4]:
        motor.decode_lifecycle(message)
        motor.is_ping(message)


@given(motors, numbers, numbers, numbers, st.floats(-10, 600), st.floats(-10, 60))
def test_a_command_reads_back_clamped_to_within_half_a_quantum(motor, position, velocity, torque, kp, kd):
    command = motor.decode_mit(motor.encode_mit(position, velocity, torque, kp, kd))
    for value, sent, limits in (
        (command.position, position, motor.position_range),
        (command.velocity, velocity, motor.velocity_range),
        (command.torque, torque, motor.torque_range),
        (command.kd, kd, motor.kd_range),
    ):
        clamped = min(max(sent, limits.low), limits.high)
        assert abs(value - clamped) <= 0.501 * limits.quantum + 1e-6 * abs(limits.high)


@given(motors, st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.integers(8, 14))
def test_feedback_reads_back_as_the_motor_sent_it(motor, position, velocity, torque, error):
    sent = MotorFeedback(motor.id, position, velocity, torque, error, 41, 0)
    seen = motor.decode(motor.encode_feedback(sent))
    assert (seen.motor_id, seen.error, seen.motor_temperature) == (motor.id, error, 41)
    assert abs(seen.position - position) <= motor.position_range.quantum
    assert abs(seen.velocity - velocity) <= motor.velocity_range.quantum
    assert abs(seen.torque - torque) <= motor.torque_range.quantum


@pytest.mark.parametrize("motor", [OdMotor(2), DmMotor(5)])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_never_sent(motor, bad):
    with pytest.raises(ValueError, match="velocity"):
        motor.encode_mit(0.0, bad, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("pos_max", [0.0, -1.0, math.nan, math.inf])
def test_impossible_ranges_are_refused(pos_max):
    with pytest.raises(ValueError, match="range"):
        DmMotor(4, pos_max=pos_max)


def test_dm_lifecycle_frames_are_not_commands():
    motor = DmMotor(6)
    for action, last in (
        (DmLifecycle.ENABLE, 0xFC),
        (DmLifecycle.DISABLE, 0xFD),
        (DmLifecycle.SET_ZERO, 0xFE),
    ):
        message = motor.lifecycle(action)
        assert (message.arbitration_id, bytes(message.data)) == (6, b"\xff" * 7 + bytes([last]))
        assert motor.decode_lifecycle(message) == action
        assert motor.decode_mit(message) is None
    assert motor.is_ping(motor.ping())
    assert bytes(motor.ping().data) == bytes([6, 0, 0xCC, 0])


def test_dm_parameters_round_trip():
    motor = DmMotor(4)
    request = motor.request(DmRegister.POS_MAX)
    assert (request.arbitration_id, bytes(request.data)) == (0x7FF, bytes([4, 0, 0x33, 0x15]))
    reply = motor.decode(motor.encode_parameter(DmRegister.POS_MAX, np.float32(12.5).tobytes()))
    assert reply == ParameterReply(4, 0x15, np.float32(12.5).tobytes(), 12.5)
    written = motor.decode_request(motor.write(DmRegister.CONTROL_MODE, 1))
    assert (written.register, written.data) == (0x0A, b"\x01\0\0\0")
    with pytest.raises(ValueError, match="FIRMWARE"):
        motor.write(DmRegister.FIRMWARE, 1)


def test_od_registers_round_trip():
    motor = OdMotor(1)
    assert bytes(motor.request(OdRegister.POSITION).data) == bytes([0xE0, 0x01])
    position = motor.encode_parameter(OdRegister.POSITION, np.array(90.0, ">f4").tobytes())
    assert (position.arbitration_id, len(position.data), position.data[0] >> 5) == (1, 6, 5)
    assert motor.decode(position).value == 90.0
    assert bytes(motor.request(OdRegister.FIRMWARE).data) == bytes([0x02])
    firmware = motor.decode(motor.encode_parameter(OdRegister.FIRMWARE, b"\1\2\3\4"))
    assert (firmware.register, firmware.segment, firmware.data) == (2, 1, b"\1\2\3\4")


def test_an_od_position_velocity_request_is_not_feedback():
    request = can.Message(arbitration_id=1, data=bytes([0x20, 0, 0, 0, 0, 0, 0, 0b01]), is_extended_id=False)
    assert OdMotor(1).decode(request) is None


def test_board_values_come_in_numbered_segments():
    board = Board(BASE_BOARD_ID)
    floats = np.arange(24, dtype="<f4")
    replies = [
        board.decode(frame)
        for frame in board.encode_parameter(BoardRegister.GRAVITY_FACTORS, floats.tobytes())
    ]
    assert [reply.segment for reply in replies] == list(range(1, 25))
    assert [reply.value for reply in replies] == floats.tolist()
    light = board.light(3)
    assert (light.arbitration_id, light.data[0], light.data[-1]) == (0x80, 0x15, 3)


def test_errors_have_names():
    assert DmMotor(4).fault(1) is None
    assert OdMotor(1).fault(0) is None
    assert "over-temperature" in DmMotor(4).fault(12)
    assert "30" in OdMotor(1).fault(30)


@given(st.floats(0.0, 0.07))
def test_gripper_angle_and_opening_are_inverse(opening):
    assert opening_from_motor_angle(motor_angle_from_opening(opening)) == pytest.approx(opening, abs=1e-6)


def test_gripper_is_closed_at_zero_and_opens_towards_negative_angles():
    assert opening_from_motor_angle(0.0) == pytest.approx(0.0, abs=1e-5)
    angles = [motor_angle_from_opening(opening) for opening in np.linspace(0.0, 0.07, 20)]
    assert all(np.diff(angles) < 0)
    with pytest.raises(ValueError, match="opening"):
        motor_angle_from_opening(math.nan)
