"""What is measured beside accuracy, on motions whose answer is known."""

import dataclasses

import numpy as np
import pytest
import torch
from evaluation_cases import FPS, airbot, trajectory

from lerobot_mimicik.evaluation.metrics import measure
from lerobot_mimicik.evaluation.motion_metrics import (
    MOTION_KEYS,
    bootstrap,
    collision_depth_mm,
    frozen_frames,
    release_steps,
    return_frames,
    seam_jerk,
    seams,
    summarise_motion,
)
from lerobot_mimicik.evaluation.rollouts import Rollout
from lerobot_mimicik.evaluation.verdict import judge

HOME = np.array(airbot().description.home)


def trace_of(motion, q_cmd=None, **columns):
    """A rollout whose commands are `q_cmd`, or meet the target of `motion` exactly."""
    q_cmd = np.concatenate([motion.q[1:], motion.q[-1:]]) if q_cmd is None else q_cmd
    q_curr = np.concatenate([motion.q[:1], q_cmd[:-1]])
    return measure(airbot(), [Rollout(dataclasses.replace(motion, **columns), q_curr, q_cmd, len(q_cmd))])[0]


def held(motion):
    return np.tile(motion.q[0], (len(motion), 1))


def test_jerk_rms_is_the_third_derivative_whatever_the_frame_rate():
    for fps in (10, 40):
        t = np.arange(60)[:, None] / fps
        q = HOME + 0.05 * t**3 / t.max() ** 3
        motion = dataclasses.replace(trajectory(60), q=q)
        rms = summarise_motion([trace_of(motion, q)], fps)["jerk_rms"]
        assert rms == pytest.approx(6 * 0.05 / t.max() ** 3, rel=1e-6)


def test_frozen_is_holding_still_while_the_target_moves_and_only_then():
    motion = trajectory(40)
    assert frozen_frames(trace_of(motion, held(motion)))[1:].all()
    assert not frozen_frames(trace_of(motion))[:-1].any()  # the last command of `trace_of` repeats
    resting = dataclasses.replace(motion, target=np.tile(motion.target[:1], (40, 1)))
    assert not frozen_frames(trace_of(resting, held(motion))).any()


@pytest.mark.parametrize("frames", [-3, 0, 2, 5])
def test_the_lag_is_what_the_tool_was_delayed_by(frames):
    motion = trajectory(120, speed=0.05)
    q = np.concatenate([motion.q[1:], motion.q[-1:]])[np.clip(np.arange(120) - frames, 0, 119)]
    assert summarise_motion([trace_of(motion, q)], FPS)["lag_ms"] == pytest.approx(1e3 * frames / FPS, abs=5)
    assert summarise_motion([trace_of(motion, held(motion))], FPS)["lag_ms"] is None


def test_the_clean_error_is_against_the_clean_target():
    motion = trajectory(30)
    shaken = motion.target.copy()
    shaken[:, 0] += 2e-3
    row = summarise_motion([trace_of(motion, target=motion.target, clean=shaken)], FPS)
    reference = measure(airbot(), [trace_of(motion, target=shaken).rollout])[0].position_mm
    assert row["clean_mean_mm"] == pytest.approx(reference.mean())
    assert row["clean_max_mm"] == pytest.approx(reference.max())
    assert summarise_motion([trace_of(motion)], FPS)["clean_mean_mm"] is None
    assert set(row) == set(MOTION_KEYS)


