"""What the driver refuses, limits, holds at and stops for, on a simulated clock."""

from __future__ import annotations

import ctypes
import math
import threading

import can
import numpy as np
import pytest
from driver_cell import QUICK, SlowMotion, connected_cell, names, track

pytest.importorskip("mujoco")

from robot_adapters.airbot.protocol import DmLifecycle, DmMotor
from robot_adapters.arm import ArmMode
from robot_adapters.can.bus import open_bus
from robot_adapters.safety import CommandStatus
from robot_adapters.simulation.cell import SimulatedCell
from robot_adapters.simulation.faults import Fault, FaultKind


@pytest.fixture
def cell():
    with connected_cell() as cell:
        yield cell


def test_refused_and_limited_commands_are_reported_and_counted(cell):
    q = cell.arm.read().q
    refused = cell.arm.command(q + 0.6)
    assert (refused.status, names(refused.events)) == (CommandStatus.REFUSED, ["JumpViolation"])
    nan = cell.arm.command(q * math.nan)
    assert (nan.status, names(nan.events)) == (CommandStatus.REFUSED, ["NonFiniteCommand"])
    gripper = cell.arm.command(q, gripper=math.inf)
    assert (gripper.status, names(gripper.events)) == (CommandStatus.REFUSED, ["NonFiniteCommand"])
    cell.clock.sleep(0.05)
    limited = cell.arm.command(q + 0.4)
    assert (limited.status, names(limited.events)) == (CommandStatus.LIMITED, ["StepLimitViolation"])
    assert np.max(limited.q_sent - q) <= 0.1 + 1e-3
    cell.clock.sleep(0.05)
    wide = cell.arm.command(limited.q_sent, gripper=0.2)
    assert (wide.status, names(wide.events)) == (CommandStatus.LIMITED, ["JointLimitViolation"])
    statistics = cell.arm.statistics()
    assert (statistics.targets_refused, statistics.targets_limited) == (3, 2)
    assert statistics.events["JumpViolation"] == 1
    with pytest.raises(ValueError, match="joint1"):
        cell.arm.command([0.0])


def test_whatever_is_commanded_no_frame_violates_the_limits(cell):
    random = np.random.default_rng(3)
    q = cell.arm.read().q
    for _ in range(30):
        q = cell.arm.command(q + random.normal(0.0, 0.3, 6)).q_sent
        cell.clock.sleep(float(random.uniform(0.005, 0.12)))
    assert cell.listener.commands > 200
    assert cell.listener.largest_step <= 0.101


def test_stale_targets_hold_the_measured_position(cell):
    track(cell, 0.5, amplitude=0.4)
    cell.clock.sleep(0.19)
    assert cell.arm.mode is ArmMode.TRACKING
    cell.clock.sleep(0.03)
    assert cell.arm.mode is ArmMode.HOLD
    held = cell.arm.read().q
    cell.clock.sleep(0.4)
    assert np.max(np.abs(cell.arm.read().q - held)) < 0.1
    assert names(cell.arm.events()) == ["CommandTimeout"]
    assert cell.arm.command(cell.arm.read().q).status is CommandStatus.ACCEPTED
    assert cell.arm.mode is ArmMode.TRACKING


def inject(cell, kind, motor_id=None, duration=math.inf, **options):
    fault = Fault(kind, motor_id, cell.clock.monotonic(), duration, **options)
    cell.simulation.faults.faults.append(fault)


def test_stale_feedback_holds_then_tracks_again(cell):
    track(cell, 0.5)
    inject(cell, FaultKind.SILENT_MOTOR, 5, duration=0.4)
    results = track(cell, 0.3)
    assert cell.arm.mode is ArmMode.HOLD
    assert results[-1].status is CommandStatus.REFUSED
    seen = [name for result in results for name in names(result.events)]
    assert set(seen) == {"FeedbackTimeout"}
    cell.clock.sleep(0.2)
    assert track(cell, 0.2)[-1].status is CommandStatus.ACCEPTED


def test_a_lost_motor_stops_the_arm(cell):
    inject(cell, FaultKind.SILENT_MOTOR, 2)
    track(cell, 1.2)
    assert cell.arm.mode is ArmMode.STOPPED


def test_a_gripper_motor_that_falls_silent_is_an_event_and_has_no_opening(cell):
    track(cell, 0.3)
    inject(cell, FaultKind.SILENT_MOTOR, 7)
    results = track(cell, 0.3)
    assert "FeedbackTimeout" in {name for result in results for name in names(result.events)}
    assert cell.arm.mode is ArmMode.HOLD
    assert math.isnan(cell.arm.read().gripper)
    cell.clock.sleep(1.0)
    assert cell.arm.mode is ArmMode.STOPPED


