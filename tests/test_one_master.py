"""Only one driver commands an arm: whoever finds another stops, and does not start."""

from __future__ import annotations

import contextlib

import can
import numpy as np
import pytest
from driver_cell import QUICK, connected_cell, names, track

pytest.importorskip("mujoco")

from robot_adapters.airbot.arm import AirbotArm, StartRefusedError
from robot_adapters.airbot.protocol import (
    DmLifecycle,
    DmMotor,
    DmRegister,
    MotorFeedback,
    OdMotor,
    all_motors,
)
from robot_adapters.arm import ArmMode
from robot_adapters.can.bus import open_bus
from robot_adapters.can.one_master import MasterWatch
from robot_adapters.safety import ForeignMaster
from robot_adapters.simulation.cell import SimulatedCell


@contextlib.contextmanager
def stranger(cell):
    bus = open_bus("virtual", cell.arm.channel)
    yield bus
    bus.shutdown()


def orders(bus, motors=()):
    """What was told to the motors since the last call, in words."""
    told = []
    while (message := bus.recv(0.0)) is not None:
        told += [order for motor in motors or all_motors() if (order := motor.order(message)) is not None]
    return told


ORDERS = [
    OdMotor(2).encode_mit(-1.2, 0.0, 0.0, 100.0, 3.0),
    OdMotor(2).encode_mit(0.0, 0.0, 0.0, 0.0, 3.0),
    can.Message(arbitration_id=1, data=[0x20, 0, 0, 0, 0, 0, 0, 1], is_extended_id=False),
    can.Message(arbitration_id=0x7FF, data=[0, 3, 0, 3], is_extended_id=False),
    DmMotor(5).encode_mit(0.0, 0.0, 0.0, 0.0, 0.0),
    DmMotor(5).lifecycle(DmLifecycle.SET_ZERO),
    DmMotor(7).lifecycle(DmLifecycle.DISABLE),
    DmMotor(4).write(DmRegister.CONTROL_MODE, 3),
    can.Message(arbitration_id=0x206, data=[0, 0, 0x80, 0x3F], is_extended_id=False),
]


@pytest.mark.parametrize("order", ORDERS, ids=lambda frame: f"{frame.arbitration_id:03X}-{frame.data.hex()}")
def test_one_order_of_somebody_else_stops_the_arm(order):
    with SimulatedCell(settings=QUICK) as cell, stranger(cell) as bus:
        cell.arm.connect()
        track(cell, 0.2)
        bus.send(order)
        cell.clock.sleep(0.02)
        assert cell.arm.mode is ArmMode.STOPPED
        assert names(cell.arm.events())[0] == "ForeignMaster"


def test_a_joint_that_somebody_else_has_moved_is_not_pulled_back():
    with SimulatedCell(settings=QUICK) as cell:
        cell.arm.connect()
        track(cell, 0.2)
        limp = OdMotor(3).encode_mit(0.0, 0.0, 0.0, 0.0, 0.0)
        other = cell.clock.every(0.002, lambda: cell.simulation.hear(limp, cell.clock.monotonic()))
        cell.clock.sleep(0.8)
        other.cancel()
        moved = cell.simulation.q
        cell.clock.sleep(0.3)
        assert cell.arm.mode is ArmMode.STOPPED
        assert np.max(np.abs(cell.simulation.q - moved)) < 0.15
        assert not cell.simulation.emergency_stopped


def test_somebody_who_only_asks_disturbs_nobody():
    with connected_cell() as cell, stranger(cell) as bus:
        for motor in all_motors():
            bus.send(motor.request(DmRegister.POS_MAX if isinstance(motor, DmMotor) else 0xE1))
        bus.send(DmMotor(4).ping())
        track(cell, 0.3)
        assert cell.arm.mode is ArmMode.TRACKING


@pytest.mark.parametrize("motor", [OdMotor(1), DmMotor(5)])
def test_answers_to_commands_nobody_saw_stop_the_arm_within_half_a_second(motor):
    with SimulatedCell(settings=QUICK) as cell:
        cell.arm.connect()
        track(cell, 0.2)
        held = float(cell.simulation.q[motor.id - 1])
        hidden = cell.clock.every(
            0.05,
            lambda: cell.simulation.hear(motor.encode_mit(held, 0.0, 0.0, 20.0, 1.0), cell.clock.monotonic()),
        )
        track(cell, 0.5)
        hidden.cancel()
        assert cell.arm.mode is ArmMode.STOPPED
        assert "ForeignMaster" in cell.arm.statistics().events


@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize("rate", [2.0, 20.0, 250.0])
def test_an_arm_that_somebody_commands_is_left_alone(rate, hidden):
    with SimulatedCell(settings=QUICK) as cell, stranger(cell) as bus, stranger(cell) as witness:
        frame = OdMotor(2).encode_mit(float(cell.simulation.q[1]), 0.0, 0.0, 50.0, 3.0)
        say = (
            (lambda: cell.simulation.hear(frame, cell.clock.monotonic()))
            if hidden
            else lambda: bus.send(frame)
        )
        cell.clock.every(1.0 / rate, say)
        with pytest.raises(StartRefusedError, match="ForeignMaster"):
            cell.arm.connect()
        cell.clock.sleep(0.1)
        sent = orders(witness, [motor for motor in all_motors() if motor.id != 2])
        assert sent == []
        assert not cell.arm.is_connected


def test_a_second_driver_does_not_touch_an_arm_that_is_driven():
    with connected_cell() as cell, stranger(cell) as witness:
        second = AirbotArm("virtual", cell.arm.channel, clock=cell.clock, handle_signals=False)
        orders(witness)
        with pytest.raises(StartRefusedError, match="end the other program"):
            second.connect()
        assert {result.status.value for result in track(cell, 0.3)} == {"accepted"}
        assert set(orders(witness)) == {"MIT command"}


def test_a_driver_that_was_connected_before_does_not_release_the_other_s_motors():
    with SimulatedCell(settings=QUICK) as cell:
        first, second = cell.arm, AirbotArm("virtual", cell.arm.channel, clock=cell.clock, settings=QUICK)
        first.connect()
        first.close()
        with second:
            with pytest.raises(StartRefusedError):
                first.connect()
            track_second = [second.command(second.read().q) for _ in range(3)]
            cell.clock.sleep(0.1)
            assert second.mode is ArmMode.TRACKING
            assert track_second
            assert all(cell.simulation.motors[i].enabled for i in (4, 5, 6, 7))


def test_an_interface_that_gives_back_what_was_sent_is_no_other_master():
    motors = all_motors()
    watch = MasterWatch(motors)
    random = np.random.default_rng(0)
    for _ in range(200):
        for motor in motors:
            frame = motor.encode_mit(float(random.normal()), 0.0, 0.0, 20.0, 1.0)
            watch.sent(frame, motor.id)
            assert watch.heard(frame) is None
            answer = MotorFeedback(motor.id, float(random.normal()), 0.0, 0.0, 1, 30, 30)
            assert watch.heard(motor.encode_feedback(answer)) is None
    old = motors[4].encode_mit(5.0, 0.0, 0.0, 20.0, 1.0)
    assert isinstance(watch.heard(old), ForeignMaster)
