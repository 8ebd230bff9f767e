"""False feedback moves nothing and is noticed in time; true motion, loads and obstacles raise no alarm.

`MIMICIK_WITNESS_SECONDS` asks for longer motion without an alarm.
"""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest
from driver_cell import QUICK, connected_cell, names
from test_airbot_identification import DESCRIPTION, load

pytest.importorskip("mujoco")

from robot_adapters.airbot.protocol import DmLifecycle, DmMotor
from robot_adapters.arm import ArmMode
from robot_adapters.can.bus import open_bus
from robot_adapters.can.gravity import GravityModel
from robot_adapters.can.witness import MotionWitness, TorqueWitness
from robot_adapters.safety import CommandStatus
from robot_adapters.simulation.campaign import run_campaign
from robot_adapters.simulation.cell import SimulatedCell
from robot_adapters.simulation.faults import SENSOR_FAULTS, Fault, FaultKind
from robot_adapters.simulation.plant import PlantParameters

SECONDS = float(os.environ.get("MIMICIK_WITNESS_SECONDS", "3"))
LOADED = dataclasses.replace(PlantParameters(), payload=1.0)
TICK = 0.004


@pytest.fixture
def cell():
    with connected_cell() as cell:
        yield cell


def drive(cell, seconds, *, amplitude=0.25, speed=1.2, until_stopped=False):
    """Track a sine; the events of the control loop with their times after the start [s].

    After an event the listener takes every command that moves for a violation.
    """
    home, start, seen = cell.arm.target(), cell.clock.monotonic(), []
    while (t := cell.clock.monotonic() - start) < seconds - 1e-6:
        result = cell.arm.command(home + amplitude * np.sin(speed * t))
        if result.status is not CommandStatus.REFUSED:
            cell.listener.expect_motion()
        for _ in range(10):
            cell.clock.sleep(0.005)
            events = cell.arm.events()
            if events:
                cell.listener.expect_stillness()
            seen += [(cell.clock.monotonic() - start, event) for event in events]
    cell.listener.expect_motion()
    return seen


def strike(cell, kind, joint, magnitude=1.0):
    cell.simulation.faults.faults.append(Fault(kind, joint, cell.clock.monotonic(), magnitude=magnitude))


@pytest.mark.parametrize("parameters", [PlantParameters(), LOADED, PlantParameters().without_lag()])
def test_nothing_is_wrong_with_an_arm_that_moves_carries_or_has_no_lag(parameters):
    with SimulatedCell(listen=True, settings=QUICK, parameters=parameters) as cell:
        cell.arm.connect()
        assert drive(cell, SECONDS, amplitude=0.4, speed=2.5) == []
        assert cell.arm.mode is ArmMode.TRACKING


@pytest.mark.parametrize("joint", [2, 5])
@pytest.mark.parametrize(
    ("kind", "magnitude"),
    [
        (FaultKind.STUCK_ENCODER, 1.0),
        (FaultKind.JUMPED_ENCODER, 0.7),
        (FaultKind.SATURATED_ENCODER, -1.0),
        (FaultKind.DRIFTING_ENCODER, 0.15),
        (FaultKind.FLIPPED_SIGN, 1.0),
        (FaultKind.SLIPPED_ZERO, -0.3),
        (FaultKind.LYING_VELOCITY, 0.3),
    ],
)
def test_false_feedback_stops_the_arm_in_half_a_second_and_moves_nothing(cell, joint, kind, magnitude):
    drive(cell, 0.6)
    strike(cell, kind, joint, magnitude)
    seen = drive(cell, 0.8)
    assert names(event for _, event in seen) == ["SensorFault"]
    assert seen[0][0] < 0.5
    assert f"joint{joint} reads" in seen[0][1].detail
    assert cell.arm.mode is ArmMode.STOPPED
    rest = cell.simulation.q
    cell.clock.sleep(0.5)
    # What is left of the commands under way, and for the joint without stiffness what gravity compensation leaves.
    assert np.max(np.abs(cell.simulation.q - rest)) < 0.03


@pytest.mark.parametrize(
    ("kind", "magnitude"), [(FaultKind.DRIFTING_ENCODER, 0.15), (FaultKind.DRIFTING_ENCODER, -0.15)]
)
def test_a_fast_arm_hides_no_drift(cell, kind, magnitude):
    drive(cell, 0.6, amplitude=0.3, speed=6.0)
    strike(cell, kind, 2, magnitude)
    (when, event), *_ = drive(cell, 0.6, amplitude=0.3, speed=6.0)
    assert (event.name, when < 0.5) == ("SensorFault", True)


