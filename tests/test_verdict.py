"""Properties of singular passages and of the verdicts on rollouts."""

import numpy as np
import pytest
from evaluation_cases import FPS, DampedLeastSquares, Scripted, airbot, trajectory

from lerobot_mimicik.evaluation.metrics import measure
from lerobot_mimicik.evaluation.rollouts import make_rollouts
from lerobot_mimicik.evaluation.verdict import (
    SINGULAR_VALUE,
    characteristic_length,
    find_passages,
    judge,
    judge_all,
    smallest_singular_value,
)
from lerobot_mimicik.solvers import make_solver


def verdict_of(solver, one):
    (trace,) = measure(airbot(), make_rollouts("closed_loop", solver, [one]))
    return judge(trace, find_passages(smallest_singular_value(airbot(), one.q), FPS), FPS)


def test_the_characteristic_length_is_of_the_size_of_the_arm():
    assert 0.1 < characteristic_length(airbot()) < 0.7


def test_a_straight_wrist_is_singular_and_a_bent_one_is_not():
    q = np.array(airbot().description.home)
    wrist = np.tile(q, (3, 1))
    wrist[:, 4] = [0.0, 0.01, q[4]]
    straight, nearly, bent = smallest_singular_value(airbot(), wrist)
    assert straight < 1e-4
    assert straight < nearly < SINGULAR_VALUE < bent


def test_a_trajectory_across_the_wrist_singularity_has_one_passage_around_the_crossing():
    one = trajectory(120, through_wrist=True)
    (passage,) = find_passages(smallest_singular_value(airbot(), one.q), FPS)
    crossing = int(np.argmin(np.abs(one.q[:, 4])))
    assert passage.start <= crossing < passage.stop
    assert abs(passage.deepest - crossing) <= 2


def test_passages_close_together_are_one():
    value = np.ones(100)
    value[[10, 11, 14, 60]] = 0.01
    value[11] = 0.001
    assert [(found.start, found.stop, found.deepest) for found in find_passages(value, FPS)] == [
        (10, 15, 11),
        (60, 61, 60),
    ]
    assert find_passages(np.ones(5), FPS) == []


@pytest.mark.parametrize("through_wrist", [False, True])
def test_a_damped_solver_on_feasible_motion_is_bounded(through_wrist):
    one = trajectory(120, through_wrist=through_wrist)
    verdict = verdict_of(DampedLeastSquares(airbot(), iterations=2, damping=0.03), one)
    assert verdict.verdict == "Bounded"


def test_a_frozen_arm_is_singular():
    verdict = verdict_of(make_solver("hold", airbot()), trajectory(120))
    assert verdict.verdict == "Singular"
    assert "frozen" in verdict.reason


def test_an_estop_sized_jump_is_singular_even_if_it_tracks():
    good = DampedLeastSquares(airbot())

    def jumping(q, target, call):
        answer = good.solve(q[None], target[None])[0]
        return answer + (2 * np.pi if call == 12 else 0.0) * np.eye(6)[5]

    verdict = verdict_of(Scripted(jumping), trajectory(15))
    assert verdict.verdict == "Singular"
    assert "frame 12" in verdict.reason


def test_a_nan_diverges():
    solver = Scripted(lambda q, _, call: q * (np.nan if call == 12 else 1.0))
    verdict = verdict_of(solver, trajectory(60))
    assert verdict.verdict == "Diverged"
    assert "frame 12 of episode 0" in verdict.reason


def test_a_steady_drift_away_diverges():
    drift = 0.01 * np.eye(6)[0]
    verdict = verdict_of(Scripted(lambda q, _, call: q + drift), trajectory(120, speed=0.0))
    assert verdict.verdict == "Diverged"
    assert "without return" in verdict.reason


def test_being_lost_for_good_diverges_even_where_the_error_no_longer_grows():
    drift = 0.01 * np.eye(6)[0]
    solver = Scripted(lambda q, _, call: q + (drift if call < 30 else 0.0))
    verdict = verdict_of(solver, trajectory(300, speed=0.0))
    assert verdict.verdict == "Diverged"


def test_an_error_that_stays_after_a_passage_is_singular():
    one = trajectory(200, through_wrist=True)
    (passage,) = find_passages(smallest_singular_value(airbot(), one.q), FPS)
    turn = 0.1 * np.eye(6)[0]
    # Follows the recording, until the singularity leaves it with a constant offset of the base joint.
    solver = Scripted(
        lambda q, _, call: one.q[min(call + 1, len(one) - 1)] + (turn if call >= passage.deepest else 0.0)
    )
    verdict = verdict_of(solver, one)
    assert verdict.verdict == "Singular"
    assert "not back under 10 mm" in verdict.reason


def test_the_verdict_on_a_dataset_is_its_worst():
    one = trajectory(10)
    solvers = [DampedLeastSquares(airbot()), Scripted(lambda q, _, call: q * np.nan)]
    traces = [measure(airbot(), make_rollouts("closed_loop", solver, [one]))[0] for solver in solvers]
    worst, each = judge_all(traces, [[], []], FPS)
    assert [verdict.verdict for verdict in each] == ["Bounded", "Diverged"]
    assert worst == each[1]
