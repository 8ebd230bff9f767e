"""Faults end as specified and nothing grows; `MIMICIK_FAULTS` and `MIMICIK_SOAK_SECONDS` ask for the full
counts, `MIMICIK_FAULT_SEED` for other cases: a campaign of 1,000 may be run as ten seeds of 100, a case takes
about 0.8 s.
"""

from __future__ import annotations

import os

import numpy as np
import pytest

pytest.importorskip("mujoco")

from robot_adapters.airbot.protocol import MotorFeedback, OdMotor
from robot_adapters.can.bus import open_bus
from robot_adapters.can.feedback import MotorRecord
from robot_adapters.clock import SimulatedClock
from robot_adapters.safety import SafetyLimits
from robot_adapters.simulation.campaign import FaultOutcome, run_campaign, run_case, specified_outcomes
from robot_adapters.simulation.faults import DISTURBANCES, Fault, FaultKind, random_fault
from robot_adapters.simulation.listener import BusListener
from robot_adapters.simulation.plant import PlantParameters
from robot_adapters.simulation.soak import run_soak

FAULTS = int(os.environ.get("MIMICIK_FAULTS", "9"))
FAULT_SEED = int(os.environ.get("MIMICIK_FAULT_SEED", "5"))
SOAK_SECONDS = float(os.environ.get("MIMICIK_SOAK_SECONDS", "6"))


@pytest.mark.timeout(0)
def test_every_fault_ends_as_specified_and_no_frame_violates_a_limit():
    report = run_campaign(FAULTS, FAULT_SEED)
    assert report.failures == []
    assert report.passed
    assert len(report.cases) == FAULTS
    assert sum(sum(ends.values()) for ends in report.counts.values()) == FAULTS


def test_the_same_seed_gives_the_same_case():
    fault = Fault(FaultKind.CORRUPTED, None, 0.2, 0.06, rate=0.5)
    assert run_case(fault, seed=3) == run_case(fault, seed=3)


@pytest.mark.parametrize(
    ("fault", "outcomes"),
    [
        (Fault(FaultKind.MOTOR_ERROR, 1), {FaultOutcome.STOP}),
        (Fault(FaultKind.WRONG_RANGES, 4), {FaultOutcome.STOP}),
        (Fault(FaultKind.OTHER_MASTER, 4), {FaultOutcome.STOP}),
        (Fault(FaultKind.BUSY_BUS, None), {FaultOutcome.TRACKING}),
        (Fault(FaultKind.FROZEN, None, 0.2, 0.06), {FaultOutcome.TRACKING}),
        (Fault(FaultKind.FROZEN, None, 0.2, 0.4), {FaultOutcome.HOLD}),
        (Fault(FaultKind.FROZEN, None, 0.2, 1.15), {FaultOutcome.STOP}),
        (Fault(FaultKind.DUPLICATED, None, 0.0, 1.0), {FaultOutcome.TRACKING}),
        (Fault(FaultKind.SILENT_MOTOR, 2, 0.0, 0.02), {FaultOutcome.TRACKING}),
        (Fault(FaultKind.SILENT_MOTOR, 2, 0.0, 0.4), {FaultOutcome.HOLD}),
        (Fault(FaultKind.SILENT_MOTOR, 2, 0.0, 1.2), {FaultOutcome.STOP}),
        (Fault(FaultKind.DROPPED, 2, 0.0, 0.4, rate=0.3), {FaultOutcome.TRACKING, FaultOutcome.HOLD}),
    ],
)
def test_what_a_fault_may_lead_to_follows_from_kind_and_length(fault, outcomes):
    assert specified_outcomes(fault) == outcomes


@pytest.mark.parametrize(
    ("seed", "duration", "rate"),
    [(5000049, 0.06, 0.834), (5000445, 0.06, 0.926), (5000558, 0.15, 0.860), (5000594, 0.15, 0.968)],
)
def test_a_storm_of_damaged_frames_is_taken_neither_for_heat_nor_for_motion(seed, duration, rate):
    case = run_case(Fault(FaultKind.CORRUPTED, None, 0.2, duration, rate), seed)
    assert case.complaints == ()


def test_a_joint_whose_angle_drifts_is_not_carried_by_it():
    # Gravity was compensated for where the angle drifted to: the braked joint sank by 0.3 rad.
    assert run_case(Fault(FaultKind.DRIFTING_ENCODER, 2, 0.2, magnitude=0.906), 508001531).complaints == ()


@pytest.mark.parametrize("kind", DISTURBANCES)
def test_what_happens_around_the_arm_ends_as_specified(kind):
    assert run_case(random_fault(np.random.default_rng(1), 0.2, [kind]), seed=1).complaints == ()


def test_trouble_that_changes_its_name_is_trouble_in_the_end():
    limits, record = SafetyLimits(), MotorRecord(OdMotor(1), 0.0)
    for frame in range(40):
        record.update(MotorFeedback(1, 0.0, 0.0, 0.0, 1 + frame % 2, 30, 30), 0.004 * frame, limits)
        assert (record.fault(limits) is not None) == (frame >= 24)


@pytest.mark.timeout(0)
@pytest.mark.parametrize("payload", [0.0, 1.0])
def test_a_soak_grows_nothing_and_raises_no_alarm(payload):
    report = run_soak(SOAK_SECONDS, samples=12, parameters=PlantParameters(payload=payload))
    assert report.statistics.events == {}
    assert len({sample.threads for sample in report.samples}) == 1
    assert max(sample.unread for sample in report.samples) <= 14
    assert report.object_growth < 2000
    assert report.memory_growth < 16 * 2**20
    assert report.violations == report.warnings == 0
    assert report.statistics.targets_refused == report.statistics.send_errors == 0


def test_the_listener_sees_violations():
    bus = open_bus("virtual", "listener")
    listener = BusListener(bus, SimulatedClock(), [-1.0] * 6, [1.0] * 6)
    motor = OdMotor(2)
    listener.judge(motor.encode_mit(0.0, 0.0, 0.0, 100.0, 3.0), 0.0)
    listener.judge(motor.encode_mit(0.09, 0.0, 0.0, 100.0, 3.0), 0.02)
    assert listener.violations == []
    listener.judge(motor.encode_mit(0.12, 0.0, 0.0, 100.0, 3.0), 0.03)
    assert "step" in listener.violations.pop()
    listener.judge(motor.encode_mit(1.05, 0.0, 0.0, 100.0, 3.0), 5.0)
    assert any("outside the joint limits" in sentence for sentence in listener.violations)
    listener.violations.clear()
    listener.judge(motor.encode_mit(1.0, 0.0, 0.0, 500.0, 3.0), 5.01)
    assert "gains" in listener.violations.pop()
    bus.shutdown()
