"""The safety gate lets through only what is finite, inside the limits and near the target before."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robot_adapters.safety import (
    CommandStatus,
    JointLimitViolation,
    JumpViolation,
    NonFiniteCommand,
    SafetyEvent,
    SafetyGate,
    SafetyLimits,
    StepLimitViolation,
    VelocityLimitViolation,
)

NAMES = ("joint1", "joint2", "joint3")
LOWER, UPPER = np.array([-1.0, -2.0, 0.0]), np.array([1.0, 0.5, 3.0])
GATE = SafetyGate(NAMES, LOWER, UPPER)
MIDDLE = np.array([0.0, -1.0, 1.0])

inside = st.tuples(*(st.floats(low, high) for low, high in zip(LOWER, UPPER, strict=True))).map(np.array)


@given(arrays(float, 3, elements=st.floats(allow_nan=True, allow_infinity=True)), inside, st.floats(0.0, 2.0))
def test_what_passes_is_within_every_limit(target, reference, elapsed):
    verdict = GATE.admit(target, reference, elapsed)
    if verdict.q is None:
        assert verdict.status is CommandStatus.REFUSED
        assert verdict.events
        return
    assert np.all(verdict.q >= LOWER - 1e-12)
    assert np.all(verdict.q <= UPPER + 1e-12)
    assert np.max(np.abs(verdict.q - reference)) <= 0.1 + 1e-8
    # What was changed was reported, and what was reported was changed.
    assert (verdict.status is CommandStatus.LIMITED) == bool(verdict.events)
    assert bool(verdict.events) or np.allclose(verdict.q, target, rtol=0, atol=1e-8)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_targets_that_are_not_finite_are_refused(bad):
    verdict = GATE.admit([0.0, bad, 1.0], MIDDLE, 0.05)
    assert [type(event) for event in verdict.events] == [NonFiniteCommand]


def test_a_jump_is_refused_and_a_step_is_limited():
    refused = GATE.admit(MIDDLE + np.array([0.501, 0.0, 0.0]), MIDDLE, 0.05)
    assert [type(event) for event in refused.events] == [JumpViolation]
    limited = GATE.admit(MIDDLE + np.array([0.4, 0.2, 0.0]), MIDDLE, 0.05)
    assert limited.status is CommandStatus.LIMITED
    np.testing.assert_allclose(limited.q - MIDDLE, [0.1, 0.05, 0.0])
    exact = GATE.admit(MIDDLE + np.array([0.1, 0.0, 0.0]), MIDDLE, 0.05)
    assert exact.status is CommandStatus.ACCEPTED


def test_joint_limits_name_the_joint_and_its_range():
    verdict = GATE.admit([0.0, 0.55, 1.0], [0.0, 0.48, 1.0], 0.05)
    assert [type(event) for event in verdict.events] == [JointLimitViolation]
    assert verdict.q[1] == 0.5
    assert "joint2" in verdict.events[0].message
    assert "0.5]" in verdict.events[0].message


def test_fast_targets_share_the_step_of_a_frame():
    q, now = MIDDLE, 0.0
    for _ in range(10):
        verdict = GATE.admit(q + np.array([0.1, 0.0, 0.0]), q, 0.01)
        q, now = verdict.q, now + 0.01
    assert q[0] - MIDDLE[0] <= 1.1 * 2.0 * now


def test_a_velocity_limit_tightens_the_step():
    gate = SafetyGate(NAMES, LOWER, UPPER, SafetyLimits(max_velocity=1.0))
    verdict = gate.admit(MIDDLE + np.array([0.09, 0.0, 0.0]), MIDDLE, 0.05)
    assert [type(event) for event in verdict.events] == [VelocityLimitViolation]
    assert verdict.q[0] == pytest.approx(0.05)
    both = gate.admit(MIDDLE + np.array([0.2, 0.0, 0.0]), MIDDLE, 0.05)
    assert [type(event) for event in both.events] == [StepLimitViolation, VelocityLimitViolation]
    assert both.q[0] == pytest.approx(0.05)


@pytest.mark.parametrize(
    "looser", [{"max_step": 0.2}, {"refuse_step": 1.0}, {"target_timeout": 1.0}, {"max_velocity": math.inf}]
)
def test_limits_cannot_be_loosened(looser):
    with pytest.raises(ValueError, match=next(iter(looser))):
        SafetyLimits(**looser)


def test_every_event_has_a_remedy():
    kinds = SafetyEvent.__subclasses__()
    assert len(kinds) >= 12
    for kind in kinds:
        event = kind("what happened")
        assert kind.remedy
        assert event.name == kind.__name__
        assert kind.remedy in event.message


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match="joint1"):
        GATE.admit([0.0, 0.0], MIDDLE, 0.05)
    with pytest.raises(ValueError, match="lower"):
        SafetyGate(NAMES, UPPER, LOWER)
