"""Local slowing of joint motion."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_mimicik.data.slowing import resample, stretched_clock


def _motion(seed: int, speed: float) -> np.ndarray:
    t = np.arange(60)[:, None] / 20
    return speed * np.sin(2 * np.pi * 0.6 * t + np.random.default_rng(seed).uniform(0, 6, 6))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 100), speed=st.floats(0.1, 3.0))
def test_motion_on_the_stretched_clock_keeps_the_limit_nearly(seed, speed):
    """Splines between frames overshoot a little: the caller checks and stretches again."""
    q = _motion(seed, speed)
    clock = stretched_clock(q, 0.1)
    pose = np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(q), 1))
    _, slowed = resample(pose, q, clock)
    assert (np.diff(clock) > 0).all()
    assert clock[0] == 0
    assert clock[-1] == len(q) - 1
    assert np.abs(np.diff(slowed, axis=0)).max() < 0.105


def test_slow_motion_is_left_alone():
    q = _motion(0, 0.2)
    np.testing.assert_array_equal(stretched_clock(q, 0.1), np.arange(60))


def test_only_the_fast_part_is_slowed():
    q = np.zeros((100, 1))
    q[50:56, 0] = np.linspace(0.2, 1.2, 6)
    q[56:, 0] = 1.2
    clock = stretched_clock(q, 0.1)
    np.testing.assert_allclose(np.diff(clock[:30]), 1.0, atol=0.02)
    assert len(clock) > 106


def test_extra_time_goes_where_it_is_asked_for():
    extra = np.ones(50)
    extra[20:25] = 2.0
    clock = stretched_clock(np.zeros((50, 2)), 0.1, extra)
    assert len(clock) >= 55
    assert np.diff(clock)[22:28].max() < 0.6


def test_resampled_quaternions_are_of_unit_length():
    rng = np.random.default_rng(0)
    pose = np.cumsum(rng.normal(size=(30, 7)) * 0.05, axis=0) + np.array([0, 0, 0, 0, 0, 0, 1.0])
    pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    found, q = resample(pose, rng.normal(size=(30, 6)), np.linspace(0, 29, 77))
    assert (found.shape, q.shape) == ((77, 7), (77, 6))
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:], axis=1), 1.0)
