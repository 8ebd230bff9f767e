"""The setpoint between targets: it arrives when the next one comes, never jumps and never exceeds its speed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_adapters.can.interpolation import Interpolator

TICK = 0.004


@pytest.mark.parametrize("rate", [20.0, 50.0])
def test_at_a_steady_rate_the_setpoint_arrives_as_the_next_target_comes(rate):
    setpoint, period = Interpolator([0.0, 1.0], 5.0), 1.0 / rate
    for step in range(40):
        setpoint.aim([0.01 * step, 1.0 - 0.02 * step], step * period)
    before, velocity = setpoint.sample(39.5 * period)
    assert before == pytest.approx([0.385, 0.23], abs=1e-5)
    assert velocity == pytest.approx([0.01 * rate, -0.02 * rate], rel=1e-3)
    assert setpoint.sample(40 * period)[0] == pytest.approx([0.39, 0.22], abs=1e-6)


@settings(max_examples=30)
@given(
    st.lists(st.tuples(st.floats(-3, 3), st.floats(0.001, 0.3), st.booleans()), min_size=1, max_size=12),
    st.floats(0.1, 10.0),
)
def test_whatever_targets_come_the_setpoint_moves_steadily_and_no_faster_than_allowed(targets, speed):
    setpoint, now, before = Interpolator([0.0], speed), 0.0, 0.0
    for target, pause, settle in targets:
        (setpoint.settle if settle else setpoint.aim)([target], now)
        for _ in range(int(pause / TICK) + 1):
            now += TICK
            (position,), (velocity,) = setpoint.sample(now)
            assert abs(position - before) <= speed * TICK + 1e-9
            assert abs(velocity) <= speed + 1e-9
            before = position
    assert setpoint.sample(now + 6.0 / speed + 1.0)[0] == pytest.approx([targets[-1][0]])
    assert setpoint.sample(now + 6.0 / speed + 1.0)[1] == 0.0


def test_all_joints_arrive_together_and_the_callers_array_is_copied():
    setpoint, target = Interpolator([0.0, 0.0], 1.0), np.array([1.0, 0.1])
    setpoint.aim(target, 0.0)
    target[:] = 9.0
    assert setpoint.sample(0.5)[0] == pytest.approx([0.5, 0.05])
    assert setpoint.sample(1.0)[0] == pytest.approx([1.0, 0.1])
