"""The driver against the simulated arm: start-up, tracking, limits, holds, stops and shutdown, on a simulated
clock.
"""

from __future__ import annotations

import math
import subprocess
import sys
import threading

import can
import numpy as np
import pytest

pytest.importorskip("mujoco")

from robot_adapters.airbot.arm import AirbotArm, NotConnectedError, StartRefusedError
from robot_adapters.airbot.bus import BusError, NoAnswerError, open_bus
from robot_adapters.airbot.cell import SimulatedCell
from robot_adapters.airbot.control import ArmMode
from robot_adapters.airbot.faults import Fault, FaultKind
from robot_adapters.airbot.plant import PlantParameters
from robot_adapters.airbot.protocol import DmLifecycle, DmMotor, Tool
from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.airbot.startup import RangeError, identify
from robot_adapters.clock import RealClock, SimulatedClock
from robot_adapters.safety import CommandStatus

QUICK = AirbotSettings(shutdown=0.02)


@pytest.fixture
def cell():
    with SimulatedCell(listen=True, settings=QUICK) as cell:
        cell.arm.connect()
        yield cell
    assert cell.listener.violations == []
    assert cell.simulation.warnings == 0
    assert not cell.simulation.emergency_stopped


def names(events) -> list[str]:
    return [event.name for event in events]


def track(cell, seconds, amplitude=0.2, rate=20.0):
    """Follow a smooth motion; the results of all commands."""
    home, start, results = cell.arm.read().q, cell.clock.monotonic(), []
    while (t := cell.clock.monotonic() - start) < seconds - 1e-6:
        results.append(cell.arm.command(home + amplitude * np.sin(1.5 * t)))
        cell.clock.sleep(1.0 / rate)
    return results


def test_identification_reads_and_changes_nothing():
    with SimulatedCell(settings=QUICK) as cell:
        bus = cell.simulation.bus
        seen = open_bus("virtual", bus.channel_info.split()[-1])
        identity = identify(seen, cell.clock)
        seen.shutdown()
        assert identity.tool is Tool.G2
        assert identity.serial == "SIMULATED-PLAY-1"
        np.testing.assert_allclose(identity.gravity_factors, PlantParameters().torque_factors)
        np.testing.assert_allclose([m.position for m in identity.motors[:6]], cell.simulation.q, atol=1e-3)
        assert not any(cell.simulation.motors[i].enabled for i in (4, 5, 6, 7))


def test_start_up_enables_in_the_documented_order_and_moves_nothing():
    with SimulatedCell(settings=QUICK) as cell:
        before = cell.simulation.q
        witness = open_bus("virtual", cell.arm.channel)
        cell.arm.connect()
        cell.clock.sleep(0.3)
        codec, steps = DmMotor(5), []
        while (message := witness.recv(0.0)) is not None:
            action = codec.decode_lifecycle(message)
            request = codec.decode_request(message)
            if action is not None:
                steps.append(action.name)
            elif request is not None and request.data:
                steps.append(f"mode {request.data[0]}")
            elif codec.decode_mit(message) is not None:
                steps.append("command")
        witness.shutdown()
        assert steps[: steps.index("command")] == ["DISABLE", "CLEAR_ERROR", "ENABLE", "mode 1"]
        np.testing.assert_allclose(cell.simulation.q, before, atol=2e-3)
        assert cell.arm.mode is ArmMode.HOLD


def test_the_arm_follows_targets_and_the_gripper_opens(cell):
    results = track(cell, 0.8)
    assert {result.status for result in results} == {CommandStatus.ACCEPTED}
    assert cell.arm.mode is ArmMode.TRACKING
    target = results[-1].q_sent + 0.05
    for _ in range(25):
        cell.arm.command(target, gripper=0.04)
        cell.clock.sleep(0.05)
    state = cell.arm.read()
    np.testing.assert_allclose(state.q, target, atol=0.005)
    np.testing.assert_allclose(state.q, cell.simulation.q, atol=2e-3)
    assert state.gripper == pytest.approx(0.04, abs=0.002)
    assert cell.simulation.gripper_opening == pytest.approx(0.04, abs=0.002)
    statistics = cell.arm.statistics()
    assert statistics.targets_accepted == len(results) + 25
    assert statistics.frames_implausible == statistics.send_errors == statistics.unread == 0
    assert set(statistics.frames_received) == {1, 2, 3, 4, 5, 6, 7}


