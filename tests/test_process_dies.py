"""What a driver that dies leaves behind: nothing that acts for good."""

from __future__ import annotations

import numpy as np
import pytest
from driver_cell import QUICK, connected_cell, names, track

pytest.importorskip("mujoco")

from robot_adapters.airbot.protocol import DmMotor, OdMotor
from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.airbot.startup import RegisterError
from robot_adapters.arm import ArmMode
from robot_adapters.simulation.cell import SimulatedCell
from robot_adapters.simulation.listener import BusListener


def acting(cell):
    """Largest stiffness and feed-forward torque that still act on the joints."""
    return np.abs(cell.simulation.plant.model.actuator_biasprm[:, 1]).max(), np.abs(
        cell.simulation.plant.feed_forward
    ).max()


def test_every_motor_has_the_timeout_of_the_settings_once_connected():
    with SimulatedCell(settings=QUICK) as cell:
        cell.simulation.motors[2].timeout = 0
        cell.arm.connect()
        for motor in cell.simulation.motors.values():
            assert motor.timeout * motor.codec.timeout_tick == pytest.approx(0.5)
    with SimulatedCell(settings=AirbotSettings(motor_timeout=None, shutdown=0.02)) as cell:
        cell.arm.connect()
        assert cell.simulation.motors[5].timeout == 0


@pytest.mark.parametrize("motor", [OdMotor(1), DmMotor(4)])
def test_a_motor_that_takes_no_timeout_refuses_the_start(motor):
    class Stubborn(type(SimulatedCell(settings=QUICK).simulation.motors[1])):
        @property
        def timeout(self):
            return 7

        @timeout.setter
        def timeout(self, value):
            pass

    with SimulatedCell(settings=QUICK) as cell:
        cell.simulation.motors[motor.id].__class__ = Stubborn
        with pytest.raises(RegisterError, match=f"motor {motor.id} has 7 in register"):
            cell.arm.connect()


def test_a_killed_driver_leaves_nothing_that_acts():
    with SimulatedCell(settings=QUICK, listen=True) as cell:
        cell.arm.connect()
        track(cell, 0.6, amplitude=0.4)
        cell.freeze()
        cell.clock.sleep(0.4)
        cell.clock.sleep(0.25)
        assert acting(cell) == (0.0, 0.0)
        assert not any(cell.simulation.motors[i].enabled for i in (4, 5, 6, 7))
        cell.clock.sleep(0.5)
        assert np.max(np.abs(cell.simulation.plant.dq[:3])) < 0.8  # braked joints sink, they do not fall
        assert cell.listener.violations == []


def test_a_driver_that_stood_still_for_longer_than_the_motors_wait_does_not_stiffen_the_arm():
    with connected_cell() as cell:
        track(cell, 0.4)
        cell.freeze()
        cell.clock.sleep(2.0)
        cell.thaw()
        cell.clock.sleep(0.1)
        assert cell.arm.mode is ArmMode.STOPPED
        assert names(cell.arm.events()) == ["ControllerFailure"]
        stiffness, torque = acting(cell)
        assert stiffness == 0.0
        assert torque < 0.02  # a torque of zero lies between two codes
    with connected_cell() as cell:
        track(cell, 0.4)
        cell.freeze()
        cell.clock.sleep(0.4)
        cell.thaw()
        track(cell, 0.2)
        assert cell.arm.mode is ArmMode.TRACKING


def test_no_frame_would_leave_a_joint_outside_its_limits():
    with connected_cell() as cell:
        q = cell.arm.read().q
        for _ in range(40):
            q = cell.arm.command(q + np.array([0.0, 0.09, 0.0, 0.0, 0.0, 0.0])).q_sent
            cell.clock.sleep(0.05)
        assert q[1] == pytest.approx(cell.arm.gate.upper[1])


def test_the_listener_sees_a_frame_that_would_leave_a_joint_outside():
    with SimulatedCell() as cell:
        listener = BusListener(cell.simulation.bus, cell.clock, [-1.0] * 6, [1.0] * 6)
        listener.judge(OdMotor(2).encode_mit(0.99, 1.9, 0.0, 100.0, 3.0), 0.0)
        assert "would rest at 1.048 rad" in listener.violations.pop()