def out_and_back(frames=120, pulled_mm=300.0):
    """A target that leaves frame by frame and is back after two thirds; the arm could have stayed where it was."""
    motion = trajectory(frames, speed=0.0)
    target = motion.target.copy()
    away = slice(frames // 3, 2 * frames // 3)
    target[away, 0] += np.linspace(0.05, 1, frames // 3) * pulled_mm / 1e3
    return dataclasses.replace(motion, target=target, closest=motion.target), 2 * frames // 3


def test_out_of_reach_nobody_is_blamed_and_only_the_excess_counts():
    motion, _ = out_and_back()
    at_best = trace_of(motion, held(motion))
    row = summarise_motion([at_best], FPS)
    assert row["excess_percent"] == pytest.approx(0.0, abs=1e-3)
    assert row["unavoidable_mm"] == pytest.approx(1e3 * 0.3 * 0.525, rel=0.05)
    assert row["frozen"] == 0
    assert judge(at_best, [], FPS).verdict == "Bounded"
    blind = dataclasses.replace(motion, closest=None)
    assert judge(trace_of(blind, held(motion)), [], FPS).failure == "frozen"
    off = held(motion) + 0.05
    assert summarise_motion([trace_of(motion, off)], FPS)["excess_percent"] > 0


def test_the_release_step_is_the_largest_within_half_a_second_of_the_return():
    motion, back = out_and_back()
    q = held(motion)
    q[back + 4 :, 1] += 0.07
    q[back + 12 :, 1] += 0.3  # too late to belong to the return
    assert release_steps(trace_of(motion, q), FPS) == pytest.approx([0.07])
    assert summarise_motion([trace_of(trajectory(30))], FPS)["release_step"] is None


def test_the_way_back_ends_where_a_command_is_within_a_millimetre_of_the_target():
    motion, back = out_and_back()
    q = held(motion)
    q[back : back + 6, 1] += 0.07  # centimetres off, for six frames
    assert return_frames(trace_of(motion, q))[0] == pytest.approx([0, 6])
    assert return_frames(trace_of(motion, held(motion)))[0] == pytest.approx([0, 0])
    assert summarise_motion([trace_of(trajectory(30))], FPS)["return_frames"] == 0


@pytest.mark.parametrize("wait", [0, 3])
def test_after_a_jump_frames_count_and_those_that_the_step_bound_takes_are_not_late(wait):
    motion = trajectory(40, speed=0.0)
    q = np.tile(HOME, (40, 1))
    q[20:, 0] += 0.45  # the hand takes hold elsewhere
    motion = dataclasses.replace(motion, q=q, target=airbot().forward(torch.from_numpy(q)).numpy())
    motion.target[19] = motion.target[20]
    way = np.clip((np.arange(40) - 18 - wait) * 0.1, 0.0, 0.45)
    frames, late = return_frames(trace_of(motion, HOME + way[:, None] * np.eye(6)[0]))
    assert frames == pytest.approx([0, 4 + wait])
    assert late == pytest.approx([0, wait])


def test_the_jerk_at_a_seam_is_told_in_multiples_of_the_motions_own():
    t = np.arange(60)[:, None] / 20
    q = HOME + 0.01 * t**3
    clean = airbot().forward(torch.from_numpy(q)).numpy()
    target = clean.copy()
    target[30:, 0] += 0.005
    motion = dataclasses.replace(trajectory(60), q=q, target=target, clean=clean)
    assert seams(target, clean) == pytest.approx([30])
    assert seam_jerk([trace_of(motion, q)]) == pytest.approx(1.0)
    stepped = q + np.where(np.arange(60)[:, None] >= 30, 1, 0) * np.diff(q, n=3, axis=0).max() * np.eye(6)[1]
    assert seam_jerk([trace_of(motion, stepped)]) == pytest.approx(2.0)
    trembling = clean + 0.002 * np.random.default_rng(0).normal(size=clean.shape)
    assert seam_jerk([trace_of(dataclasses.replace(motion, target=trembling), q)]) is None


def test_self_collision_is_as_deep_as_the_spheres_and_absent_without_shapes():
    motion = trajectory(20)
    assert collision_depth_mm(airbot().description, [trace_of(motion)]) == 0.0
    folded = held(motion)
    lower, upper = airbot().lower.numpy(), airbot().upper.numpy()
    rng = np.random.default_rng(0)
    folded[:] = rng.uniform(lower, upper, folded.shape)
    assert collision_depth_mm(airbot().description, [trace_of(motion, folded)]) > 1
    from test_stress import ARMS

    bare = ARMS["seven"]
    assert (
        collision_depth_mm(bare, [dataclasses.replace(trace_of(motion), rollout=seven_joints(motion))])
        is None
    )


def seven_joints(motion):
    q = np.zeros((len(motion), 7))
    return Rollout(motion, q, q, len(q))


def test_intervals_hold_the_mean_shrink_with_recordings_and_repeat():
    rng = np.random.default_rng(0)

    def traces(count):
        found = []
        for i in range(count):
            motion = trajectory(12, index=i)
            target = motion.target.copy()
            target[:, 0] += 1e-3 * rng.uniform(1, 3)
            found.append(trace_of(motion, target=target))
        return found

    few, many = traces(5), traces(60)
    low, high = bootstrap(many, FPS)["mean_mm"]
    mean = np.mean(np.concatenate([trace.position_mm for trace in many]))
    assert low < mean < high
    assert high - low < np.diff(bootstrap(few, FPS)["mean_mm"])[0]
    assert bootstrap(many, FPS) == bootstrap(many, FPS)
    assert bootstrap(few[:1], FPS) == {}


def test_a_failure_is_named_by_its_kind():
    motion = trajectory(60)
    q = np.concatenate([motion.q[1:], motion.q[-1:]])
    q[20, 1] += 0.8
    assert judge(trace_of(motion, q), [], FPS).failure == "E-stop"
    q[30:] = np.nan
    assert judge(trace_of(motion, q), [], FPS).failure in ("non-finite", "E-stop")
    assert judge(trace_of(motion), [], FPS).failure == ""