@pytest.mark.parametrize(
    ("kind", "magnitude"), [(FaultKind.DRIFTING_ENCODER, 0.15), (FaultKind.SLIPPED_ZERO, 0.3)]
)
@pytest.mark.parametrize(
    "bus",
    [
        [Fault(FaultKind.DELAYED, None, rate=0.5, magnitude=0.02)],
        [Fault(FaultKind.DROPPED, None, rate=0.1)],
        [Fault(FaultKind.DUPLICATED, None, rate=0.5)],
    ],
    ids=["delayed", "dropped", "duplicated"],
)
def test_frames_that_come_unsteadily_hide_little(cell, bus, kind, magnitude):
    cell.simulation.faults.faults += bus
    drive(cell, 0.6)
    strike(cell, kind, 2, magnitude)
    (when, event), *_ = drive(cell, 0.6)
    assert (event.name, when < 0.5) == ("SensorFault", True)


@pytest.mark.parametrize(
    ("kind", "magnitude"), [(FaultKind.DRIFTING_ENCODER, -0.15), (FaultKind.SLIPPED_ZERO, 0.3)]
)
def test_an_arm_that_has_just_been_connected_is_watched(cell, kind, magnitude):
    strike(cell, kind, 2, magnitude)
    (when, event), *_ = drive(cell, 0.5, speed=3.0)
    assert (event.name, when < 0.4) == ("SensorFault", True)


def test_a_jump_between_start_up_and_the_first_frame_is_seen():
    witness = MotionWitness("joint1", -3.0, 3.0, position=0.0, now=0.0)
    assert not any(frames(witness, [0.4] * 5, start=TICK))
    assert "joint1 reads 0.400 rad, 0.400 rad from its angle 4 ms before" in witness.objection


@pytest.mark.parametrize("joint", [1, 5])
def test_an_encoder_at_the_end_of_its_code_moves_no_joint_of_an_arm_at_rest(cell, joint):
    # It was believed after 32 ms, and holding "where the arm stands" drove the joint to its limit.
    before = cell.simulation.q
    strike(cell, FaultKind.SATURATED_ENCODER, joint, -1.0)
    for _ in range(20):
        cell.arm.command(cell.arm.target())
        cell.clock.sleep(0.05)
    assert cell.arm.mode is ArmMode.STOPPED
    np.testing.assert_allclose(cell.simulation.q, before, atol=0.02)


def test_a_zero_that_somebody_sets_stops_the_arm(cell):
    stranger = open_bus("virtual", cell.arm.channel)
    before = cell.simulation.q
    stranger.send(DmMotor(4).lifecycle(DmLifecycle.SET_ZERO))
    cell.clock.sleep(0.5)
    stranger.shutdown()
    assert cell.arm.mode is ArmMode.STOPPED
    assert names(cell.arm.events()) == ["ForeignMaster"]
    # The motor drove the joint towards its new zero, 1.57 rad away, until it was braked.
    np.testing.assert_allclose(cell.simulation.q, before, atol=0.4)


@pytest.mark.parametrize("parameters", [PlantParameters(), LOADED])
def test_a_blocked_joint_yields_where_it_stands(parameters):
    with SimulatedCell(listen=True, settings=QUICK, parameters=parameters) as cell:
        cell.arm.connect()
        cell.simulation.plant.model.dof_frictionloss[1] = 1e3
        target, seen = cell.arm.target(), []
        while not seen:
            target[1] -= 0.05
            cell.arm.command(target)
            cell.clock.sleep(0.05)
            seen = names(cell.arm.events())
        assert (seen, cell.arm.mode) == (["FollowingError"], ArmMode.HOLD)
        # The simulated friction creeps.
        assert cell.arm.target()[1] == pytest.approx(cell.simulation.q[1], abs=0.05)


def test_a_pushed_arm_is_not_taken_for_a_broken_one(cell):
    drive(cell, 0.3, amplitude=0.0)
    cell.simulation.plant.data.qfrc_applied[0] = 15.0
    assert drive(cell, 0.6, amplitude=0.0) == []
    assert cell.arm.read().q[0] > 0.05
    cell.simulation.plant.data.qfrc_applied[0] = 0.0
    assert drive(cell, 0.6, amplitude=0.0) == []


def test_a_hold_keeps_the_command_in_force(cell):
    drive(cell, 0.5, amplitude=0.4, speed=1.5)
    target = cell.arm.target()
    cell.clock.sleep(0.4)
    assert cell.arm.mode is ArmMode.HOLD
    np.testing.assert_allclose(cell.arm.target(), target, atol=1e-9)


