"""The standard motions pass through the singularities they are named after, and solvers run through them."""

from dataclasses import replace

import numpy as np
import pytest
from evaluation_cases import DampedLeastSquares, Scripted, airbot

from lerobot_mimicik.data.arm_arrays import ArmArrays
from lerobot_mimicik.data.teleoperation.singularities import KINDS, SingularityGauge
from lerobot_mimicik.evaluation.anatomy import (
    OUT_OF_REACH,
    load_commands,
    make_trials,
    run_trials,
    save_commands,
)
from lerobot_mimicik.evaluation.bench_plots import plot_anatomy
from lerobot_mimicik.evaluation.metrics import measure
from lerobot_mimicik.kinematics.arms import describe_arm


@pytest.fixture(scope="module")
def trials():
    return make_trials(airbot().description)


@pytest.mark.parametrize("name", ["airbot_play", "piper"])
def test_each_motion_is_slow_and_meets_its_singularity_alone(name):
    arm = ArmArrays(describe_arm(name))
    gauge = SingularityGauge.for_arm(arm, np.random.default_rng(1))
    found = {trial.name: trial for trial in make_trials(arm.description)}
    assert set(found) == {*KINDS, OUT_OF_REACH}
    for kind in KINDS:
        trajectory = found[kind].trajectory
        assert np.abs(np.diff(trajectory.q, axis=0)).max() < 0.05
        assert (trajectory.q >= arm.lower - 1e-9).all()
        assert (trajectory.q <= arm.upper + 1e-9).all()
        measures = gauge(trajectory.q)
        assert measures[kind].argmin() == pytest.approx(found[kind].worst, abs=21)
        assert measures[kind].min() < 0.02 < 0.1 < measures[kind][0]
        # A target is where the next joints lead.
        np.testing.assert_allclose(trajectory.target[:-1], arm.pose(trajectory.q[1:]), atol=1e-9)


def test_the_last_target_leaves_every_reach_and_comes_back(trials):
    arm = ArmArrays(airbot().description)
    anywhere = arm.pose(np.random.default_rng(3).uniform(arm.lower, arm.upper, (5000, 6)))[:, :3]
    (trial,) = (one for one in trials if one.name == OUT_OF_REACH)
    target = trial.trajectory.target
    distance = np.linalg.norm(anywhere - target[trial.worst, :3], axis=1)
    assert distance.min() > 0.02
    np.testing.assert_allclose(target[-1], target[0], atol=1e-9)


def test_commands_are_kept_and_drawn(trials, tmp_path):
    jump = Scripted(lambda q, target, step: q + (0.7 if step == 30 else 0.0))
    done = {
        name: run_trials(solver, trials)
        for name, solver in (("dls", DampedLeastSquares(airbot())), ("jump", jump))
    }
    for name, rollouts in done.items():
        save_commands(tmp_path / f"{name}.npz", rollouts)
    traces = {
        name: measure(airbot(), list(load_commands(tmp_path / f"{name}.npz", trials).values()))
        for name in done
    }
    for name, rollouts in done.items():
        for trace, rollout in zip(traces[name], rollouts.values(), strict=True):
            np.testing.assert_array_equal(trace.rollout.q_curr, rollout.q_curr)
    plots = plot_anatomy(trials, traces, airbot().joint_names)
    assert [plot.title for plot in plots][:1] == ["Through the wrist singularity"]
    assert "jump 0.70 rad" in plots[0].caption
    assert all(plot.save(tmp_path).is_file() for plot in plots)
    with pytest.raises(ValueError, match="not of the motion 'wrist'"):
        load_commands(tmp_path / "dls.npz", _shorter(trials))


def _shorter(trials):

    first = trials[0].trajectory
    return [replace(trials[0], trajectory=replace(first, q=first.q[:5], target=first.target[:5]))]