@pytest.mark.parametrize("rate", [20.0, 50.0])
def test_the_setpoint_arrives_between_targets_at_any_rate(rate):
    with SimulatedCell(settings=QUICK, parameters=PlantParameters().without_lag()) as cell:
        cell.arm.connect()
        track(cell, 0.6, rate=rate)
        error = np.abs(cell.arm.read().q - cell.simulation.q)
        assert np.max(error) < 0.005
        assert cell.simulation.largest_step < 0.05


def test_an_arm_without_the_vendor_s_lag_follows_at_once():
    lags = []
    for parameters in (PlantParameters(), PlantParameters().without_lag()):
        with SimulatedCell(settings=QUICK, parameters=parameters) as cell:
            cell.arm.connect()
            home = cell.arm.read().q
            for step in range(12):
                result = cell.arm.command(home + 0.02 * step)
                cell.clock.sleep(0.05)
            lags.append(np.max(result.q_sent - cell.simulation.q))
    assert lags[1] < 0.02
    assert lags[0] > 0.04


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


@pytest.mark.parametrize(
    ("kind", "motor", "magnitude", "event"),
    [
        (FaultKind.MOTOR_ERROR, 2, 4, "MotorFault"),
        (FaultKind.MOTOR_ERROR, 6, 11, "MotorFault"),
        (FaultKind.OVER_TEMPERATURE, 3, 95.0, "OverTemperature"),
        (FaultKind.OVER_TEMPERATURE, 5, 95.0, "OverTemperature"),
        (FaultKind.BUS_OFF, None, 0.0, "BusOff"),
    ],
)
def test_errors_heat_and_bus_off_stop_the_arm(cell, kind, motor, magnitude, event):
    track(cell, 0.2)
    inject(cell, kind, motor, magnitude=magnitude)
    cell.clock.sleep(0.05)
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


@pytest.mark.parametrize("factor", [math.nan, 0.0, -1.0, 0.5, 2.0])
def test_impossible_motor_ranges_refuse_the_start(factor):
    with SimulatedCell(faults=[Fault(FaultKind.WRONG_RANGES, 5, magnitude=factor)]) as cell:
        with pytest.raises(RangeError, match="motor 5"):
            cell.arm.connect()
        assert not cell.arm.is_connected


def test_a_silent_arm_and_a_pose_outside_the_limits_refuse_the_start():
    with (
        SimulatedCell(faults=[Fault(FaultKind.SILENT_MOTOR, 3)]) as cell,
        pytest.raises(NoAnswerError, match="motor 3"),
    ):
        cell.arm.connect()
    outside = np.array([0.0, -1.2, 1.3, 0.0, 2.0, 0.0])
    with SimulatedCell(q=outside) as cell, pytest.raises(StartRefusedError, match="joint5"):
        cell.arm.connect()


def test_close_leaves_the_motors_without_torque_and_may_be_called_twice(cell):
    track(cell, 0.3)
    cell.arm.close()
    cell.arm.close()
    cell.clock.sleep(0.02)
    for i, motor in cell.simulation.motors.items():
        assert motor.commanded is None
        assert motor.enabled == (i <= 3)
    kp = cell.simulation.plant.model.actuator_biasprm[:, 1]
    np.testing.assert_array_equal(kp, 0.0)
    assert cell.arm.statistics().ticks > 0
    with pytest.raises(NotConnectedError):
        cell.arm.read()


def test_the_arm_can_be_connected_again():
    with SimulatedCell(settings=QUICK) as cell:
        for _ in range(2):
            cell.arm.connect()
            assert track(cell, 0.2)[-1].status is CommandStatus.ACCEPTED
            cell.arm.close()


def test_an_exception_in_the_caller_s_block_closes_the_arm():
    with SimulatedCell(settings=QUICK) as cell:
        with pytest.raises(TypeError), cell.arm:
            track(cell, "not a time")
        assert not cell.arm.is_connected
        assert not cell.simulation.motors[4].enabled


def test_the_same_seed_gives_the_same_frames():
    def frames():
        with SimulatedCell(settings=QUICK, seed=7) as cell:
            witness = open_bus("virtual", cell.arm.channel)
            cell.arm.connect()
            track(cell, 0.5)
            seen = []
            while (message := witness.recv(0.0)) is not None:
                seen.append((message.arbitration_id, bytes(message.data)))
            witness.shutdown()
            return seen

    first = frames()
    assert len(first) > 1000
    assert first == frames()


@pytest.mark.parametrize("tool", [Tool.NONE, Tool.E2B])
def test_arms_without_a_g2_have_no_gripper(tool):
    with SimulatedCell(settings=QUICK, tool=tool) as cell:
        cell.arm.connect()
        assert cell.arm.command(cell.arm.read().q, gripper=0.02).status is CommandStatus.ACCEPTED
        assert cell.arm.read().gripper is None


