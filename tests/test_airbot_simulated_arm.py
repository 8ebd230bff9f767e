"""The simulated arm behaves on the bus as motors do: enabling, protections, noise, faults, processes."""

from __future__ import annotations

import can
import numpy as np
import pytest
from arm_process import arm_process, follow_for_a_while
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("mujoco")

from robot_adapters.airbot.protocol import DmLifecycle, DmMotor, DmRegister, MotorFeedback, OdMotor
from robot_adapters.can.bus import BusError, ask, open_bus
from robot_adapters.clock import SimulatedClock
from robot_adapters.simulation.faults import Fault, FaultInjector, FaultKind, random_fault
from robot_adapters.simulation.plant import PlantParameters
from robot_adapters.simulation.protection import StepProtection
from robot_adapters.simulation.simulated_arm import SimulatedArm


@pytest.fixture
def bench():
    """A simulated arm, our end of its bus and their clock."""
    clock = SimulatedClock()
    theirs, ours = open_bus("virtual", "bench"), open_bus("virtual", "bench")
    yield SimulatedArm(theirs, clock).start(), ours, clock
    theirs.shutdown()
    ours.shutdown()


def feedback(motor, bus, clock) -> MotorFeedback:
    message = motor.ping() if isinstance(motor, DmMotor) else motor.encode_mit(0.0, 0.0, 0.0, 0.0, 1.0)
    return ask(
        bus, clock, message, lambda m: r if isinstance(r := motor.decode(m), MotorFeedback) else None, "test"
    )


def test_a_dm_motor_follows_commands_only_when_enabled_in_mit_mode(bench):
    arm, bus, clock = bench
    motor, start = DmMotor(6), arm.q[5]
    bus.send(motor.encode_mit(start + 0.05, 0.0, 0.0, 20.0, 1.0))
    clock.sleep(0.01)
    assert arm.motors[6].commanded is None
    assert feedback(motor, bus, clock).error == 0
    bus.send(motor.lifecycle(DmLifecycle.ENABLE))
    bus.send(motor.write(DmRegister.CONTROL_MODE, 1))
    bus.send(motor.encode_mit(start + 0.05, 0.0, 0.0, 20.0, 1.0))
    clock.sleep(0.01)
    assert arm.motors[6].commanded == pytest.approx(start + 0.05, abs=1e-3)
    assert feedback(motor, bus, clock).error == 1


def test_feedback_is_quantised_and_noisy_like_the_real_one(bench):
    arm, bus, clock = bench
    codec = OdMotor(2)
    positions = np.array([feedback(codec, bus, clock).position for _ in range(60)])
    quanta = (positions - positions[0]) / codec.position_range.quantum
    np.testing.assert_allclose(quanta, np.round(quanta), atol=1e-2)
    assert codec.position_range.quantum == pytest.approx(0.381e-3, abs=1e-6)
    assert 0.0 <= positions.std() < 1e-3
    assert abs(positions.mean() - arm.q[1]) < 1e-3


def test_replies_come_within_a_few_milliseconds_and_in_order(bench):
    _, bus, clock = bench
    for i in (1, 2, 3):
        bus.send(OdMotor(i).encode_mit(0.0, 0.0, 0.0, 0.0, 1.0))
    clock.sleep(0.006)
    ids = []
    while (message := bus.recv(0.0)) is not None:
        ids.append(message.arbitration_id)
    assert sorted(ids) == [1, 2, 3]


def test_no_frame_upsets_the_arm(bench):
    arm, bus, clock = bench
    random = np.random.default_rng(0)
    for _ in range(300):
        identifier, data = int(random.integers(0x800)), random.bytes(int(random.integers(9)))
        arm.hear(
            can.Message(arbitration_id=identifier, data=data, is_extended_id=False), arm.clock.monotonic()
        )
    clock.sleep(0.01)
    while bus.recv(0.0) is not None:
        pass
    assert np.isfinite(arm.q).all()
    motor = OdMotor(1)
    bus.send(motor.encode_mit(arm.q[0], 0.0, 0.0, 0.0, 1.0))
    clock.sleep(0.01)
    assert isinstance(motor.decode(bus.recv(0.0)), MotorFeedback), "it answers as before"


@pytest.mark.parametrize(
    ("steps", "warnings", "tripped"),
    [
        ([0.09, 0.18, 0.27], 0, False),
        ([0.12, 0.12, 0.12], 1, False),
        ([0.12, 0.24, 0.36], 3, False),
        ([0.0, 0.55], 0, True),
        ([0.55], 0, True),
    ],
)
def test_protection_warns_above_a_tenth_and_stops_above_half_a_radian(steps, warnings, tripped):
    protection = StepProtection()
    for number, position in enumerate(steps):
        protection.watch(position, 0.0, 1.0 + 0.05 * number)
    assert (protection.warnings, protection.tripped) == (warnings, tripped)


def test_a_jump_on_the_bus_stops_every_motor_with_an_error(bench):
    arm, bus, clock = bench
    motor = OdMotor(1)
    bus.send(motor.encode_mit(arm.q[0] + 0.6, 0.0, 0.0, 100.0, 3.0))
    clock.sleep(0.01)
    assert arm.emergency_stopped
    assert all(m.error for m in arm.motors.values())
    assert feedback(DmMotor(4), bus, clock).error == 14
    clock.sleep(0.2)
    assert abs(arm.q[0]) < 0.01


@given(st.integers(0, 10_000))
@settings(max_examples=200)
def test_random_faults_are_reproducible_and_well_formed(seed):
    first, second = (random_fault(np.random.default_rng(seed), 0.3) for _ in range(2))
    assert repr(first) == repr(second)
    assert 0.0 < first.rate <= 1.0
    assert first.duration > 0.0


def test_frame_faults_drop_delay_double_and_damage():
    message = DmMotor(4).encode_feedback(MotorFeedback(4, 0.1, 0.0, 0.0, 1, 30, 30))
    dropped = FaultInjector([Fault(FaultKind.DROPPED)])
    assert dropped.replies(message, 4, 1.0, 1.0) == []
    assert not dropped.hears(4, 1.0)
    delayed = FaultInjector([Fault(FaultKind.DELAYED, magnitude=0.05)])
    assert delayed.replies(message, 4, 1.0, 1.0) == [(1.05, message)]
    assert len(FaultInjector([Fault(FaultKind.DUPLICATED)]).replies(message, 4, 1.0, 1.0)) == 2
    damaged = FaultInjector([Fault(FaultKind.CORRUPTED, motor_id=4)])
    assert bytes(damaged.replies(message, 4, 1.0, 1.0)[0][1].data) != bytes(message.data)
    assert damaged.replies(message, 5, 1.0, 1.0) == [(1.0, message)]
    over = FaultInjector([Fault(FaultKind.DROPPED, start=0.0, duration=0.5)])
    assert over.hears(4, 1.0)


def test_parameters_that_do_not_fit_the_arm_are_named():
    with pytest.raises(ValueError, match="friction has 2 values for 6 joints"):
        SimulatedArm(
            open_bus("virtual", "bad"), SimulatedClock(), parameters=PlantParameters(friction=(0.1, 0.1))
        )


def test_an_arm_in_another_process_through_udp_multicast():
    pytest.importorskip("msgpack")
    channel = "239.74.163.77"
    try:
        open_bus("udp_multicast", channel).shutdown()
    except BusError as error:
        pytest.skip(f"no multicast here: {error}")
    with arm_process("udp_multicast", channel) as server:
        follow_for_a_while("udp_multicast", channel)
    assert server.returncode == 130