@pytest.mark.parametrize("name", ["excitation_a.parquet", "excitation_b.parquet"])
def test_a_real_arm_that_moves_raises_no_alarm_and_one_with_false_angles_does(name):
    log = load(name)
    assert alarms(log, log.q) == {}
    moving = int(np.argmax(np.ptp(log.q, axis=0)))
    wrong = log.q.copy()
    half = len(wrong) // 2
    wrong[half:, moving] += 0.15 * (log.time[half:] - log.time[half])
    when = alarms(log, wrong)[moving]
    assert 0.0 < when - log.time[half] < 0.8


@pytest.mark.parametrize("name", ["excitation_a.parquet", "excitation_b.parquet"])
def test_torques_of_a_real_arm_tell_the_commands_that_it_was_sent_within_25_mrad(name):
    log = load(name)
    kp, kd = np.array(QUICK.kp), np.array(QUICK.kd)
    witness = TorqueWitness(DESCRIPTION.joint_names, log.q[0], [30.0] * 3 + [10.0] * 3, QUICK.lag)
    feed_forward = np.array(PlantParameters().torque_factors) * [
        GravityModel(DESCRIPTION).torques(q) for q in log.q
    ]
    acted_on = log.q[1:] + (log.torque[1:] - feed_forward[:-1] + kd * log.dq[1:]) / kp
    expected = []
    for i, now in enumerate(log.time[1:], 1):
        witness.command(log.q_commanded[i - 1], log.dq_commanded[i - 1], feed_forward[i - 1], kp, kd)
        witness.judge(now, log.q[i], log.dq[i], log.torque[i], np.ones(6, bool), np.zeros(6))
        expected.append(witness.expected)
    began = log.time[1:] > log.time[0] + 1.0  # the commands before the log are unknown
    assert np.abs(acted_on - expected)[began].max() < 0.025


def alarms(log, q):
    """When [s] which joint of a recorded arm contradicts its commands."""
    kp, kd = np.array(QUICK.kp), np.array(QUICK.kd)
    gravity, factors = GravityModel(DESCRIPTION), np.array(PlantParameters().torque_factors)
    witness = TorqueWitness(DESCRIPTION.joint_names, log.q[0], [30.0] * 3 + [10.0] * 3, QUICK.lag)
    motions = [MotionWitness(f"joint{joint}", -4.0, 4.0) for joint in range(6)]
    found = {}
    for i, now in enumerate(log.time):
        fresh = np.array([m.believes(a, v, now) for m, a, v in zip(motions, q[i], log.dq[i], strict=True)])
        late = np.array([motion.lateness(now) for motion in motions])
        for joint in witness.judge(now, q[i], log.dq[i], log.torque[i], fresh, late):
            found.setdefault(joint, now)
        for joint, motion in enumerate(motions):
            if motion.objection:
                found.setdefault(joint, now)
        witness.command(log.q_commanded[i], log.dq_commanded[i], factors * gravity.torques(log.q[i]), kp, kd)
    return found


def frames(witness, positions, velocity=0.0, start=0.0):
    return [witness.believes(p, velocity, start + TICK * i) for i, p in enumerate(positions)]


def test_damaged_frames_are_left_out_and_what_lasts_is_objected_to():
    witness = MotionWitness("joint1", -3.0, 3.0)
    assert frames(witness, [0.0, 0.0, 1.0, 0.0, -1.7, 2.0, 0.0]) == [
        True,
        True,
        False,
        True,
        False,
        False,
        True,
    ]
    assert witness.objection is None
    assert not any(frames(witness, [0.7] * 5, start=7 * TICK))
    assert "joint1 reads 0.700 rad, 0.700 rad from its angle 4 ms before" in witness.objection


def test_after_a_silence_some_frames_that_agree_are_believed():
    witness = MotionWitness("joint1", -3.0, 3.0)
    assert all(frames(witness, [0.0] * 5))
    assert frames(witness, [0.5] * 4, start=0.3) == [False, False, True, True]
    assert not any(frames(witness, [3.2] * 20, start=0.6))
    assert "outside its mechanical range" in witness.objection


@pytest.mark.timeout(0)
def test_sensor_faults_of_the_campaign_end_as_specified():
    report = run_campaign(int(os.environ.get("MIMICIK_FAULTS", "6")), seed=9, kinds=SENSOR_FAULTS)
    assert report.failures == []