def test_two_arms_run_side_by_side():
    clock = SimulatedClock()
    with SimulatedCell(clock, settings=QUICK) as left, SimulatedCell(clock, settings=QUICK, seed=1) as right:
        left.arm.connect()
        right.arm.connect()
        before = right.arm.read().q
        track(left, 0.5)
        np.testing.assert_allclose(right.arm.read().q, before, atol=2e-3)


def test_a_failing_bus_stops_the_loop_in_real_time():
    with SimulatedCell(RealClock(), settings=QUICK) as cell:
        cell.arm.connect()
        cell.arm._bus.shutdown()
        for _ in range(100):
            cell.clock.sleep(0.02)
            if cell.arm.mode is ArmMode.STOPPED:
                break
        assert cell.arm.mode is ArmMode.STOPPED
        cell.arm.close()


def test_real_time_smoke():
    before = threading.active_count()
    with SimulatedCell(RealClock(), settings=QUICK) as cell:
        with cell.arm:
            results = track(cell, 0.6)
            assert results
            state = cell.arm.read()
            assert np.all(np.isfinite(state.q))
            assert cell.arm.statistics().ticks > 5
        assert not cell.simulation.emergency_stopped
    assert threading.active_count() == before


SIGNALLED = """
import atexit, os, signal, sys, threading, time
from robot_adapters.airbot.cell import SimulatedCell
from robot_adapters.clock import RealClock
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell has it ignored
cell = SimulatedCell(RealClock(), handle_signals=True)

def tell():
    state = [cell.simulation.motors[i].enabled for i in (4, 5, 6, 7)]
    sys.stdout.write("released" if not any(state) and not cell.arm.is_connected else "still on")

atexit.register(tell)
cell.arm.connect()
threading.Timer(0.3, os.kill, (os.getpid(), signal.{name})).start()
for _ in range(5000):
    cell.arm.command(cell.arm.read().q)
    time.sleep(0.02)
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_signals_leave_the_motors_safe_without_anybody_closing_the_arm(name):
    done = subprocess.run(
        [sys.executable, "-c", SIGNALLED.format(name=name)], capture_output=True, text=True, timeout=300
    )
    assert done.stdout == "released", done.stderr
    assert done.returncode != 0


def test_an_arm_that_is_let_down_refuses_targets(cell):
    q = cell.arm.read().q
    cell.arm._running().end()
    result = cell.arm.command(q)
    assert (result.status, names(result.events)) == (CommandStatus.REFUSED, ["ArmStopped"])


def test_a_bus_that_cannot_be_opened_names_the_remedy():
    with pytest.raises(BusError, match="ip link"):
        AirbotArm("socketcan", "can99").connect()
    with pytest.raises(BusError, match="channel"):
        open_bus("slcan")


def test_a_tick_that_comes_late_does_not_catch_up_in_one_step(cell):
    q = cell.arm.read().q
    loop = cell.arm._running()
    for _ in range(4):
        cell.arm.command(q + 0.1)
        cell.clock.sleep(0.05)
    cell.arm._schedule.cancel()
    for step in range(2, 5):
        # The control thread starves while targets come.
        cell.arm.command(q + 0.1 * step)
        cell.clock.sleep(0.05)
    cell.arm._schedule = cell.clock.every(0.004, loop.tick)
    cell.clock.sleep(0.2)
    assert cell.listener.largest_step <= 0.101


def test_unknown_frames_are_counted_and_harmless(cell):
    stranger = open_bus("virtual", cell.arm.channel)
    random = np.random.default_rng(0)
    for _ in range(300):
        data = random.bytes(int(random.integers(0, 9)))
        stranger.send(
            can.Message(arbitration_id=int(random.integers(0x10, 0x700)), data=data, is_extended_id=False)
        )
    track(cell, 0.3)
    stranger.shutdown()
    assert cell.arm.mode is ArmMode.TRACKING
    assert cell.arm.statistics().frames_unknown > 0


def test_a_motor_that_disables_itself_is_a_fault(cell):
    stranger = open_bus("virtual", cell.arm.channel)
    stranger.send(DmMotor(5).lifecycle(DmLifecycle.DISABLE))
    cell.clock.sleep(0.1)
    stranger.shutdown()
    assert cell.arm.mode is ArmMode.STOPPED
    assert names(cell.arm.events()) == ["MotorFault"]
