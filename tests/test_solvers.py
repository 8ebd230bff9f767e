"""Properties of the solver interface, of holding still, and of the registry."""

import numpy as np
import pytest
from evaluation_cases import DampedLeastSquares, Scripted, airbot, trajectory

from lerobot_mimicik.checkpoints import LEARNED
from lerobot_mimicik.solvers import known_solvers, make_solver, register_solver, solver_configuration


def test_hold_answers_where_the_arm_is():
    one = trajectory()
    solver = make_solver("hold", airbot())
    assert np.array_equal(solver.solve(one.q, one.target), one.q)
    assert np.array_equal(solver.solve_recorded(one.q, one.target), one.q)


def test_an_unknown_solver_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"(?s)'pinochio'.*hold.*mimicik"):
        make_solver("pinochio", airbot())


def test_a_registered_solver_is_made_by_name_and_its_name_is_taken():
    register_solver("test_dls")(DampedLeastSquares)
    assert "test_dls" in known_solvers()
    assert make_solver("test_dls", airbot(), iterations=3).iterations == 3
    register_solver("test_dls")(DampedLeastSquares)
    with pytest.raises(ValueError, match="already registered"):
        register_solver("test_dls")(Scripted)


def test_recorded_answers_do_not_depend_on_whether_a_solver_is_batched():
    one = trajectory(20)
    batched = DampedLeastSquares(airbot())
    single = Scripted(lambda q, target, _: batched.solve(q[None], target[None])[0])
    expected = batched.solve(one.q, one.target)
    np.testing.assert_allclose(batched.solve_recorded(one.q, one.target), expected, atol=1e-9)
    np.testing.assert_allclose(single.solve_recorded(one.q, one.target), expected, atol=1e-9)


def test_every_solver_says_how_it_is_configured():
    for name in set(known_solvers()) - {"remote", *LEARNED}:
        if not name.startswith("test_"):
            assert solver_configuration(name), name
