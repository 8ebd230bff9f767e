"""Metrics on cases that can be computed by hand."""

import numpy as np
import pytest
import torch
from evaluation_cases import airbot

from lerobot_mimicik.evaluation.metrics import jerk_of, measure, summarise
from lerobot_mimicik.evaluation.rollouts import Rollout
from lerobot_mimicik.evaluation.trajectories import Trajectory

HOME = np.array(airbot().description.home)
DOF = airbot().dof


def rollout(q_cmd, q_curr=None, offset_mm=None, turn_deg=0.0, asked=None):
    """Commands (T, dof) whose targets lie `offset_mm` (T,) along x from where they lead."""
    q_cmd = np.asarray(q_cmd, dtype=float)
    q_curr = q_cmd if q_curr is None else np.asarray(q_curr, dtype=float)
    reachable = np.where(np.isfinite(q_cmd), q_cmd, HOME)
    target = airbot().forward(torch.from_numpy(reachable)).numpy()
    if offset_mm is not None:
        target[:, 0] += np.asarray(offset_mm) / 1e3
    half = np.radians(turn_deg) / 2
    x, y, z, w = target[:, 3:].T
    c, s = np.cos(half), np.sin(half)
    # The target is turned about the base's z axis.
    target[:, 3:] = np.stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z], axis=1)
    trajectory = Trajectory(0, np.nan_to_num(q_curr), target)
    return Rollout(trajectory, q_curr, q_cmd, len(q_cmd) if asked is None else asked)


def test_errors_and_success_rates_count_frames():
    offsets = [0.5, 0.5, 3.0, 7.0, 20.0]
    row = summarise(measure(airbot(), [rollout(np.tile(HOME, (5, 1)), offset_mm=offsets, turn_deg=2.0)]))
    assert row["mean_mm"] == pytest.approx(6.2)
    assert row["max_mm"] == pytest.approx(20.0)
    assert row["p95_mm"] == pytest.approx(np.percentile(offsets, 95))
    assert row["rot_mean_deg"] == pytest.approx(2.0)
    assert (row["sr1"], row["sr5"], row["sr10"]) == pytest.approx((40.0, 60.0, 80.0))
    assert row["cartesian_spike"] == pytest.approx(20.0)


def test_the_cartesian_spike_rate_is_what_sr10_leaves():
    generator = np.random.default_rng(1)
    for scale in (1.0, 10.0, 100.0):
        still = np.tile(HOME, (50, 1))
        rollouts = [rollout(still, offset_mm=scale * generator.random(50)) for _ in range(3)]
        row = summarise(measure(airbot(), rollouts))
        assert row["cartesian_spike"] == 100.0 - row["sr10"]
        assert row["sr1"] <= row["sr5"] <= row["sr10"]


def test_a_target_reached_exactly_is_a_success():
    row = summarise(measure(airbot(), [rollout(np.tile(HOME, (4, 1)))]))
    assert row["mean_mm"] == pytest.approx(0.0, abs=1e-9)
    assert row["sr1"] == 100.0


def test_a_bound_kept_to_rounding_is_kept():
    start = np.tile(HOME, (3, 1))
    commands = start + np.array([[0.1 + 1e-9], [0.1], [0.1001]])
    row = summarise(measure(airbot(), [rollout(commands, q_curr=start)]))
    assert row["joint_spike"] == pytest.approx(100 / 3)


def test_joint_steps_are_measured_from_what_the_solver_was_told():
    q_curr = np.tile(HOME, (4, 1))
    q_cmd = q_curr.copy()
    q_cmd[:, 2] += [0.05, -0.2, 0.6, 0.0]
    row = summarise(measure(airbot(), [rollout(q_cmd, q_curr)]))
    assert row["joint_spike"] == pytest.approx(50.0)
    assert row["estop"] == pytest.approx(25.0)
    assert row["max_dq"] == pytest.approx(0.6)


def test_limits_count_frames_beyond_the_tolerance():
    q = np.tile(HOME, (4, 1))
    upper = airbot().upper.numpy()
    q[1, 0] = upper[0]
    q[2, 0] = upper[0] + 1e-4
    q[3, 0], q[3, 1] = upper[0] + 0.1, upper[1] + 0.1
    assert summarise(measure(airbot(), [rollout(q)]))["limit_violations"] == pytest.approx(50.0)


def test_jerk_is_the_third_difference_and_never_crosses_trajectories():
    t = np.arange(8.0)[:, None]
    cubic = np.tile(1e-3 * t**3, (1, DOF))
    assert jerk_of(cubic) == pytest.approx(6e-3)
    quadratic = np.tile(1e-3 * t**2, (1, DOF))
    apart = summarise(measure(airbot(), [rollout(HOME + quadratic), rollout(HOME - quadratic)]))
    assert apart["jerk"] == pytest.approx(0.0, abs=1e-12)


def test_a_trajectory_too_short_for_jerk_has_none():
    assert summarise(measure(airbot(), [rollout(np.tile(HOME, (3, 1)))]))["jerk"] is None


def test_a_non_finite_command_is_counted_and_leaves_the_means_alone():
    q = np.tile(HOME, (4, 1))
    q[1, 3] = np.inf
    q[2:] = np.nan
    row = summarise(measure(airbot(), [rollout(q, np.tile(HOME, (4, 1)), offset_mm=[2.0] * 4, asked=2)]))
    assert row["nonfinite"] == 1
    assert row["mean_mm"] == pytest.approx(2.0)
    assert row["sr10"] == pytest.approx(25.0)
    assert row["estop"] == pytest.approx(25.0)
    assert row["max_dq"] == 0.0


def test_nothing_finite_means_no_mean():
    q = np.full((3, DOF), np.nan)
    row = summarise(measure(airbot(), [rollout(q, np.tile(HOME, (3, 1)), asked=1)]))
    assert row["mean_mm"] is None
    assert row["max_dq"] is None
    assert row["sr10"] == 0.0


def test_no_trajectory_is_an_error():
    with pytest.raises(ValueError, match="no trajectory"):
        summarise([])
