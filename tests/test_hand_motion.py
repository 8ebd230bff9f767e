"""Hand paths: smooth reaches that arrive, and tremor where tremor is."""

import numpy as np
import pytest

from lerobot_mimicik.data.teleoperation.hand_motion import (
    TREMOR_BAND_HZ,
    Goal,
    HandPath,
    sample_style,
    slow_wave,
    tremor,
)

FPS = 20.0
START = np.array([0.3, 0.0, 0.2, 0.0, 0.0, 0.0])
GOAL = np.array([0.4, -0.1, 0.25, 0.2, 0.0, -0.1])


@pytest.mark.parametrize("seed", range(5))
def test_a_hand_path_starts_and_ends_at_rest_at_its_poses(seed):
    rng = np.random.default_rng(seed)
    path = HandPath(START, sample_style(rng), rng, begin_s=0.5)
    path.move(Goal(GOAL, rest_s=1.0))
    motion = path.sample(np.arange(round((path.now + 0.5) * FPS)) / FPS)
    np.testing.assert_allclose(motion[:10], np.tile(START, (10, 1)), atol=1e-12)
    # Corrections end within 0.2 mm of what they correct.
    np.testing.assert_allclose(motion[-1], GOAL, atol=1e-3)
    np.testing.assert_allclose(motion[-1], motion[-5], atol=1e-12)


def test_a_reach_speeds_up_once_and_slows_down_once_when_nothing_needs_correction():
    rng = np.random.default_rng(0)
    style = sample_style(rng)
    path = HandPath(START, type(style)(**{**vars(style), "correction_rate": 0.0, "curvature": 0.0}), rng)
    path.move(Goal(GOAL, rest_s=0.1))
    speed = np.linalg.norm(np.diff(path.sample(np.arange(0, path.now, 0.01))[:, :3], axis=0), axis=1)
    peak = int(speed.argmax())
    assert np.all(np.diff(speed[: peak + 1]) >= -1e-12)
    assert np.all(np.diff(speed[peak:]) <= 1e-12)


def test_operators_differ_and_the_same_seed_is_the_same_operator():
    styles = [sample_style(np.random.default_rng(seed)) for seed in (1, 1, 2)]
    assert styles[0] == styles[1]
    assert styles[0] != styles[2]


def test_a_path_without_movements_holds_still():
    path = HandPath(START, sample_style(np.random.default_rng(0)), np.random.default_rng(0))
    assert np.array_equal(path.sample(np.arange(4.0)), np.tile(START, (4, 1)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("frames", [101, 400])
def test_tremor_lies_in_its_band_and_has_the_operators_strength(seed, frames):
    rng = np.random.default_rng(seed)
    style = sample_style(rng)
    wave = tremor(style, frames, FPS, rng)
    power = np.abs(np.fft.rfft(wave * np.hanning(frames)[:, None], axis=0)) ** 2
    frequency = np.fft.rfftfreq(frames, 1 / FPS)
    low, high = TREMOR_BAND_HZ
    inside = (frequency >= low - 0.5) & (frequency <= high + 0.5)
    assert power[inside].sum() > 0.99 * power.sum()
    centre = (power.sum(axis=1) * frequency).sum() / power.sum()
    assert centre == pytest.approx(style.tremor_hz, abs=1.0)
    rms = np.sqrt((wave**2).mean(axis=0))
    assert np.all(rms < 1.5 * np.repeat([style.tremor_m, style.tremor_rad], 3))
    assert np.all(rms > 0.5 * np.repeat([style.tremor_m, style.tremor_rad], 3))


def test_slow_waves_are_slow():
    wave = slow_wave((4000, 2), FPS, np.random.default_rng(3))
    power = np.abs(np.fft.rfft(wave, axis=0)) ** 2
    assert power[np.fft.rfftfreq(4000, 1 / FPS) < 0.5].sum() > 0.98 * power.sum()
    np.testing.assert_allclose(np.sqrt((wave**2).mean(axis=0)), 1.0, atol=0.3)
