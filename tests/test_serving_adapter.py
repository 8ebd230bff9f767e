"""The adapter with a solver behind a server: as in process, and after losses it goes on by itself."""

from functools import partial

import numpy as np
from evaluation_cases import airbot
from serving_cases import FACTORIES, HOME, serving
from test_serving_server import connect, policy  # noqa: F401 - a fixture

from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.serving.limits import Limits
from lerobot_mimicik.solvers import make_solver
from robot_adapters.adapter import IKStatus, MimicIKAdapter

ARM = describe_arm("airbot_play")


def test_through_a_server_it_does_what_it_does_in_process(policy):  # noqa: F811
    factories = {"mimicik": partial(make_solver, "mimicik", airbot(), policy=policy)}
    here = MimicIKAdapter(factories["mimicik"](), ARM)
    with serving(factories=factories) as server, connect(server.address, "mimicik") as remote:
        np.testing.assert_array_equal(remote.step_range, here.solver.step_range)
        there = MimicIKAdapter(remote, ARM)
        q, target = HOME, here.forward(HOME + 0.2)
        for _ in range(8):
            expected, found = here.solve(q, target), there.solve(q, target)
            np.testing.assert_allclose(found.q, expected.q, atol=1e-6)
            assert (found.status, found.source.split()[0]) == (expected.status, expected.source)
            q = expected.q


def test_when_the_server_comes_back_so_does_the_arm():
    with serving() as server:
        remote = connect(server.address)
        adapter = MimicIKAdapter(remote, ARM)
        target = adapter.forward(HOME + 0.05)
        moved = adapter.solve(HOME, target)
        assert moved.status is not IKStatus.FAILED
    remote.timeout_s = 0.1
    for _ in range(2):
        held = adapter.solve(moved.q, target)
        assert held.status is IKStatus.FAILED
        assert server.address in held.message
        np.testing.assert_array_equal(held.q, moved.q)
    remote.timeout_s = 20.0
    with serving(bind=server.address):
        results = [adapter.solve(moved.q, target) for _ in range(3)]
        assert all(result.status is not IKStatus.FAILED for result in results), results
        # The history began anew with these three.
        np.testing.assert_allclose(remote.solve(HOME, target), HOME + 4)
        remote.close()


def test_a_session_that_others_took_is_opened_again_with_a_new_history():
    with serving(FACTORIES, limits=Limits(max_sessions=2)) as server, connect(server.address) as remote:
        adapter = MimicIKAdapter(remote, ARM)
        target = adapter.forward(HOME + 0.05)
        adapter.solve(HOME, target)
        first = remote.session
        others = [connect(server.address) for _ in range(2)]
        for other in others:
            other.reset(HOME)
        statuses = [adapter.solve(HOME, target).status for _ in range(3)]
        assert statuses[0] is IKStatus.FAILED
        assert IKStatus.FAILED not in statuses[1:]
        assert remote.session != first
        # Two frames since: the history is of those only.
        np.testing.assert_allclose(remote.solve(HOME, target), HOME + 3)
        for other in others:
            other.close()
