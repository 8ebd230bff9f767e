"""Inverse-kinematics solvers behind one interface: ``make_solver(name, arm, **options)``.

A new solver is a module here that subclasses ``IKSolver`` and registers itself, and a line below. Peers that
live in packages of their own import them when they are made: ``available_solvers()`` says which are here.
"""

from lerobot_mimicik.solvers import (
    embodik,
    guided,
    hold,
    jparse,
    least_squares,
    limit,
    mimicik,
    mink,
    optik,
    pink,
    pinocchio,
    placo,
    pybullet,
    relaxed_ik,
    remote,
    ssik,
)
from lerobot_mimicik.solvers.availability import SolverUnavailable
from lerobot_mimicik.solvers.base import (
    IKSolver,
    available_solvers,
    known_solvers,
    make_solver,
    register_solver,
    solver_configuration,
)

__all__ = [
    "IKSolver",
    "SolverUnavailable",
    "available_solvers",
    "embodik",
    "guided",
    "hold",
    "jparse",
    "known_solvers",
    "least_squares",
    "limit",
    "make_solver",
    "mimicik",
    "mink",
    "optik",
    "pink",
    "pinocchio",
    "placo",
    "pybullet",
    "register_solver",
    "relaxed_ik",
    "remote",
    "solver_configuration",
    "ssik",
]
