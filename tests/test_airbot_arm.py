"""The driver and the simulated arm: start-up, following, and an end that leaves the motors safe."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from driver_cell import QUICK, SlowMotion, connected_cell, track

pytest.importorskip("mujoco")

from robot_adapters.airbot.arm import AirbotArm, NotConnectedError, StartRefusedError
from robot_adapters.airbot.protocol import DmMotor, DmRegister, Tool
from robot_adapters.airbot.settings import AirbotSettings
from robot_adapters.airbot.startup import RangeError, identify
from robot_adapters.arm import ArmMode
from robot_adapters.can.bus import BusError, NoAnswerError, open_bus
from robot_adapters.clock import SimulatedClock
from robot_adapters.safety import CommandStatus
from robot_adapters.simulation.cell import SimulatedCell
from robot_adapters.simulation.faults import Fault, FaultKind
from robot_adapters.simulation.plant import PlantParameters


@pytest.fixture
def cell():
    with connected_cell() as cell:
        yield cell


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
                steps.append(f"{DmRegister(request.register).name} {request.data[0]}")
            elif codec.decode_mit(message) is not None:
                steps.append("command")
        witness.shutdown()
        assert steps[: steps.index("command")] == [
            "DISABLE",
            "TIMEOUT 16",  # the low byte of 10,000 ticks
            "CLEAR_ERROR",
            "ENABLE",
            "CONTROL_MODE 1",
        ]
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


@pytest.mark.parametrize("factor", [math.nan, 0.0, -1.0, 0.5, 0.7, 0.99, 1.4, 2.0])
def test_ranges_that_are_not_the_motors_refuse_the_start(factor):
    with SimulatedCell(faults=[Fault(FaultKind.WRONG_RANGES, 5, magnitude=factor)]) as cell:
        with pytest.raises(
            RangeError, match=r"motor 5 reports pos_max = .* in register 0x15, .* 12\.5; write"
        ):
            cell.arm.connect()
        assert not cell.arm.is_connected


def test_a_motor_of_another_type_is_accepted_when_its_ranges_are_named():
    ranges = {5: (25.0, 60.0, 20.0)}
    fault = Fault(FaultKind.WRONG_RANGES, 5, magnitude=2.0)
    with SimulatedCell(faults=[fault], settings=AirbotSettings(motor_ranges=ranges)) as cell:
        identity = identify(open_bus("virtual", cell.arm.channel), cell.clock, cell.arm.settings)
        assert identity.motors[4].motor.position_range.high == 25.0


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


def test_real_time_smoke():
    before = threading.active_count()
    with SimulatedCell(SlowMotion(), settings=QUICK) as cell:
        with cell.arm:
            results = track(cell, 0.1)
            assert results
            state = cell.arm.read()
            assert np.all(np.isfinite(state.q))
            assert cell.arm.statistics().ticks > 5
        assert not cell.simulation.emergency_stopped
    assert threading.active_count() == before


SIGNALLED = """
import atexit, os, signal, sys, threading, time
from robot_adapters.simulation.cell import SimulatedCell
from driver_cell import QUICK, SlowMotion
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell has it ignored
cell = SimulatedCell(SlowMotion(), settings=QUICK, handle_signals=True)

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
        [sys.executable, "-c", SIGNALLED.format(name=name)],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.stdout == "released", done.stderr
    assert done.returncode != 0


def test_a_bus_that_cannot_be_opened_names_the_remedy():
    with pytest.raises(BusError, match="ip link"):
        AirbotArm("socketcan", "can99").connect()
    with pytest.raises(BusError, match="channel"):
        open_bus("slcan")