@pytest.mark.parametrize(
    ("kind", "motor", "magnitude", "event"),
    [
        (FaultKind.MOTOR_ERROR, 2, 4, "MotorFault"),
        (FaultKind.MOTOR_ERROR, 6, 11, "MotorFault"),
        (FaultKind.OVER_TEMPERATURE, 3, 95.0, "OverTemperature"),
        (FaultKind.OVER_TEMPERATURE, 5, 95.0, "OverTemperature"),
        (FaultKind.BUS_OFF, None, 0.0, "BusOff"),
        (FaultKind.CONTROL_MODE, 5, 3, "WrongControlMode"),
        (FaultKind.CONTROL_MODE, 7, 2, "WrongControlMode"),
    ],
)
def test_errors_heat_and_bus_off_stop_the_arm(cell, kind, motor, magnitude, event):
    track(cell, 0.2)
    inject(cell, kind, motor, magnitude=magnitude)
    cell.clock.sleep(0.24)  # each motor is asked for its mode every 0.2 s
    assert cell.arm.mode is ArmMode.STOPPED
    result = cell.arm.command(cell.arm.read().q)
    assert result.status is CommandStatus.REFUSED
    assert names(result.events) == [event, "ArmStopped"]
    assert event in result.events[1].message


def test_one_damaged_frame_does_not_stop_the_arm(cell):
    inject(cell, FaultKind.CORRUPTED, rate=0.05, duration=1.0)
    results = track(cell, 1.2)
    assert {result.status for result in results} == {CommandStatus.ACCEPTED}


def test_a_blocked_joint_is_a_following_error_and_holds(cell):
    cell.simulation.plant.model.dof_frictionloss[0] = 1e3
    target, seen = cell.arm.read().q, []
    for _ in range(20):
        target[0] += 0.05
        result = cell.arm.command(target)
        seen += names(result.events)
        if result.status is CommandStatus.REFUSED:
            break
        cell.clock.sleep(0.05)
    assert seen[0] == "FollowingError"


def test_a_failing_bus_stops_the_loop_in_real_time():
    with SimulatedCell(SlowMotion(), settings=QUICK) as cell:
        cell.arm.connect()
        cell.arm._bus.shutdown()
        for _ in range(100):
            cell.clock.sleep(0.02)
            if cell.arm.mode is ArmMode.STOPPED:
                break
        assert cell.arm.mode is ArmMode.STOPPED
        cell.arm.close()


def test_a_control_thread_that_is_made_to_exit_leaves_the_motors_released():
    with SimulatedCell(SlowMotion(), settings=QUICK) as cell:
        cell.arm.connect()
        (thread,) = (each for each in threading.enumerate() if each.name == "airbot-control")
        ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit))
        thread.join(timeout=30.0)
        assert cell.arm.mode is ArmMode.STOPPED
        assert "ControllerFailure" in names(cell.arm.events())
        cell.clock.sleep(0.1)
        assert not any(cell.simulation.motors[i].enabled for i in (4, 5, 6, 7))


def test_an_arm_that_is_let_down_refuses_targets(cell):
    q = cell.arm.read().q
    cell.arm._running().end()
    result = cell.arm.command(q)
    assert (result.status, names(result.events)) == (CommandStatus.REFUSED, ["ArmStopped"])


def test_a_tick_that_comes_late_does_not_catch_up_in_one_step(cell):
    q = cell.arm.read().q
    for _ in range(4):
        cell.arm.command(q + 0.1)
        cell.clock.sleep(0.05)
    cell.freeze()
    for step in range(2, 5):
        # The control thread starves while targets come.
        cell.arm.command(q + 0.1 * step)
        cell.clock.sleep(0.05)
    cell.thaw()
    cell.clock.sleep(0.2)
    assert cell.listener.largest_step <= 0.101


def test_unknown_frames_are_counted_and_harmless(cell):
    stranger = open_bus("virtual", cell.arm.channel)
    random = np.random.default_rng(0)
    for _ in range(300):
        data = random.bytes(int(random.integers(0, 9)))
        stranger.send(
            can.Message(arbitration_id=int(random.integers(0x310, 0x700)), data=data, is_extended_id=False)
        )
    track(cell, 0.3)
    stranger.shutdown()
    assert cell.arm.mode is ArmMode.TRACKING
    assert cell.arm.statistics().frames_unknown > 0


def test_a_motor_that_disables_itself_is_a_fault(cell):
    cell.simulation.hear(DmMotor(5).lifecycle(DmLifecycle.DISABLE), cell.clock.monotonic())
    cell.clock.sleep(0.1)
    assert cell.arm.mode is ArmMode.STOPPED
    assert names(cell.arm.events()) == ["MotorFault"]
