"""Properties of open-loop and closed-loop rollouts, with real and with deliberately bad solvers."""

import numpy as np
import pytest
from evaluation_cases import DampedLeastSquares, Scripted, airbot, trajectory

from lerobot_mimicik.evaluation.latency import measure_latency
from lerobot_mimicik.evaluation.metrics import measure, summarise
from lerobot_mimicik.evaluation.rollouts import known_modes, make_rollouts
from lerobot_mimicik.solvers import SolverUnavailable, make_solver


def summary(mode, solver, trajectories):
    return summarise(measure(airbot(), make_rollouts(mode, solver, trajectories)))


@pytest.mark.parametrize("mode", ["open_loop", "closed_loop"])
def test_a_good_solver_has_no_error_in_any_mode(mode):
    row = summary(mode, DampedLeastSquares(airbot()), [trajectory(20), trajectory(30, index=1)])
    assert row["frames"] == 50
    assert row["max_mm"] < 1e-3
    assert row["sr1"] == 100.0
    assert row["nonfinite"] == 0


def test_open_loop_is_told_the_recording_and_closed_loop_its_own_commands():
    one = trajectory(30)
    solver = DampedLeastSquares(airbot(), iterations=1)
    (open_loop,) = make_rollouts("open_loop", solver, [one])
    assert np.array_equal(open_loop.q_curr, one.q)
    (closed,) = make_rollouts("closed_loop", solver, [one])
    assert np.array_equal(closed.q_curr[0], one.q[0])
    assert np.array_equal(closed.q_curr[1:], closed.q_cmd[:-1])


def test_lockstep_equals_one_trajectory_at_a_time():
    trajectories = [trajectory(12), trajectory(20, index=1), trajectory(5, index=2)]
    solver = DampedLeastSquares(airbot(), iterations=2)
    single = Scripted(lambda q, target, _: solver.solve(q[None], target[None])[0])
    together = make_rollouts("closed_loop", solver, trajectories)
    apart = make_rollouts("closed_loop", single, trajectories)
    for a, b, one in zip(together, apart, trajectories, strict=True):
        assert a.trajectory is one
        assert a.asked == b.asked == len(one)
        np.testing.assert_allclose(a.q_cmd, b.q_cmd, atol=1e-9)


def test_rows_that_leave_the_batch_are_announced_to_the_solver():
    class Remembering(DampedLeastSquares):
        """Checks that each row's first frame is still the one it was reset with."""

        def reset(self, q):
            self.start = q.copy()

        def select(self, rows):
            self.start = self.start[rows]

        def solve(self, q_curr, target_pose):
            assert len(self.start) == len(q_curr)
            assert np.abs(self.start - q_curr).max() < 2.0
            return super().solve(q_curr, target_pose)

    lengths = [5, 30, 12]
    trajectories = [trajectory(n, index=i) for i, n in enumerate(lengths)]
    rollouts = make_rollouts("closed_loop", Remembering(airbot()), trajectories)
    assert [rollout.asked for rollout in rollouts] == lengths


def test_a_non_finite_command_stops_its_trajectory_and_no_other():
    good = DampedLeastSquares(airbot())
    bad_target = trajectory(40, index=1).target[7]

    class Fragile(DampedLeastSquares):
        def solve(self, q_curr, target_pose):
            answer = good.solve(q_curr, target_pose)
            answer[(target_pose == bad_target).all(axis=1)] = np.nan
            return answer

    trajectories = [trajectory(40), trajectory(40, index=1)]
    healthy, stopped = make_rollouts("closed_loop", Fragile(airbot()), trajectories)
    assert healthy.asked == 40
    assert np.isfinite(healthy.q_cmd).all()
    assert stopped.asked == 8
    assert np.isfinite(stopped.q_cmd[:7]).all()
    assert np.isnan(stopped.q_cmd[7:]).all()
    row = summarise(measure(airbot(), [healthy, stopped]))
    assert row["frames"] == 80
    assert row["nonfinite"] == 1
    # The 33 frames without a command count as failures, not as frames that never were.
    assert row["sr10"] == pytest.approx(100 * 47 / 80)


def test_holding_still_has_the_distance_between_current_pose_and_target_as_error():
    import torch

    one = trajectory(30)
    (trace,) = measure(airbot(), make_rollouts("open_loop", make_solver("hold", airbot()), [one]))
    current = airbot().forward(torch.from_numpy(one.q)).numpy()
    expected = 1e3 * np.linalg.norm(current[:, :3] - one.target[:, :3], axis=1)
    np.testing.assert_allclose(trace.position_mm, expected, rtol=1e-9)
    assert not trace.max_dq.any()


def test_an_unknown_mode_is_refused_with_the_known_ones():
    assert {"open_loop", "closed_loop"} <= set(known_modes())
    with pytest.raises(ValueError, match=r"'half_open'.*open_loop, closed_loop"):
        make_rollouts("half_open", make_solver("hold", airbot()), [trajectory(5)])


def test_the_limit_takes_whole_recordings_and_no_single_frame():
    one = trajectory(30)
    solver = make_solver("limit", airbot())
    (rollout,) = make_rollouts("closed_loop", solver, [one])
    (trace,) = measure(airbot(), [rollout])
    assert trace.position_mm.max() < 0.5
    np.testing.assert_array_equal(rollout.q_curr[1:], rollout.q_cmd[:-1])
    with pytest.raises(SolverUnavailable, match="whole path"):
        solver.solve(one.q[0], one.target[0])
    assert measure_latency(solver, one).queries == len(one)
