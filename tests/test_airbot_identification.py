"""The simulated arm moves like the real one: identified on one log, checked on another, over the bus."""

from __future__ import annotations

import numpy as np
import pytest
from airbot_data import airbot_data

from lerobot_mimicik.kinematics.arms import describe_arm

pytest.importorskip("mujoco")

from robot_adapters.airbot.protocol import DmLifecycle, MotorFeedback
from robot_adapters.can.bus import open_bus
from robot_adapters.can.gravity import GravityModel
from robot_adapters.clock import SimulatedClock
from robot_adapters.simulation.identification import MotionLog, follow, identify, tracking
from robot_adapters.simulation.plant import PlantParameters
from robot_adapters.simulation.simulated_arm import SimulatedArm

DESCRIPTION = describe_arm("airbot_play")


def load(name: str) -> MotionLog:
    path = airbot_data(name)
    if path is None:
        pytest.skip(f"the real log {name} is not here")
    table = pytest.importorskip("pyarrow.parquet").read_table(path).to_pydict()
    columns = ("q", "dq", "tau", "q_des", "dq_des")
    values = [np.stack([np.asarray(table[f"{c}{j}"], float) for j in range(1, 7)], axis=1) for c in columns]
    return MotionLog(np.asarray(table["t"], float), *values)


def test_the_default_parameters_are_those_identified_from_a_real_log():
    found = identify(DESCRIPTION, load("excitation_a.parquet"))
    for name in ("friction", "damping", "lag"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(PlantParameters(), name), rtol=0.1, atol=0.01
        )


def test_identification_finds_what_a_simulated_arm_was_given():
    t = np.arange(0.0, 6.0, 0.005)
    phase = np.outer(t, [0.9, 1.1, 1.3, 1.5, 1.7, 1.9])
    q = np.array(DESCRIPTION.home) + 0.3 * np.sin(phase)
    dq = 0.3 * np.gradient(phase, t, axis=0) * np.cos(phase)
    truth = PlantParameters(lag=(0.05, 0.06, 0.07, 0.08, 0.09, 0.1), dead_time=0.02)
    commanded = MotionLog(t, q, dq, np.zeros_like(q), q, dq)
    times, angles = follow(DESCRIPTION, truth, commanded, rate=200.0)
    torques = np.zeros_like(angles)
    log = MotionLog(times, angles, angles, torques, q[: len(times)], dq[: len(times)])
    found = identify(DESCRIPTION, log, PlantParameters(dead_time=0.02))
    np.testing.assert_allclose(found.lag, truth.lag, atol=0.02)


@pytest.mark.parametrize("name", ["excitation_b.parquet"])
def test_over_the_bus_the_arm_follows_a_real_log_within_15_mrad(name):
    log = load(name)
    clock, channel = SimulatedClock(), f"identification-{name}"
    arm_bus, our_bus = open_bus("virtual", channel), open_bus("virtual", channel)
    try:
        simulation = SimulatedArm(arm_bus, clock, q=log.q[0]).start()
        motors = [simulation.motors[i].codec for i in range(1, 7)]
        gravity, factors = GravityModel(DESCRIPTION), np.array(PlantParameters().torque_factors)
        for motor in motors[3:]:
            our_bus.send(motor.lifecycle(DmLifecycle.ENABLE))
            our_bus.send(motor.write(0x0A, 1))
        clock.sleep(0.01)
        measured, start = log.q[0].copy(), clock.monotonic()
        times, angles = [], []
        kp, kd = (100.0,) * 3 + (20.0,) * 3, (3.0,) * 3 + (1.0,) * 3
        while (now := clock.monotonic() - start) < 7.0:
            while (message := our_bus.recv(0.0)) is not None:
                for joint, motor in enumerate(motors):
                    reply = motor.decode(message)
                    if isinstance(reply, MotorFeedback):
                        measured[joint] = reply.position
            times.append(now)
            angles.append(measured.copy())
            torque = factors * gravity.torques(measured)
            for j, motor in enumerate(motors):
                q, dq = (np.interp(now, log.time, x[:, j]) for x in (log.q_commanded, log.dq_commanded))
                our_bus.send(motor.encode_mit(q, dq, torque[j], kp[j], kd[j]))
            clock.sleep(0.004)
    finally:
        arm_bus.shutdown()
        our_bus.shutdown()
    part = log.time < 7.0
    first = MotionLog(
        *(getattr(log, x)[part] for x in ("time", "q", "dq", "torque", "q_commanded", "dq_commanded"))
    )
    result = tracking(first, np.array(times), np.array(angles))
    assert np.all(result.rms < 0.015), result
    assert np.all(np.abs(result.delay[:5]) < 0.04), result
